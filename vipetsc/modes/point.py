"""One point of a branch: a periodic orbit with its energy, stability and contacts, its samples and its resonance."""

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from vipetsc.modes.problem import StartError
from vipetsc.modes.shooting.flow import Arc
from vipetsc.modes.shooting.shooting import Attempt, Chart, Shooting

# An orbit that passes a part of its period again to this share of its size repeats it.
SAME = 1e-6
PRIMES = 2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47

# Quantities of a point: name in the files, type, unit, description.
QUANTITIES: dict[str, tuple[str, type, str, str]] = {
    "energy": ("energy", float, "J", "energy"),
    "frequency": ("frequency", float, "Hz", "frequency"),
    "period": ("period", float, "s", "period"),
    "slope": ("slope", float, "Hz/J", "slope df/dE of the branch"),
    "multiplier": ("multiplier_max", float, "1", "largest modulus of a Floquet multiplier"),
    "residual": ("residual", float, "1", "scaled residual of the shooting equations"),
    "closed": ("closed", float, "1", "fraction of the time with a contact closed"),
    "energy_tangent": ("rise", float, "J", "dE along the tangent"),
    "step": ("step", float, "1", "arclength of the step that led here"),
    "episodes": ("contacts", int, "1", "contact episodes in the arc that is shot"),
    "newton": ("newton", int, "1", "Newton steps"),
    "index": ("number", int, "1", "number of the regular point, or of the one after a special point"),
    "resonance": ("resonance", int, "1", "k of the k:1 tongue of an energy fold; else 1 or 0"),
}


def half_traces(problem: Shooting, arc: Arc) -> np.ndarray:
    """Half-traces c (n - 1,) = (mu + 1/mu)/2 of the basic map's multipliers, the trivial pair left out.

    The basic map is the half period (seen with the sign reversed) for the quarter-period map and the period for the
    others; its diagonal block is derived in the package's docstring. The left eigenvector of its trivial eigenvalue is
    known, so that it is removed exactly. None without the matrix of sensitivities: ``floquet`` does without.
    """
    if not problem.dense:
        return np.empty(0)
    root = np.sqrt(problem.system.masses)
    n, quarter, s = len(root), problem.map.quarter, arc.sensitivity
    a, b, c, d = (root[:, None] * block / root for block in (s[:n, :n], s[:n, n:], s[n:, :n], s[n:, n:]))
    if problem.map.fraction == 1.0:  # the whole period needs no mirror image
        product = (a - np.eye(n)) / 2
    elif problem.map.start == "rest":
        product = d.T @ a if quarter else b.T @ c
    else:
        product = c.T @ b
    if n == 2:  # the trace is more exact than a projection
        rest = np.array([np.trace(product)])
    else:
        centre, u, v = problem.map.start == "centre", arc.start[:n], arc.start[n:]
        trivial = (v if centre else -problem.system.forces(u) / problem.system.masses) * root
        basis = np.linalg.svd(trivial[None, :])[2][1:].T
        rest = np.linalg.eigvals(basis.T @ product @ basis)
    traces = 1 - 2 * rest if quarter else 1 + 2 * rest
    traces = traces[np.argsort(traces.real)]
    return traces.real if np.all(np.abs(traces.imag) == 0) else traces


def multipliers(traces: np.ndarray, quarter: bool) -> np.ndarray:
    """Floquet multipliers (2n - 2,) over the whole period from half-traces (n - 1,)."""
    c = traces.astype(complex)
    root = np.sqrt(c * c - 1)
    mu = np.where(np.abs(c + root) >= np.abs(c - root), c + root, c - root)  # the larger one, no cancellation
    mu = np.concatenate([mu, 1 / mu])
    return mu**2 if quarter else mu


