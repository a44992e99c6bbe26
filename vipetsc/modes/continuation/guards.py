"""Guards: bounds on what may change from one point of a branch to the next, by which jumps to another arc are noticed.

The points of both arcs satisfy the equations to rounding, so that residuals do not distinguish them. Arcs that lie
close together, as in neighbouring tongues of internal resonances, differ in their half-traces c = (mu + 1/mu)/2 of the
Floquet multipliers mu, in their contacts, or in their direction. A jump between arcs that differ in none of these by
more than the bounds is not noticed.

Bounds on half-traces and contacts also keep steps so short that few special points are missed. Along the in-phase
branch of the paper's model with Hertz's law, up to 6 GJ, 83 of 316 grazing points and 47 of 197 branch points lie in
pairs within one step without them, and are not found; folds and the branch itself are the same.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from vipetsc.case.nnm_table import NnmTable
from vipetsc.modes.departures import Departure, changed_families
from vipetsc.modes.point import Point
from vipetsc.modes.problem import PeriodicProblem

# The change that a guard limits, for messages, and the key with its bound.
GUARDED = {
    "half_trace": ("the half-trace changes too much", "nnm.guards.half_trace"),
    "contacts": ("too many contacts appear or disappear", "nnm.guards.contacts"),
    "corrector": ("the corrector moves too far", "nnm.guards.corrector"),
    "turn": ("the branch turns too sharply", "nnm.guards.turn"),
    "turn_relative": ("the branch turns too sharply in the relative chart", "nnm.guards.turn_relative"),
    "truncation": ("the neglected harmonics are too large", "nnm.harmonics or nnm.truncation"),
}
# A change of these within its bound is no reason for a shorter step: such changes do not shrink with the step.
ALL_OR_NOTHING = {"contacts", "turn_relative", "truncation"}


class OrbitProblem(PeriodicProblem[Point], Protocol):
    """Equations whose solutions are orbits with contacts, as ``largest_change`` asks them."""

    def departures(self, point: Point) -> Sequence[Departure]:
        """The times in the arc of an orbit in which contacts are not what they are at rest; all ranks must call it.

        Raises FlowError if the arc cannot be integrated.
        """

    def grazing(self, point: Point) -> list[int]:
        """The numbers, from 1, of contacts that graze in an orbit, where they are looked for.

        All ranks must call it. Raises FlowError if the arc cannot be integrated.
        """

    def acceleration(self, point: Point) -> float:
        """The largest acceleration where an orbit rests, over that of a harmonic motion of the same size and period.

        It is 0 at an equilibrium, and infinite where no rest of the orbit is known. All ranks must call it.
        """


class GuardedChange(NamedTuple):
    """Largest change in a step over the bound of its ``guard``; 1 is the bound."""

    size: float
    guard: str


def largest_change(
    problem: OrbitProblem, control: NnmTable, before: Point, after: Point, geometry: dict[str, float]
) -> GuardedChange:
    """The largest change of a step, from ``before`` to ``after``, over its bound in ``control``.

    ``geometry`` has the fields of ``Geometry``: ``corrector`` and ``turn``. Which other changes are guarded
    ``problem.guards`` says. All ranks must call it: contacts may be looked for on all of them.
    """
    changes = {"contacts": contact_changes(problem, before, after, control.guards.contacts), **geometry}
    if "half_trace" in problem.guards:
        changes["half_trace"] = half_trace_change(before, after)
    if "turn_relative" in problem.guards:
        changes["turn_relative"] = problem.turn(before, after)
    if "truncation" in problem.guards:
        changes["truncation"] = after.truncation / control.truncation

    worst = GuardedChange(-np.inf, "")
    for guard, change in changes.items():
        # The truncation has been divided by its bound above, which is no key of [nnm.guards]. A bound of 0 switches a
        # guard off.
        bound = getattr(control.guards, guard, 1.0) or np.inf
        size = change / bound
        # A change that cannot be computed counts as beyond any bound.
        if np.isnan(size):
            size = np.inf
        if guard in ALL_OR_NOTHING and size <= 1:
            size = 0.0
        if size > worst.size:
            worst = GuardedChange(size, guard)
    return worst


def contact_changes(problem: OrbitProblem, before: Point, after: Point, allowed: int) -> int:
    """The number of contact episodes that appear or disappear between two points.

    If there are more than ``allowed``, those that are images of one another by a symmetry count once. In a lattice that
    is its own mirror image, or with equal stops on both sides, contacts begin in pairs along the whole branch
    (``modes.departures``): a shorter step does not separate them, and they are no sign of a jump. Images are looked for
    in that case alone, since this needs the arcs of both orbits again.
    """
    change = abs(after.episodes - before.episodes)
    if change <= allowed or not allowed:
        return change
    return changed_families(problem.departures(before), problem.departures(after))


def half_trace_change(a: Point, b: Point) -> float:
    """Hausdorff distance between the sets of asinh(c) of two points, c their half-traces.

    It is the largest distance of a half-trace of one point from the nearest one of the other. Half-traces may meet and
    turn into a complex pair, so that they have no lasting order in which to compare them. 0 for one degree of freedom,
    which has none.
    """
    distance = np.abs(_squashed(a.half_traces)[:, None] - _squashed(b.half_traces)[None, :])
    return float(max(distance.min(axis=axis, initial=np.inf).max(initial=0.0) for axis in (0, 1)))


def _squashed(c: np.ndarray) -> np.ndarray:
    """asinh(|c|) with the phase of c, for complex c (...).

    It grows as the logarithm of a large |c|, so that relative changes are compared. asinh(c) itself has branch cuts on
    the imaginary axis, across which it jumps.
    """
    size = np.maximum(np.abs(c), np.finfo(float).tiny)
    return c * (np.arcsinh(size) / size)
