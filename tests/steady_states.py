"""Cases of frequency response curves that tests share, and the motion in the lattice at a point of a curve."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from tests.models import CLEARANCE
from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.response.steady import SteadyStates

LATTICE = {"preset": "four-band", "cells": 30}
CONTACTS = {"sites": [10], "clearance": CLEARANCE, "restitution": 1.0}
# The range holds the fold at which a sweep to larger amplitudes jumps: at amplitude/clearance = 1.0014.
NFRC = {"harmonics": 11, "range": [0.98, 1.01]}

# The oscillator u'' + c u' + u + u^3 = F cos(Om t), c = 0.1: a mass of 1 kg between two springs, without contacts.
CUBIC_OSCILLATOR: dict[str, Any] = {
    "lattice": {
        "cells": 1,
        "cell": {
            "masses": [1.0],
            "springs": [{"start": 1, "end": 1, "stiffness": 0.5, "cubic": 0.5, "damping": 0.05, "next_cell": True}],
            "contact": [1, 1],
        },
    },
    "contacts": {"sites": []},
}


def nfrc_case(lattice: dict[str, Any] | None = None, contacts: dict[str, Any] | None = None, **nfrc: Any) -> NfrcCase:
    """The case of one site of a four-band lattice under a wave; arguments update the tables of the case."""
    table = {"name": "x", "lattice": LATTICE | (lattice or {}), "contacts": CONTACTS | (contacts or {})}
    return NfrcCase.from_table(table | {"nfrc": NFRC | nfrc})


def curve_of(case: NfrcCase, folder: Path):
    """The only curve of a ``case``, followed on this rank; its file lies in ``folder``."""
    folder.mkdir(exist_ok=True)
    (curve,) = follow_all(case, folder, MPI.COMM_SELF)
    return curve


def refined(few: SteadyStates, many: SteadyStates, xi: np.ndarray) -> np.ndarray:
    """The solution with the harmonics of ``many`` near the solution ``xi`` with the harmonics of ``few``."""
    missing = many.options.harmonics - few.options.harmonics
    harmonics = np.pad(few.balance.unpack(xi[:-1]), ((0, 0), (0, missing)))
    guess = np.append(many.balance.pack(harmonics), xi[-1])
    return many.at(guess, xi[-1])


def motion_at(states: SteadyStates, xi: np.ndarray, cells: np.ndarray, phase: float | np.ndarray = 0.0):
    """Displacement in m and velocity in m/s of a state at the ``phase`` (...) of its period: (cell, dof, ...)."""
    omega, amplitude = states.drive(xi[-1])
    unknowns = xi[:-1] * states.clearance
    # Motions that are symmetric about zero have no mean.
    first = 1 if states.options.symmetric else 0
    orders = np.arange(first, states.balance.unpack(unknowns).shape[1])

    # Contacts act on the lattice with every harmonic, the drive with one of them only.
    base = omega / states.periods
    forces = states.balance.series(unknowns, base).forces
    displacement = 0.0
    velocity = 0.0
    for order in orders:
        acting = forces[:, order]
        if order == states.periods and not states.wave:
            acting = np.append(acting, amplitude * states.weights)
        field = states.compliance.field(order * base, acting, cells)
        if order == states.periods and states.wave:
            field = field + states.linear_motion(omega).wave.field(cells) * amplitude * states.clearance

        field = np.multiply.outer(field, np.exp(1j * order * phase))
        displacement = displacement + field.real
        velocity = velocity + (1j * order * base * field).real
    return displacement, velocity


def first_harmonic(motion: np.ndarray, samples: int) -> float:
    """The amplitude of the first harmonic of a ``motion`` (time,) over whole periods of ``samples`` samples each."""
    turns = np.exp(-2j * np.pi * np.arange(len(motion)) / samples)
    return float(2 * np.abs(np.mean(turns * motion)))
