"""Isolated frequency responses of an oscillator with a nonlinear absorber and of a cubic oscillator.

SciPy's integration and the cubic oscillator's closed forms confirm them.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

import vipetsc
from tests.rigs import period_map
from tests.steady_states import CUBIC_OSCILLATOR, motion_at
from vipetsc.case.nfrc import NfrcCase
from vipetsc.endings import Ending
from vipetsc.figures.registry import draw
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.sweeps import measure
from vipetsc.modes.response import isolated
from vipetsc.modes.response.state import Response
from vipetsc.modes.response.steady import SteadyStates

pytestmark = pytest.mark.parallel(1)

# A hardening oscillator with a nonlinear tuned vibration absorber of a twentieth of its mass, from Detroux et al.
# (2015). The dashpot is ten times theirs, so that the isolated curve is short.
PRIMARY = {"start": 1, "end": 1, "stiffness": 0.5, "cubic": 0.5, "damping": 0.01, "next_cell": True}
ABSORBER = {"start": 1, "end": 2, "stiffness": 0.0454, "cubic": 0.0042, "damping": 0.0128}
TABLE: dict[str, Any] = {
    "name": "absorber",
    "lattice": {"cells": 1, "cell": {"masses": [1.0, 0.05], "springs": [PRIMARY, ABSORBER], "contact": [1, 2]}},
    "contacts": {"sites": []},
    "drive": {"waveform": "harmonic", "amplitude": 0.18, "frequency": 1.0, "cell": 1, "mass": 1},
    "time": {"end": 10.0},
}


def absorber(force: float = 0.18, **nfrc: Any) -> NfrcCase:
    """The case of curves over the frequency at a ``force`` in N; isolated ones are looked for at 1.725 rad/s."""
    options = {"source": "force", "over": "frequency", "range": [1.55, 1.9], "fixed": [force], "harmonics": 7}
    return NfrcCase.from_table(TABLE | {"nfrc": options | {"isolas": 1, "largest_step": 0.3} | nfrc})


@pytest.fixture(scope="module")
def curves(tmp_path_factory):
    """The folder of the curves at 0.18 N, and the curves: the main one and the isolated one."""
    folder = tmp_path_factory.mktemp("isolas")
    return folder, follow_all(absorber(), folder, MPI.COMM_SELF)


def equations() -> SteadyStates:
    """The steady states of the oscillator with an absorber at 0.18 N."""
    return SteadyStates(absorber(), 1.0, 0.18)


def state_of(states: SteadyStates, point: Response) -> np.ndarray:
    """The displacements in m and velocities in m/s (4,) of a state at phase 0."""
    return np.concatenate([part.ravel() for part in motion_at(states, point.xi, np.arange(1))])


def test_an_isolated_curve_is_closed_and_has_a_file_of_its_own(curves):
    """The isolated curve ends at its first state, lies apart from the main curve, and has a file and a picture."""
    folder, (main, isola) = curves
    assert main.ended.ending is Ending.END_OF_RANGE
    assert (isola.name, isola.ended.ending) == (f"{main.name}-isola-1", Ending.CLOSED)
    np.testing.assert_array_equal(isola.points[0].xi, isola.points[-1].xi)
    # The elongations of the isolated curve are all larger than those of the main one, so that they do not meet.
    assert measure(main, "largest_elongation")[:, 0].max() < 1.0 < measure(isola, "largest_elongation")[:, 0].min()
    with vipetsc.open(folder / f"branch-{isola.name}.h5") as data:
        assert data.attrs["isola"] == "1"
    with vipetsc.open(folder / f"branch-{main.name}.h5") as data:
        assert "isola" not in data.attrs
    assert sorted(path.stem for path in draw("branches", [folder])) == [
        f"branch-{main.name}",
        f"branch-{isola.name}",
        "responses",
    ]


def test_its_two_ends_are_folds_of_the_flow(curves):
    """At the lowest and the highest frequency of an isola, SciPy's map of a period returns the state.

    The map has a multiplier of 1 there, as at any fold.
    """
    _, (_, isola) = curves
    states = equations()
    folds = [point for point in isola.points if point.kind == "fold"]
    frequencies = measure(isola, "frequency")
    found = sorted(point.measured.frequency for point in folds)
    assert found == [frequencies.min(), frequencies.max()]
    for point in folds:
        state = state_of(states, point)
        period = period_map(states, point, state)
        assert np.abs(period.end - state).max() < 1e-5 * np.abs(state).max()
        assert np.abs(period.multipliers - 1).min() < 1e-2


# The oscillator under a force of 0.3 N. The range of frequencies ends between its two folds, which are at 1.32 and
# 1.83 rad/s.
DUFFING: dict[str, Any] = CUBIC_OSCILLATOR | {
    "name": "duffing",
    "drive": {"waveform": "harmonic", "amplitude": 0.3, "frequency": 1.0, "cell": 1},
    "time": {"end": 10.0},
}


def duffing(**nfrc: Any) -> NfrcCase:
    """The case of the cubic oscillator's curve, with isolated ones sought at four places; ``nfrc`` updates [nfrc]."""
    options = {"source": "force", "over": "frequency", "range": [0.8, 1.6], "fixed": [0.3], "harmonics": 9}
    return NfrcCase.from_table(DUFFING | {"nfrc": options | {"isolas": 4} | nfrc})


