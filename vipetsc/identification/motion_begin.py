"""The state at which a motion begins, with its derivatives, and the contacts that are closed in it."""

from typing import NamedTuple

import numpy as np

from vipetsc.contact.law import CLIPPED, FREE, elastic_energy, elastic_force, gap_of
from vipetsc.contact.tracker import ImpactTracker
from vipetsc.identification.motion_rates import Lattice, MotionState, difference

# A difference of the elastic energy is taken between exponents that are 2 h apart; this is h. Over the energy, the
# error of the formula is about h^2, 1e-12, and that of rounding 1e-16/h, 1e-10: both less than a fit sees.
SHORT = 1e-6


class MotionBegin(NamedTuple):
    """The ``state`` (2n,) in m and m/s at a ``time`` in s, and its derivatives ``slopes`` (2n, parameter)."""

    time: float
    state: np.ndarray
    slopes: np.ndarray


def begin_contacts(lattice: Lattice, motion: MotionState, tracker: ImpactTracker) -> None:
    """Close the sites that the state of ``motion`` holds beyond their clearances, with the derivatives of w'_minus.

    As in ``ImpactTracker.begin``, mu (w'_minus^2 - w'^2)/2 is the elastic energy E(x): the impact had no loss before
    the motion begins. Hence w'_minus dw'_minus = w' dw' + d(E/mu), where E depends on the indentation x = sigma w - D,
    on the contact stiffness, to which it is proportional, and on the exponent of the law.
    """
    contacts = lattice.contacts
    n = len(lattice.inverse_mass)
    rows = range(len(contacts))
    # w and w' of each site: rows of the state from 0 on are displacements, from n on velocities.
    w = [[difference(motion.state, lattice.ends, i, first, 0) for first in (0, n)] for i in rows]
    closed = tracker.begin(np.array(w).reshape(-1, 2))

    for i in closed:
        site = contacts[i]
        side = int(np.sign(site["mode"]))
        which = 0 if side > 0 else 1
        speed = abs(float(site["approach"]))
        # At the floor w'_minus is constant; free and clipped sites have no force.
        if speed <= site["floor"] or abs(site["mode"]) in (FREE, CLIPPED):
            continue

        depth = max(side * w[i][0] - gap_of(site, side), 0.0)
        force = elastic_force(site["elastic"], depth)
        energy = elastic_energy(site["elastic"], depth)
        by_exponent = _energy_by_exponent(site, depth)
        for j in range(1, motion.state.shape[1]):
            deeper = side * difference(motion.state, lattice.ends, i, 0, j) - lattice.slopes.gaps[j - 1, i, which]
            change = force * deeper
            change += energy / site["elastic"]["stiffness"] * lattice.slopes.laws[j - 1, i, 0]
            change += by_exponent * lattice.slopes.laws[j - 1, i, 1]
            change -= energy / site["reduced_mass"] * _reduced_mass_slope(lattice, i, j - 1)
            faster = w[i][1] * difference(motion.state, lattice.ends, i, n, j)
            motion.approach[i, j] = side * (faster + change / site["reduced_mass"]) / speed


def _energy_by_exponent(site: np.ndarray, depth: float) -> float:
    """Derivative of the elastic energy in J at a ``depth`` in m by the exponent of the law."""
    energies = []
    for sign in (-1, 1):
        changed = site["elastic"].copy()
        changed["exponent"] += sign * SHORT
        energies.append(elastic_energy(changed, depth))
    return float(energies[1] - energies[0]) / (2 * SHORT)


def _reduced_mass_slope(lattice: Lattice, i: int, p: int) -> float:
    """Derivative of the reduced mass of site ``i`` by parameter ``p``: d mu = mu^2 sum_e dm_e/m_e^2 over its ends."""
    total = 0.0
    for mass in lattice.ends[i]:
        if mass >= 0:
            total += lattice.slopes.masses[p, mass] * lattice.inverse_mass[mass] ** 2
    return float(lattice.contacts[i]["reduced_mass"]) ** 2 * total
