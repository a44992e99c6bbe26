"""Frequency responses of rigs on a shaking table: cases, and the time integration of their motions by SciPy."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from scipy.integrate import solve_ivp

from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.response.state import Response
from vipetsc.modes.response.steady import SteadyStates

# Two masses of 1 kg between two walls; the first mass meets a stop on the ground, and the left wall moves.
TWO_MASSES: dict[str, Any] = {
    "name": "rig",
    "lattice": {
        "cells": 2,
        "cell": {
            "masses": [1.0],
            "springs": [{"start": 1, "end": 1, "stiffness": 1.5, "next_cell": True}],
            "contact": [1, 1],
        },
        "damping": {"mass": 0.06},
    },
    "contacts": {"law": "bilinear", "stiffness": 20.0, "restitution": 1.0, "sites": [1], "clearance": 0.8},
    "drive": {"waveform": "harmonic", "amplitude": 0.1, "frequency": 1.0, "end": "left"},
    "time": {"end": 10.0},
    "nfrc": {"source": "force", "over": "frequency", "range": [1.0, 2.3], "fixed": [0.2], "harmonics": 41},
}
TWO_MASSES["contacts"] |= {"pair": [0, 1], "side": "plus"}

OUTPUT: dict[str, Any] = {
    "points": [{"name": "near", "cell": 1}, {"name": "far", "cell": 2}],
    "transmission": [["near", "far"]],
    "forces": True,
}


def rate_of(states: SteadyStates, omega: float, amplitude: float):
    """The equations of motion of a lattice with elastic contacts: a function f with y' = f(t, y) and y = (u, u').

    The states y (..., component) may be several. Linear parts come from the lattice's matrices. Springs that are not
    linear are added one by one, for fixed or free ends: the spring that closes a ring is left out.
    """
    chain = states.case.model().chain
    # For such small lattices products with dense matrices are faster than with sparse ones.
    stiffness = chain.stiffness_matrix().toarray()
    damping = chain.damping_rows(0, chain.cells).toarray()
    masses = chain.masses()
    n = len(masses)
    d = chain.cell.dofs

    drive = np.zeros(n)
    for (cell, mass), weight in zip(states.points, states.weights, strict=True):
        drive[cell * d + mass] += weight * amplitude
    # Clearances, and with them the loads at rest, are those of the case, not those that the response was computed with.
    joins = []
    for site, stops in zip(chain.sites, states.forces.contacts, strict=True):
        pair = site.pair
        plus, minus = site.gaps
        host = site.cell * d + pair.host if pair.host >= 0 else None
        sides = [(side, gap) for side, gap in ((1, plus), (-1, minus)) if gap < np.inf]
        load = sum(side * stops.law.elastic_force(-gap) for side, gap in sides)
        joins.append((host, (site.cell + pair.offset) % chain.cells * d + pair.resonator, stops.law, sides, load))

    beyond = []
    for cell, number in itertools.product(range(-1, chain.cells), range(len(chain.cell.springs))):
        spring = chain.spring(cell, number)
        other = cell + spring.offset
        is_inside = cell >= 0 and other < chain.cells
        if spring.is_linear or not (is_inside or (spring.offset and chain.ends == "fixed")):
            continue
        start = cell * d + spring.start if cell >= 0 else None
        end = other * d + spring.end if other < chain.cells else None
        beyond.append((start, end, spring))

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        u = y[..., :n]
        v = y[..., n:]
        force = drive * np.cos(omega * t) - u @ stiffness.T - v @ damping.T

        for host, resonator, law, sides, load in joins:
            w = u[..., resonator] - (0.0 if host is None else u[..., host])
            push = sum(side * law.elastic_force(side * w - gap) for side, gap in sides) - load
            force[..., resonator] -= push
            if host is not None:
                force[..., host] += push

        for start, end, spring in beyond:
            z = (0.0 if end is None else u[..., end]) - (0.0 if start is None else u[..., start])
            pull = spring.quadratic * z**2 + spring.cubic * z**3
            if end is not None:
                force[..., end] -= pull
            if start is not None:
                force[..., start] += pull
        return np.concatenate([v, force / masses], axis=-1)

    return rate


def after_a_period(states: SteadyStates, point: Response, state: np.ndarray) -> np.ndarray:
    """The state (..., displacements and velocities) one period after ``state``, by SciPy; states may be several."""
    omega, amplitude = states.drive(point.xi[-1])
    rate = rate_of(states, omega, amplitude)
    period = 2 * np.pi / omega

    def flat_rate(t: float, y: np.ndarray) -> np.ndarray:
        return rate(t, y.reshape(state.shape)).ravel()

    span = (0, period)
    solved = solve_ivp(flat_rate, span, state.ravel(), "DOP853", rtol=1e-10, atol=1e-12, max_step=period / 50)
    return solved.y[:, -1].reshape(state.shape)


class PeriodMap(NamedTuple):
    """The state ``end`` (component,) after a period, and the eigenvalues ``multipliers`` of the period map's Jacobian.

    On a periodic motion the eigenvalues are its Floquet multipliers.
    """

    end: np.ndarray
    multipliers: np.ndarray


def period_map(states: SteadyStates, point: Response, state: np.ndarray) -> PeriodMap:
    """The map of a period at ``state`` (component,); its Jacobian comes from forward differences."""
    step = 1e-6
    # Motions that are integrated together have the same time steps, whose errors cancel in the differences.
    ends = after_a_period(states, point, state + step * np.vstack([np.zeros(len(state)), np.eye(len(state))]))
    return PeriodMap(end=ends[0], multipliers=np.linalg.eigvals((ends[1:] - ends[0]).T / step))


def followed(case: NfrcCase, folder):
    """The equations of a case's only curve, and the points of that curve."""
    folder.mkdir(exist_ok=True)
    (curve,) = follow_all(case, folder, MPI.COMM_SELF)
    _, restitution, fixed = case.curves()[0]
    return SteadyStates(case, restitution, fixed), curve.points
