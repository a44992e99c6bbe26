"""Kinks in the force of a contact that is pressed at rest: their positions, and substeps that end on them."""

from types import SimpleNamespace

import numpy as np
import pytest

from tests.unit.propagator_parts import pressed_mass
from vipetsc.contact.law import CLOSED
from vipetsc.dynamics.propagator import advance
from vipetsc.dynamics.propagator.advance import CUT, SHORTEST, _first_kink
from vipetsc.dynamics.propagator.nodes import EXIT
from vipetsc.dynamics.propagator.substeps import Substep

# The value of _first_kink if there is no kink.
NONE = 2.0


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("gap", [0.0, -0.3])
@pytest.mark.parametrize(
    ("motion", "kink"),
    [
        # Motions of constant velocity go through the kink, away from it, or not as far.
        ([0.2, -1.0], 0.2),
        ([-0.2, 1.0], 0.2),
        ([-0.2, -1.0], NONE),
        ([0.2, 1.0], NONE),
        ([1.2, -1.0], NONE),
        # A kink within 2e-9 of the beginning does not count, but one where the motion returns does.
        ([0.0, 1.0, -2.0], 0.5),
        ([0.0, -1.0, 2.0], 0.5),
        ([0.0, 1.0, 0.0], NONE),
        ([0.0, -1.0, 0.0], NONE),
        ([2e-9, -1.0, 2.0], 0.5),
        ([-2e-9, 1.0, -2.0], 0.5),
        ([1e-6, -1.0, 2.0], 1.000002e-6),
        ([-1e-6, 1.0, -2.0], 1.000002e-6),
        # A kink within 2e-9 of the end does not count; the first of two counts; a motion may turn before it.
        ([1.0, -1.0], NONE),
        ([-1.0, 1.0], NONE),
        ([1.0 - 2e-9, -1.0], NONE),
        ([1.0 - 1e-6, -1.0], 1.0 - 1e-6),
        ([0.16, -1.0, 1.0], 0.2),
        ([-0.16, 1.0, -1.0], 0.2),
        ([0.26, -1.0, 1.0], NONE),
    ],
)
def test_a_kink_is_found_where_a_pressed_contact_opens_or_closes(side, gap, motion, kink):
    """The first kink is the first root of the indentation, the polynomial ``motion`` in the position in the substep."""
    cluster = pressed_mass(gap, side)
    length = 0.5
    seconds = length * cluster.interval
    depth = np.polynomial.Polynomial(motion)
    for site_motion, position in ((cluster.site_motion, 0.0), (cluster.trial.site_motion, 1.0)):
        site_motion[0, 0] = side * (depth(position) + gap)
        site_motion[0, 1] = side * depth.deriv()(position) / seconds
        site_motion[0, 2] = side * depth.deriv(2)(position) / seconds**2

    assert _first_kink(cluster, cluster.trial, length) == pytest.approx(kink, rel=1e-9)

    # Changes of the mode of other contacts another search finds.
    cluster.contacts["mode"] = side * CLOSED
    assert _first_kink(cluster, cluster.trial, length) == NONE


class SubstepsOnKinks:
    """The loop that ends substeps on kinks, run in Python, with kinks and substeps that a test prescribes.

    ``lengths`` are those of the substeps that were tried; ``state`` is the cluster's.
    """

    def __init__(self, monkeypatch, kinks: list[float], *, converges: bool = True) -> None:
        self.lengths: list[float] = []
        self.state = SimpleNamespace(rejected=3, length=9.0, missed=0)
        remaining = iter(kinks)

        def try_substep(cluster: object, trial: object, substep: Substep) -> bool:
            self.lengths.append(substep.length)
            return converges

        monkeypatch.setattr(advance, "_first_kink", lambda cluster, trial, length: next(remaining, NONE))
        monkeypatch.setattr(advance, "_try_substep", try_substep)

    def end(self, length: float) -> Substep:
        cluster = SimpleNamespace(state=[self.state])
        return advance._end_on_kink.py_func(cluster, None, Substep(EXIT, length))


def test_a_substep_is_repeated_until_no_kink_is_inside(monkeypatch):
    """A substep that is cut at a kink is repeated at that length, until no kink is inside; counts stay the same."""
    loop = SubstepsOnKinks(monkeypatch, [0.5, 0.75])
    assert loop.end(0.4) == Substep(EXIT, 0.5 * 0.75 * 0.4)
    assert loop.lengths == [0.5 * 0.4, 0.75 * 0.2]
    assert (loop.state.rejected, loop.state.length) == (3, 9.0)


@pytest.mark.parametrize(("factor", "is_cut"), [(0.99, False), (1.01, True)])
def test_no_substep_is_cut_shorter_than_the_shortest(monkeypatch, factor, is_cut):
    """A substep is cut at a kink only if its length stays above the shortest one."""
    fraction = factor * SHORTEST / 0.4
    loop = SubstepsOnKinks(monkeypatch, [fraction])
    expected = fraction * 0.4 if is_cut else 0.4
    assert loop.end(0.4) == Substep(EXIT, expected)


def test_a_substep_that_cannot_be_repeated_is_rejected_and_the_next_one_is_shorter(monkeypatch):
    loop = SubstepsOnKinks(monkeypatch, [0.5, 0.5], converges=False)
    assert loop.end(0.4).length == -1.0
    assert loop.lengths == [0.2]
    assert loop.state.rejected == 4
    assert loop.state.length == pytest.approx(CUT * 0.2)
