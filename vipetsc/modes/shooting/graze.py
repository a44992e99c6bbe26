"""Grazing: the orbit of a branch in which a contact just touches, by Newton's method with the touch as two equations.

Along the branch two changes of a contact, an onset and a separation in either order, come together and vanish. Where
they meet, at the time t, w is the clearance D on the side s, and w' = 0. With t as one more unknown the orbit solves

    H(xi) = 0,    s w(t; xi) = D,    w'(t; xi) = 0,

and the flow's sensitivities give all derivatives. If the touch is at the start of an arc at rest, w' = 0 holds there
for every orbit, and t stays 0.
"""

from collections.abc import Iterator
from typing import NamedTuple, Self

import numpy as np

from vipetsc.modes.problem import FlowError, NoMotionError
from vipetsc.modes.shooting.charts import DenseChart, Grazing
from vipetsc.modes.shooting.flow import Arc
from vipetsc.modes.shooting.maps import ShootingMap
from vipetsc.modes.shooting.orbit import ShotOrbits

# Newton steps at most; on the branches of the paper's model and of three cells touches take three to five. Where they
# are not enough, the caller brackets the touch instead.
MOST_STEPS = 10
# A longer Newton step, in unknowns of order one, counts as divergence. On the way to 37 touches of these branches the
# longest step is 0.04, and the time stays below 0.7 of the arc: neither this number nor LATEST acts there.
FURTHEST = 0.5
# Newton's method ends after a step below this: the next one would be its square, which is rounding.
CLOSE = 1e-9
# On the way the time may pass the end of the arc, in whose last instant a contact may touch, by this factor.
LATEST = 1.1
# At the touch itself the flow would search for a change of contact. The orbit is therefore integrated until this
# fraction of the time is left, and a parabola, whose error is rounding, leads on to the touch.
SHORT = 1e-6


class Touch(NamedTuple):
    """Two changes of a ``contact`` on one ``side`` (1 or -1), a time ``apart`` in s, about the ``time`` in s."""

    apart: float
    time: float
    contact: int
    side: int

    @classmethod
    def nearest(cls, arc: Arc, shooting_map: ShootingMap) -> Self:
        """The two neighbouring changes of an arc that are nearest to each other.

        Without any, the time is NaN, with which ``graze`` raises NoMotionError.
        """
        pairs = cls.neighbours(arc, shooting_map.starts_at_rest, shooting_map.ends_at_rest)
        return min(pairs, default=cls(apart=0.0, time=np.nan, contact=0, side=0))

    @classmethod
    def neighbours(cls, arc: Arc, rest_before: bool, rest_after: bool) -> Iterator[Self]:
        """Neighbouring changes of a contact on one side.

        An arc that starts or ends at rest goes on there as its mirror image, with one more change.
        """
        for contact in np.unique(arc.events[:, 1]).astype(int):
            times, _, sides, _ = arc.events[arc.events[:, 1] == contact].T
            if rest_before:
                times = np.append(-times[0], times)
                sides = np.append(sides[0], sides)
            if rest_after:
                times = np.append(times, 2 * arc.duration - times[-1])
                sides = np.append(sides, sides[-1])
            for i in np.flatnonzero(sides[1:] == sides[:-1]):
                yield cls(
                    apart=times[i + 1] - times[i],
                    time=(times[i] + times[i + 1]) / 2,
                    contact=contact,
                    side=int(sides[i]),
                )


def graze(problem: ShotOrbits, chart: DenseChart, guess: np.ndarray, touch: Touch) -> np.ndarray:
    """Unknowns (n + 1,) of the orbit near ``guess`` where the two changes of a ``touch`` meet.

    Raises NoMotionError if Newton's method fails, as it does if the time of the ``touch`` is NaN.
    """
    xi = guess
    time = touch.time
    try:
        for _ in range(MOST_STEPS):
            matrix, values, duration = _equations(problem, chart, xi, touch._replace(time=time))
            *step, later = np.linalg.solve(matrix, -values)
            size = float(np.linalg.norm(step))
            xi = xi + step
            time = time + later

            if not (size <= FURTHEST and 0 <= time <= LATEST * duration):
                raise NoMotionError("Newton's method diverges")
            if size <= CLOSE:
                return xi
    except (FlowError, np.linalg.LinAlgError) as error:
        raise NoMotionError(error) from error
    raise NoMotionError(f"the touch is not found: last step {size:.1e}")


def _equations(
    problem: ShotOrbits, chart: DenseChart, xi: np.ndarray, touch: Touch
) -> tuple[np.ndarray, np.ndarray, float]:
    """Derivatives (n + 2, n + 2) and values (n + 2,) of the equations, and the arc's duration in s.

    The unknowns are ``xi`` and the time of the ``touch``.
    """
    system = problem.system
    n = system.dofs
    pair = system.contacts[touch.contact]
    row = touch.side * system.contact_rows[touch.contact] / pair.stops.clearance_on(touch.side)
    x, period = chart.decode(xi)
    arc = problem.arc(x, period)
    inner = chart.derivative(xi)

    # The state just before the touch, and a parabola on to it.
    part = problem.flow.arc(arc.start, (1 - SHORT) * touch.time, period)
    remaining = SHORT * touch.time
    u, v = np.split(part.end, 2)
    du, dv = np.split(part.sensitivity[:, problem.free] @ inner[:-1], 2)
    pull = -system.forces(u) / system.masses
    u = u + remaining * (v + remaining / 2 * pull)
    v = v + remaining * pull

    # Rows: the orbit's equations, s w = D over D, and w' = 0 over D; columns: the chart's unknowns, and the time.
    matrix = np.zeros((n + 2, n + 2))
    end_unit = chart.size * problem.map.end_unit(chart.period)
    matrix[:n, :-1] = problem.jacobian(arc) @ inner / end_unit
    matrix[n] = np.append(row @ du, row @ v)
    matrix[n + 1] = np.append(row @ dv, row @ pull)
    values = np.array([*problem.residual(arc) / end_unit, row @ u - 1, row @ v])

    if touch.time == 0 and isinstance(chart, Grazing) and (chart.contact, chart.sign) == (touch.contact, touch.side):
        # The gap's root is an unknown of this chart, and the gap is stationary in it at the touch.
        matrix[n] = np.eye(n + 2)[chart.index]
        values[n] = xi[chart.index]
    return matrix, values, arc.duration
