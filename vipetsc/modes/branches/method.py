"""Interface of the methods that find branches: problems, starts, and additions to points and files."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar, Generic, NamedTuple

import numpy as np

from vipetsc.endings import Ended
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.continuation.arclength import StepRule
from vipetsc.modes.problem import NoMotionError, PeriodicProblem, S, SpecialKind
from vipetsc.parallel import StopRequest

Monitor = Callable[[S], Ended | None]


def value_kind(
    name: str, value: float, quantity: Callable[[S], float], accept: Callable[[S], bool] | None = None
) -> SpecialKind[S]:
    """Return points where the ``quantity`` of that ``name`` has a ``value``; their kind is ``name@value``."""
    size = abs(value) or 1.0
    # Names of kinds are separated by blanks in files.
    kind = f"{'_'.join(name.split())}@{value:.12g}"
    return SpecialKind(kind, lambda point: (quantity(point) - value) / size, accept=accept)


class CrossingBranch(NamedTuple):
    """A branch that crosses another one, or an isolated one near it.

    ``start`` finds its problem and first point when it is followed; ``rule(problem, first, done)`` gives the steps and
    the end of one that has ``done`` regular points after its start.
    """

    name: str
    start: Callable[[], tuple[PeriodicProblem[Any], Any]]
    rule: Callable[[PeriodicProblem[Any], Any, int], StepRule[Any]]


class Method(ABC, Generic[S]):
    """A method that finds the branches of one case, which ``jobs`` numbers from 0 on.

    ``kind`` is the kind of their files. ``failures`` end a branch and not the program. ``keeps_empty``: a branch
    without points leaves a file that says why. ``finishes_files_alone``: the additions to a branch (``finish``) are of
    no use without a file, as in a search, whose branches stay in memory. ``locates``: special points are looked for
    between the regular ones, those where a contact grazes only with ``locates_grazing``. ``counts_start``: the start is
    one of the points of which the case gives the largest number.
    """

    kind: ClassVar[str]
    # Where the derivative is singular a motion has no unique tangent.
    failures: ClassVar[tuple[type[Exception], ...]] = (NoMotionError, np.linalg.LinAlgError)
    counts_start: ClassVar[bool] = False
    keeps_empty: ClassVar[bool] = True
    finishes_files_alone: ClassVar[bool] = False
    locates_grazing: bool = False
    locates: bool = True

    def __init__(self, case: Any) -> None:
        self.case = case

    @staticmethod
    def jobs(case: Any) -> list[int]:
        """Return numbers of a case's branches: of modes from 0, or of start frequencies."""
        if case.nnm.start_frequency:
            return list(range(len(case.nnm.start_frequency)))
        return [mode - 1 for mode in case.nnm.modes]

    @abstractmethod
    def new_branch(self, name: str) -> Branch[S]:
        """Return a branch without points."""

    @abstractmethod
    def name(self, job: int) -> str:
        """Return the name of a branch."""

    @abstractmethod
    def problem(self, job: int) -> PeriodicProblem[S]:
        """Return the equations of a branch."""

    @abstractmethod
    def start(self, problem: PeriodicProblem[S], job: int, stop: StopRequest | None = None) -> S:
        """Return first point of a branch; StoppedError is raised where that takes long and a ``stop`` is requested."""

    def computed(self, job: int) -> list[S] | None:
        """Return all points of a branch that needs no continuation; None of others, which are followed."""
        return None

    def findings(self, job: int, points: list[S]) -> list[str]:
        """Return sentences on the ``points`` of a branch that needs no continuation."""
        return []

    @abstractmethod
    def rule(self, problem: PeriodicProblem[S], start: S, done: int) -> StepRule[S]:
        """Return steps and end of a branch that has ``done`` regular points after its start."""

    @property
    def directions(self) -> tuple[int, ...]:
        """1 if a branch is followed from its start towards growing energy, -1 towards falling energy; both make two."""
        return (1,)

    def assess(self, problem: PeriodicProblem[S], point: S) -> S:
        """Return the point with the quantities of its file that continuation does not need."""
        return point

    def chosen(self, problem: PeriodicProblem[S]) -> list[SpecialKind[S]]:
        """Return the kinds of points that the case asks for, beside special ones: where a quantity has a value."""
        return []

    def monitor(self, problem: PeriodicProblem[S]) -> Monitor[S]:
        """Return a check of every new point: an ending ends the branch, None lets it go on."""
        return lambda point: None

    def finish(self, problem: PeriodicProblem[S], branch: Branch[S]) -> None:
        """Add the variables of a branch's file that are not of its points, also where it failed or was stopped."""

    def further(self, branch: Branch[S], followed: Sequence[Branch[S]]) -> Iterator[CrossingBranch]:
        """Return the branches that cross a branch, and isolated ones near it, that the case asks for.

        ``followed`` has those that were followed so far, when the next one is asked for.
        """
        return iter(())