def test_other_amplitudes_find_the_states_that_the_curve_from_below_does_not_meet(tmp_path):
    """They find the small motion at 1.6 rad/s, where the curve from below has the large one."""
    main, isola, back = follow_all(duffing(), tmp_path, MPI.COMM_SELF)
    assert (isola.name, back.name) == (f"{main.name}-isola-1", f"{main.name}-isola-1-back")
    first = isola.points[0]
    assert first.measured.frequency == pytest.approx(1.5)
    # The isolated curve goes up to the end of the range, and down to the fold at which a sweep down jumps.
    assert measure(isola, "frequency").max() == pytest.approx(1.6)
    (fold,) = [point.measured.frequency for point in back.points if point.kind == "fold"]
    assert fold == measure(back, "frequency").min()
    assert back.points[-1].measured.frequency == pytest.approx(1.6)

    # The first harmonic a of the cubic oscillator satisfies |1 - Om^2 + 3/4 a^2 + i c Om| a = F, up to a small
    # correction by the third harmonic.
    ends = [curve.points[-1].measured.outputs for curve in (isola, back)]
    a = min(np.hypot(end["spring_harmonics"][0, 1], end["spring_harmonics_imaginary"][0, 1]) for end in ends)
    stiffness = 1 - 1.6**2 + 0.75 * a**2
    assert a == pytest.approx(0.3 / abs(stiffness + 0.16j), rel=1e-3)


def test_other_amplitudes_lead_from_a_state_to_the_other_two():
    """States over the amplitude, from one state of the cubic oscillator, pass its other two at the curve's amplitude.

    The state at which the search begins is not among those found.
    """
    states = SteadyStates(duffing(), 1.0, 0.3)
    p = 1.5 / states.parameter.scale
    # The first harmonic alone satisfies (a (1 - Om^2 + 3/4 a^2))^2 + (c Om a)^2 = F^2, a cubic equation in a^2.
    polynomial = [0.5625, 1.5 * (1 - 1.5**2), (1 - 1.5**2) ** 2 + 0.15**2, -(0.3**2)]
    three = []
    for a in np.sqrt(np.sort(np.roots(polynomial).real)):
        # The two springs, to the left and to the right wall, have opposite elongations.
        first = 0.3 / (1 - 1.5**2 + 0.75 * a**2 + 0.15j)
        guess = np.outer([first, -first], np.arange(10) == 1)
        three.append(states.at(np.append(states.balance.pack(guess) / states.clearance, p), p))
    begin, *others = three
    states_found = list(isolated._states_over_amplitude(states, begin))
    for other in others:
        assert isolated._is_among(other, states_found)
    assert not isolated._is_among(begin, states_found)