@dataclass(frozen=True, eq=False)
class Point:
    """A periodic orbit on a branch.

    ``x`` (n,) are initial displacements in m (velocities in m/s for maps from the centre), ``half_traces`` (n - 1,),
    ``tangent`` d(x, period) (n + 1,) of any length, empty where a branch begins, ``kind`` is regular or the name of a
    special point; ``multipliers`` (number, 2) are the largest of a lattice's
    and their residuals; the others are ``QUANTITIES``.
    """

    x: np.ndarray
    period: float
    energy: float
    residual: float
    half_traces: np.ndarray
    multiplier: float
    episodes: int
    closed: float
    newton: int
    tangent: np.ndarray = field(default_factory=lambda: np.empty(0))
    slope: float = np.nan
    energy_tangent: float = np.nan
    index: int = 0
    step: float = 0.0
    kind: str = "regular"
    resonance: int = 0
    multipliers: np.ndarray = field(default_factory=lambda: np.empty((0, 2), complex))

    @property
    def frequency(self) -> float:
        """Frequency in Hz."""
        return 1 / self.period

    @classmethod
    def of(cls, problem: Shooting, attempt: Attempt, chart: Chart, direction: np.ndarray | None = None) -> Self:
        """The point of a converged attempt in ``chart``, in which ``direction`` is the branch's tangent."""
        (x, period), arc = chart.decode(attempt.xi), attempt.arc
        assert arc is not None
        traces = half_traces(problem, arc)
        point = cls(
            x=x,
            period=period,
            energy=problem.energy(x),
            residual=float(np.abs(problem.residual(arc)).max()) / float(np.abs(x).max()),
            half_traces=traces,
            multiplier=float(
                np.abs(multipliers(traces, problem.map.quarter)).max(initial=1.0 if problem.dense else np.nan)
            ),
            episodes=arc.episodes,
            closed=arc.closed / arc.duration,
            newton=len(attempt.history) - 1,
        )
        if direction is None:
            return point
        tangent = chart.derivative(attempt.xi) @ direction
        energy_tangent = float(problem.energy_gradient(x) @ tangent[:-1])
        slope = float(-tangent[-1] / period**2 / energy_tangent) if energy_tangent else np.inf
        return replace(point, tangent=tangent, energy_tangent=energy_tangent, slope=slope)


def linear_start(problem: Shooting, mode: int, energy: float) -> Point:
    """The periodic orbit of linear mode ``mode`` (0-based) at a small ``energy`` in J, corrected.

    Raises StartError if the mode has no stiffness, or Newton does not converge from the linear mode at that energy.
    """
    omega, shapes = problem.system.linear_modes()
    if not omega[mode] > 0:
        raise StartError(f"mode {mode + 1} is a rigid-body motion; it has no period")
    amplitude = np.sqrt(2 * energy) / (omega[mode] if problem.map.start == "rest" else 1.0)
    x, period = shapes[:, mode] * amplitude, 2 * np.pi / omega[mode]
    chart = problem.chart("relative", x, period)
    xi = chart.encode(x, period)
    row = np.append(x / np.linalg.norm(x), 0.0)  # keep the amplitude
    attempt = problem.solve(chart, xi, row, row @ xi)
    if not attempt.converged:
        why = f"({attempt.reason}; residuals {attempt.residuals}): lower nnm.start_energy"
        raise StartError(f"no periodic orbit near linear mode {mode + 1} at E = {energy:g} J {why}")
    return Point.of(problem, attempt, chart)


def sample_orbit(problem: Shooting, point: Point, samples: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Displacements in m and velocities in m/s (samples, n) at uniform times, the end of the period left out.

    Only the arc that was shot is integrated; its mirror images make up the period. ``samples`` is a multiple of 4.
    """
    states = [problem.arc(point.x, point.period).start]
    for _ in range(round(problem.map.fraction * samples)):
        states.append(problem.flow.arc(states[-1], point.period / samples, point.period).end)
    u, v = np.hsplit(np.array(states), 2)
    if problem.map.quarter:  # to the centre: odd about it
        u, v = np.vstack([u, -u[-2::-1]]), np.vstack([v, v[-2::-1]])
    if len(u) < samples:  # to a rest (or from centre to centre): mirror image about it
        sign = -1 if problem.map.start == problem.map.end == "centre" else 1
        u, v = np.vstack([u, sign * u[-2::-1]]), np.vstack([v, -sign * v[-2::-1]])
    return u[:samples], v[:samples]


def resonance(problem: Shooting, point: Point, samples: int = 1024) -> int:
    """How often the contacts' relative motion (all displacements without contacts) passes zero in half a period.

    On a tongue of a k:1 internal resonance, mode two moves k times while mode one moves once.
    """
    u, rows = sample_orbit(problem, point, samples)[0], problem.system.contact_rows
    w = u @ rows.T if len(rows) else u
    moving = w[:, np.abs(w).max(axis=0) > SAME * np.abs(w).max()] > 0
    return int(np.sum(moving != np.roll(moving, 1, axis=0), axis=0).max()) // 2


def repetitions(problem: Shooting, point: Point) -> int:
    """The smallest prime number of times that an orbit passes the same motion in its period; 1 for its least period.

    Along a branch from a linear mode it is 1 but where a tongue of an internal resonance crosses the other mode's
    branch: there the orbit is the other mode's, passed k times.
    """
    start, rate = problem.arc(point.x, point.period).start, problem.flow.omega_ref(point.period)
    size = np.abs(start).max() / (1.0 if problem.map.start == "rest" else rate)
    scale = size * np.repeat([1.0, rate], problem.system.dofs)
    for count in PRIMES:
        later = problem.flow.arc(start, point.period / count, point.period).end
        if np.all(np.abs(later - start) <= SAME * scale):
            return count
    return 1
