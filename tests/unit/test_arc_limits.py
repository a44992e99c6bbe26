"""Arcs of Newton's method: they end where they take far too long, and where a stop is requested."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import StopAt, assert_same_bits, datasets
from tests.reference_flows import FiniteDifferences
from vipetsc.case import NnmCase
from vipetsc.lattice import Contact
from vipetsc.modes import flow
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.flow import MAPS, MOST_LONGER, Dop853Flow, Flow
from vipetsc.modes.problem import FlowError
from vipetsc.modes.shooting import Shooting, linear_start
from vipetsc.modes.system import ContactPair, SmoothSpring, System
from vipetsc.parallel import StoppedError, StopRequest

pytestmark = pytest.mark.parallel(1)

# Places of unknowns of two masses.
AMPLITUDE = 1
PERIOD = 2
REASON = f"{MOST_LONGER} times those of the arc at the guess"


def test_limits_act_within_an_attempt_alone():
    """Outside an attempt no arc is too long, and no request is looked at."""
    one = Dop853Flow(two_masses())
    one.between_looks = 10
    stop = StopRequest()
    assert one.check(10_000) == 10_010
    with one.limited(15, stop):
        assert one.check(0) == 10
        assert one.check(10) == 16
        with pytest.raises(FlowError, match="more than 15 steps"):
            one.check(16)
        stop.requested = True
        with pytest.raises(StoppedError):
            one.check(1)
    assert one.check(10_000) == 10_010


def two_masses(with_stop: bool = True) -> System:
    """Two masses, the second one on a spring that hardens, with a stop between them or without one."""
    springs = [(None, 0, 1.0), (0, 1, 1.0), (None, 1, 1.5)]
    stops = [ContactPair(0, 1, 0.1, Contact("hertz", 50.0))] * with_stop
    return System.assemble([1.0, 1.0], springs, stops, [SmoothSpring.between(None, 1, cubic=0.5)])


def test_an_arc_in_pieces_has_the_bits_of_the_whole():
    """An arc in which a request is looked at after each step has the end, the changes and the steps of another one."""
    start = np.array([0.5, -0.4, 0.0, 0.0])
    one = Dop853Flow(two_masses())
    whole = one.arc(start, 20.0, 6.0)
    assert len(whole.events) > 10
    assert whole.steps > 100
    one.between_looks = 1
    looks = StopAt(10**6)
    with one.limited(10**6, looks):
        parts = one.arc(start, 20.0, 6.0)
    assert 0 <= 10**6 - looks.left - whole.steps <= 1
    assert parts.steps == whole.steps
    for name in ("end", "sensitivity", "events", "closed", "episodes"):
        assert np.array_equal(getattr(parts, name), getattr(whole, name)), name


def make_differences(system: System) -> Flow:
    """Central differences of the compiled flow."""
    return FiniteDifferences(Dop853Flow(system))


@pytest.mark.parametrize(("make", "unknown"), [(Dop853Flow, AMPLITUDE), (make_differences, PERIOD)])
def test_a_bad_newton_step_ends_the_attempt(make, unknown, monkeypatch):
    """A step of Newton's method to 2,000 times the amplitude or the period fails after few steps of the flow.

    A spring that hardens makes a motion of large amplitude fast.
    """
    problem = Shooting(make(two_masses(with_stop=False)), MAPS["quarter"], tolerance=1e-10)
    start = linear_start(problem, 1, 0.1)
    frame = problem.frame_at("relative", start.x, start.period)
    first = problem.arc(start.x, start.period).steps
    guess = frame.xi + np.array([0.0, 1e-3, 0.0])
    row = np.array([1.0, 0.0, 0.0])

    # With a column of the derivative that is too small, as next to a singular matrix, the step is as much too long.
    matrix = np.vstack([frame.jacobian(guess), row])
    step = np.linalg.solve(matrix, np.append(-frame.residual(guess), 0.0))
    wrong = np.ones(3)
    wrong[unknown] = step[unknown] / 2000.0
    right = problem.jacobian
    monkeypatch.setattr(problem, "jacobian", lambda arc: right(arc) * wrong)
    counts = []
    check = Flow.check

    def noted(limited: Flow, steps: float) -> int:
        # Before an arc begins it is asked with the least number of steps, which are not made.
        if isinstance(steps, int):
            counts.append(steps)
        return check(limited, steps)

    monkeypatch.setattr(Flow, "check", noted)
    attempt = frame.solve(guess, row, row @ guess)

    assert attempt.left_domain
    assert attempt.reason == f"an arc of more than {MOST_LONGER * first} steps, {REASON}"
    assert max(counts, default=0) <= MOST_LONGER * first + 1
    # With the right derivative the method converges: each attempt has limits of its own.
    monkeypatch.setattr(problem, "jacobian", right)
    assert frame.solve(guess, row, row @ guess).converged


OWN = {
    "masses": [1.0, 1.0],
    "springs": [{"start": 0, "end": 1, "stiffness": 1.0}, {"start": 1, "end": 2, "stiffness": 1.0}],
    "smooth": [{"start": 0, "end": 1, "cubic": 0.5}],
}


def followed(folder: Path, stop: StopRequest | None = None, **nnm: Any) -> Branch[Any]:
    """The lower branch of two masses in ``folder``, begun or continued."""
    folder.mkdir(exist_ok=True)
    nnm = {"modes": [1], "start_energy": 0.1, "points": 8, "first_step": 0.05} | nnm
    case = NnmCase.from_table({"name": "x", "nnm": {"system": "own", "own": OWN} | nnm})
    (branch,) = follow_all(case, folder, MPI.COMM_SELF, resume=True, stop=stop)
    return branch


class StopWithin(StopRequest):
    """A request to stop that is granted within an arc, after so many ``looks``, of which it counts ``seen``."""

    def __init__(self, looks: float = np.inf) -> None:
        self.looks = looks
        self.seen = 0

    @property
    def requested(self) -> bool:
        self.seen += 1
        return self.seen > self.looks


def test_a_branch_that_is_stopped_within_an_arc_goes_on_to_the_same_bits(tmp_path, monkeypatch):
    """Requests are looked at after each step of the flow: the branch keeps its last point, and goes on from there."""
    monkeypatch.setattr(flow, "ENTRIES_BETWEEN_LOOKS", 1)
    bounds = {"energy": [0.05, 50.0]}
    never = StopWithin()
    whole = followed(tmp_path / "whole", never, **bounds)
    assert never.seen > 50 * len(whole.points)

    endings = []
    for looks in (20, 0.4 * never.seen, 0.3 * never.seen):
        stopped = followed(tmp_path / "parts", StopWithin(looks), **bounds)
        endings.append(stopped.ended.sentence)
        assert not stopped.complete
        # The second request comes in the branch, whose points are kept.
        if len(endings) == 2:
            assert 1 < len(read_branch(tmp_path / "parts" / "branch-in-phase.h5").points) < len(whole.points)
    # The first request comes in the search for the start.
    assert endings[0] == "stopped on request; continue with --resume"
    assert all(ending.startswith("stopped on request after point") for ending in endings[1:])
    resumed = followed(tmp_path / "parts", **bounds)

    assert resumed.ended.sentence == whole.ended.sentence
    names = {path.name for path in (tmp_path / "whole").iterdir()}
    assert names == {path.name for path in (tmp_path / "parts").iterdir()}
    (name,) = (name for name in names if name.endswith("h5"))
    assert_same_bits(datasets(tmp_path / "whole" / name), datasets(tmp_path / "parts" / name))
