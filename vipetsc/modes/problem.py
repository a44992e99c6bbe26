"""Interface between continuation and a method: n equations in n + 1 unknowns, and their solutions.

A ``PeriodicProblem`` is a system together with a method (shooting, harmonic balance) whose solutions form branches. At
a point of a branch it gives a ``Frame``: unknowns xi of order one, in which a step is taken and corrected.
Continuation, the location of special points and the files of branches use nothing else of a method.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from vipetsc.parallel import StopRequest


class NoMotionError(RuntimeError):
    """There is no periodic motion here, or Newton's method does not find it. Nothing else counts as "not found"."""


class FlowError(NoMotionError):
    """The equations cannot be evaluated at these unknowns, as where a flow does not cover the requested time."""


class ContinuationError(NoMotionError):
    """The branch cannot begin or go on; the message says where, why, and which key to change."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """A point of a branch, with what continuation needs in order to go on from it.

    ``tangent`` is the branch's direction in the units of the unknowns, of any length, and empty where a branch begins;
    ``index`` counts regular points, ``step`` is the arclength of the step that led here and ``next_step`` that of the
    step after it; ``kind`` is "regular" or the name of a special point.
    """

    tangent: np.ndarray
    index: int
    step: float
    next_step: float
    kind: str

    def describe(self) -> str:
        """Return the point's number, for messages."""
        return f"point {self.index}"


@dataclass(eq=False)
class Attempt:
    """Outcome of Newton's method: ``history`` of residual norms, ``reason`` why it stopped, last ``xi``.

    ``left_domain`` says that the equations could not be evaluated; ``xi`` is then the guess.
    """

    converged: bool
    reason: str
    history: list[float]
    xi: np.ndarray
    left_domain: bool = False

    @property
    def residuals(self) -> str:
        """The history as text."""
        return " ".join(f"{r:.1e}" for r in self.history) or "none"


S = TypeVar("S", bound=Solution)


@dataclass(frozen=True)
class SpecialKind(Generic[S]):
    """A kind of special point: where ``test`` changes sign, by more than a ``floor`` on both sides.

    ``accept`` says whether a point that was found is of the kind, where the test alone does not tell. ``finish``
    (point, left, right) adds the quantities that only such points have. A ``corner`` of the branch is the end
    of a step at which the test is negative.
    """

    name: str
    test: Callable[[S], float]
    floor: float = 0.0
    accept: Callable[[S], bool] | None = None
    finish: Callable[[S, S, S], S] | None = None
    corner: bool = False


@dataclass(frozen=True)
class Corner(Generic[S]):
    """A corner of a branch at a ``point``, whose tangent is that of the branch beyond.

    The branch goes on as the point + s tangent + s^2 ``bend`` for small s >= 0, with tangent and bend (n + 1,).
    """

    point: S
    bend: np.ndarray


class Frame(Protocol[S]):
    """Unknowns ``xi`` (n + 1,) of order one at and near a point of a branch, and the unit ``tangent`` there."""

    xi: np.ndarray
    tangent: np.ndarray

    def encode(self, point: S) -> np.ndarray:
        """Return the unknowns (n + 1,) of another point of the branch."""

    def direction(self, point: S) -> np.ndarray:
        """Return the branch's direction (n + 1,) at another point, of any length, in these unknowns."""

    def correct(self, guess: np.ndarray, arclength: float) -> Attempt:
        """Solve for the solution at an ``arclength`` along the tangent, from ``guess`` (n + 1,)."""

    def tangent_at(self, xi: np.ndarray) -> np.ndarray:
        """Return the unit tangent (n + 1,) at a solution ``xi`` (n + 1,), on the side of the frame's own."""

    def measures(self, attempt: Attempt, direction: np.ndarray) -> S:
        """Return the point that an attempt has converged to, where ``direction`` (n + 1,) is the unit tangent."""


class PeriodicProblem(ABC, Generic[S]):
    """Equations whose solutions form branches.

    ``guards`` says which changes from point to point are guarded (``continuation.arclength``), and ``tolerance`` is
    that of Newton's method. Where the search for a point takes long it is given up, by StoppedError, if a ``stop`` is
    requested.
    """

    tolerance: float
    guards: frozenset[str] = frozenset()
    stop: StopRequest | None = None

    @contextmanager
    def stopped_by(self, stop: StopRequest) -> Iterator[None]:
        """Return a block in which the search for a point can be stopped."""
        self.stop = stop
        try:
            yield
        finally:
            self.stop = None

    @abstractmethod
    def frame(self, point: S, chart: str = "auto") -> Frame[S]:
        """Return the frame at ``point``, which has a tangent, in the ``chart`` of that name where there is a choice."""

    @abstractmethod
    def first_tangent(self, start: S, direction: int) -> np.ndarray:
        """Return tangent at the first point, along which energy (or parameter) grows (``direction`` 1) or falls (-1).

        Raises ContinuationError where the tangent is not unique.
        """

    def turn(self, before: S, after: S) -> float:
        """Return the angle in rad between the tangents of two points in relative units; 0 where there is one chart."""
        return 0.0

    def turned_at_corner(self, point: S) -> Corner[S] | None:
        """Return the corner of the branch at a ``point``; None where it has none."""
        return None

    @abstractmethod
    def special_kinds(self, left: S, right: S) -> Iterator[SpecialKind[S]]:
        """Return kinds of special points that may lie between two neighbouring points of a branch."""


def unit(vector: np.ndarray) -> np.ndarray:
    """Return the vector (n,) divided by its length."""
    return vector / np.linalg.norm(vector)


def nearest_on_chords(
    place: np.ndarray, starts: np.ndarray, ends: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the positions (0 to 1) on chords nearest to ``place``, the distances there, and the lengths of chords."""
    chords = ends - starts
    squared = np.einsum("ij,ij->i", chords, chords)
    # Two equal points leave a chord without a length: the floor makes its position 0 and not a NaN.
    position = np.clip(np.einsum("ij,ij->i", place - starts, chords) / np.maximum(squared, 1e-300), 0, 1)
    distance = np.linalg.norm(starts + position[:, None] * chords - place, axis=1)
    return position, distance, np.sqrt(squared)
