"""Steady states with lossy stops: SciPy returns them after half a period, and they are as stable as its map says."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from tests.conftest import StopAt
from tests.independent_lattice import ScipyLattice, Stop
from tests.models import CLEARANCE, TWO_MASS_CELL
from tests.steady_states import motion_at, refined
from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state
from vipetsc.modes.stability import LEAST_OF_FINITE
from vipetsc.parallel import StoppedError

RESTITUTION = 0.7


class Kind(NamedTuple):
    """A lattice with a stop on both sides of one site, the force in N on it and its frequency in rad/s.

    The state is found with a ``few`` harmonics and refined with ``many``: forces of lossy contacts jump at onsets.
    """

    lattice: dict[str, Any]
    contacts: dict[str, Any]
    force: float
    frequency: float
    few: int
    many: int
    unstable: bool

    def states(self, harmonics: int) -> SteadyStates:
        """Return the steady states of a curve over the amplitude that begins at the force."""
        contacts = {"restitution": RESTITUTION} | self.contacts
        drive = {"frequency": self.frequency, "cell": 1, "amplitude": 1.0, "cycles": 3}
        nfrc = {"source": "force", "infinite": False, "harmonics": harmonics, "range": [self.force, 10 * self.force]}
        case = {"name": "x", "lattice": self.lattice, "contacts": contacts, "drive": drive, "nfrc": nfrc}
        return SteadyStates(NfrcCase.from_table(case), RESTITUTION, self.frequency)


# Growing amplitudes do not lead to the first state, three times beyond the force at which the stop is touched: they
# end where one episode of contact becomes two, and the weights of contact forces grow instead.
BEYOND = Kind(
    {"cells": 3, "cell": TWO_MASS_CELL}, {"stiffness": 1e7, "sites": [2], "clearance": 1e-4}, 1.78, 1e3, 21, 101, False
)
FOUR_BAND = {"preset": "four-band", "cells": 2}
UNSTABLE = Kind(FOUR_BAND, {"sites": [1], "clearance": CLEARANCE}, 19.5, 1.7e3, 61, 61, True)


@pytest.mark.parametrize("kind", [BEYOND, UNSTABLE], ids=["beyond", "unstable"])
def test_a_lossy_state_repeats_itself_and_is_as_stable_as_its_period_map(kind):
    """As many multipliers exceed 1 as said, and the largest one has the state's rate of growth."""
    few = kind.states(kind.few)
    states = kind.states(kind.many)
    xi = refined(few, states, first_state(few).xi)
    measured = states.measured(xi)
    assert measured.episodes == 2

    # The period begins at a phase at which the contact is open.
    phases = np.linspace(0, np.pi, 2001)
    z = measured.harmonics[0]
    phase = phases[np.argmin(np.abs((z * np.exp(1j * np.arange(len(z)) * phases[:, None])).sum(axis=1).real))]
    start = np.concatenate([part.ravel() for part in motion_at(states, xi, np.arange(kind.lattice["cells"]), phase)])
    end = half_a_period(states, kind, phase, start)
    scale = states.clearance * np.repeat([1, kind.frequency], len(start) // 2)
    assert (np.abs(end - start) < 3e-4 * scale).all()

    if kind.unstable:
        columns = [
            (half_a_period(states, kind, phase, start + step) - half_a_period(states, kind, phase, start - step))
            / (2 * step.max())
            for step in np.diag(1e-5 * scale)
        ]
        # A symmetric state is mapped to itself by half a period: the map of a period is that map applied twice.
        multipliers = np.abs(np.linalg.eigvals(np.array(columns).T)) ** 2
        assert measured.unstable == np.count_nonzero(multipliers > np.exp(2 * np.pi * LEAST_OF_FINITE)) > 0
        assert np.exp(2 * np.pi * measured.growth) == pytest.approx(multipliers.max(), rel=1e-4)


def half_a_period(states: SteadyStates, kind: Kind, phase: float, start: np.ndarray) -> np.ndarray:
    """Return minus the state (2 n,) half a period after ``start`` at a ``phase`` of the force, by SciPy.

    Stops are alike on both sides, and the force changes its sign after half a period.
    """
    chain = states.case.model().chain
    n = len(chain.masses())
    (site,) = chain.sites
    first = site.cell * chain.cell.dofs
    stop = Stop(
        resonator=first + site.pair.resonator,
        host=first + site.pair.host,
        gap=site.clearance,
        stiffness=site.law.stiffness,
        exponent=1.5,
        restitution=RESTITUTION,
    )
    push = kind.force * np.eye(n)[0]
    lattice = ScipyLattice(
        masses=chain.masses(),
        stiffness=chain.stiffness_matrix().toarray(),
        damping=np.zeros((n, n)),
        stops=(stop, replace(stop, side=-1)),
        force=lambda t: push * np.cos(kind.frequency * t),
    )
    times = (phase + np.array([0.0, np.pi])) / kind.frequency
    motion, _ = lattice.motion(times, *np.split(start, 2), start=float(times[0]))
    return -motion[:2, -1].ravel()


def test_a_request_to_stop_ends_the_way_to_the_first_state():
    with pytest.raises(StoppedError, match="before the first point"):
        first_state(BEYOND.states(BEYOND.few), StopAt(0))
