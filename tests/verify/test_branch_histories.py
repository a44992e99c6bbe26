"""Whatever happens to branches on their way, their files are in the end those of branches that nothing happened to.

Hypothesis makes up histories of stops, failures, kills, lost tables and cases that allow more points.
"""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule

from tests.faults.scenarios import difference
from tests.models import KERSCHEN
from vipetsc.case import NnmCase
from vipetsc.modes.branches import follow as following
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.problem import FlowError
from vipetsc.parallel import StopRequest

# One mode, upwards and downwards. By this measure any five points in a row are one point, so that a branch stands still
# at its sixth. Of the orbits that are asked for one is on a branch, and one on none.
SECTION = {
    "modes": [2],
    "direction": "both",
    "start_energy": 1.0,
    "energy": [0.4, 3.0],
    "first_step": 0.05,
    "guards": {"standstill": 5, "advance": 100.0},
    "orbits_at": [1.1, 100.0],
}
FEWEST = 2
MOST = 8
NUMBERS = st.integers(1, 2 * MOST)


def case_of(points: int) -> NnmCase:
    """Return the case of two branches, each of at most so many ``points``."""
    section = SECTION | {"points": points}
    return NnmCase.from_table({"name": "x", "nnm": {"system": "own", "own": KERSCHEN} | section})


def miss(problem: Any, left: Any, right: Any, missed: list[str], **options: Any) -> list[Any]:
    """Stand for a search that locates no special point in a step, and says so: a finding at every step."""
    missed.append(f"a special point after {left.describe()}")
    return []


def follow(points: int, folder: Path, listener: Any = None, stop: StopRequest | None = None) -> None:
    """Follow the branches of at most so many ``points``, whose files are written after every point."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(following, "SAVE_EVERY", 0.0)
        patch.setattr(following, "locate", miss)
        follow_all(case_of(points), folder, MPI.COMM_SELF, resume=True, listener=listener, stop=stop)


@cache
def undisturbed(points: int) -> Path:
    """Return a folder with the branches of at most so many ``points``, to which nothing has happened."""
    folder = Path(tempfile.mkdtemp(prefix="undisturbed-"))
    follow(points, folder)
    return folder


class History(RuleBasedStateMachine):
    """What happens to the files of two branches in a folder."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="history-"))
        self.points = FEWEST

    def follow(self, number: int = 0, event: Callable[[StopRequest], None] | None = None) -> None:
        """Follow the branches, with an ``event`` at the point of that ``number``."""
        stop = StopRequest()
        computed = 0

        def listen(branch: Branch[Any], point: Any) -> None:
            nonlocal computed
            computed += 1
            if event and computed == number:
                event(stop)

        follow(self.points, self.folder, listen, stop)

    @rule(number=NUMBERS)
    def is_stopped(self, number):
        """A request to stop comes at the point of that number."""

        def event(stop: StopRequest) -> None:
            stop.requested = True

        self.follow(number, event)

    @rule(number=NUMBERS)
    def fails(self, number):
        """The method fails at the point of that number, and other branches go on."""

        def event(stop: StopRequest) -> None:
            raise FlowError("the flow ends here")

        self.follow(number, event)

    @rule(number=NUMBERS)
    def is_killed(self, number):
        """A kill at the point of that number leaves what was written until then."""

        def event(stop: StopRequest) -> None:
            raise KeyboardInterrupt

        with suppress(KeyboardInterrupt):
            self.follow(number, event)

    @rule(more=st.integers(0, MOST - FEWEST))
    def goes_on(self, more):
        """The branches are followed to their end, with more points than before."""
        self.points = min(self.points + more, MOST)
        self.follow()

    @rule()
    def loses_a_table(self):
        """A table is lost."""
        for path in sorted(self.folder.glob("*.csv"))[:1]:
            path.unlink()

    def teardown(self) -> None:
        """The same command without a fault leaves the files of an undisturbed one, to the bit."""
        try:
            self.follow()
            for path in self.folder.glob("*.h5"):
                with h5py.File(path, "r+") as file:
                    # A branch that had come to its end is not written again where a later case allows more points.
                    file.attrs["case"] = re.sub(r"(?m)^points = \d+", f"points = {self.points}", file.attrs["case"])
            assert difference(undisturbed(self.points), self.folder) == ""
        finally:
            shutil.rmtree(self.folder)


History.TestCase.settings = settings(
    max_examples=4, stateful_step_count=3, deadline=None, suppress_health_check=list(HealthCheck)
)
TestHistory = History.TestCase
