"""Branches of condensed motions, by harmonic balance, that several tests follow."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.models import CLEARANCE, four_band_contact
from vipetsc.case.nnm import NnmTable
from vipetsc.lattice import Chain, WaveCompliance, four_band
from vipetsc.lattice.sites import sites_at
from vipetsc.modes.balance.conservative import ConservativeMotions
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.branches.balance import condensed_system, state_of
from vipetsc.modes.continuation.arclength import Continuation
from vipetsc.modes.point import Point
from vipetsc.modes.stops import Stops
from vipetsc.modes.system import System


def condensed_problem(system: System, **options: Any) -> ConservativeMotions:
    """The equations of a system's periodic motions by harmonic balance; ``options`` are keys of [nnm]."""
    return condensed_system(system, NnmTable(**{"tolerance": 1e-12, "first_step": 1e-2} | options))


def condensed_branch(
    system: System, mode: int, energy: float, **options: Any
) -> tuple[ConservativeMotions, list[Point]]:
    """The problem and the points of a branch that begins in linear mode ``mode`` (from 0) with ``energy`` in J."""
    problem = condensed_problem(system, **options)
    omega, shapes = system.linear_modes()
    rows = np.vstack([system.contact_rows, system.spring_rows])
    # A mode of unit modal mass has the energy omega^2 a^2 / 2 at the amplitude a.
    z = rows @ shapes[:, mode] * np.sqrt(2 * energy) / omega[mode]
    start = problem.from_mode(z, float(omega[mode]))
    return problem, [start, *Continuation(problem, start, problem.control)]


def condensed_breather(
    cells: int, site: int, omega: float, truncation: float = 1e-8, **options: Any
) -> tuple[ConservativeMotions, Point]:
    """The problem and the breather of ``omega`` in rad/s at the only contact, in cell ``site`` (counted from 1)."""
    cell = four_band("calibrated")
    chain = Chain(cell, cells, "fixed", sites_at([site - 1], cell.pair, clearances=CLEARANCE))
    control = NnmTable(truncation=truncation, tolerance=1e-12, **options)
    forces = SiteForces([Stops.both(four_band_contact("hertz"), CLEARANCE)])
    problem = ConservativeMotions(WaveCompliance(chain), forces, control)
    return problem, problem.in_gap(omega, np.array([1.0]))


def displacement(problem: ConservativeMotions, point: Point) -> np.ndarray:
    """Displacements (mass,) in m at phase 0, where all velocities are zero."""
    (u,) = state_of(problem, point, len(problem.compliance.vectors)).values()
    return u
