"""Location of special points between two points of a branch; their kinds are defined by the problem."""

from vipetsc.modes.continuation.segment import Segment
from vipetsc.modes.point import Point
from vipetsc.modes.problem import NoMotionError, PeriodicProblem, S, SpecialKind

# Two special points of a kind are one within this fraction of a segment: each is found to 1e-10 of it.
SAME = 1e-9


def locate(
    problem: PeriodicProblem[S],
    left: S,
    right: S,
    chart: str = "relative",
    grazing: bool = False,
    before: S | None = None,
    missed: list[str] | None = None,
) -> list[S]:
    """Special points between two consecutive points of a branch, in order; their ``index`` is the right one's.

    Their kinds, each with a test function that vanishes there, are those of ``problem.special_kinds``. ``chart`` is as
    for ``Continuation``. With ``grazing`` every change of the number of contacts is located as well, which takes about
    40 corrections where it must be bracketed. With the point ``before`` the left one, two special points of one kind
    within the step are found as well. For each special point that cannot be located a sentence is appended to
    ``missed``.

    An energy fold has a half-trace of 1, as a branch point has. In a step with an energy fold no branch point is
    therefore looked for: it would be the fold again.
    """
    points: list[S] = []
    segment = Segment(problem, chart, left, right)
    for kind in problem.special_kinds(left, right):
        if kind.name == "grazing" and not grazing:
            continue
        if kind.name == "branch-point" and any(p.kind == "fold-energy" for p in points):
            continue
        try:
            roots = segment.roots(kind, before)
            # Contacts that begin at one point, by a symmetry, make one special point.
            points += [p for p in roots if not _is_among(p, kind.name, points, segment.length)]
        except NoMotionError as error:
            if missed is not None:
                missed.append(f"a {kind.name} after {left.describe()} is not located: {error}")
    return sorted(points, key=lambda p: p.step)


def _is_among(point: S, kind: str, others: list[S], length: float) -> bool:
    """Whether one of the ``others`` is the same point of that kind, on a segment of that ``length``."""
    return any(other.kind == kind and abs(other.step - point.step) <= SAME * length for other in others)


def at_energy(
    problem: PeriodicProblem[Point], left: Point, right: Point, energy: float, chart: str = "relative"
) -> Point:
    """The orbit of an ``energy`` in J between two consecutive points with less and with more of it.

    It is a point of the kind "regular". Raises NoMotionError if Newton's method fails.
    """
    kind: SpecialKind[Point] = SpecialKind("regular", lambda p: p.energy / energy - 1)
    return Segment(problem, chart, left, right).root(kind)
