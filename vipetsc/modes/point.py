"""One point of a branch: a periodic orbit with its energy, stability and contacts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vipetsc.modes.chart import Chart, Relative
from vipetsc.modes.orbit import Arc
from vipetsc.modes.shooting import Attempt, Corrector, Shooting
from vipetsc.modes.stability import stability


@dataclass(frozen=True, eq=False)
class Point:
    """A periodic orbit on a branch.

    ``x`` (n,) initial displacements in m (velocities in m/s for maps from the centre), ``period`` in s,
    ``energy`` in J, ``residual`` scaled, ``half_traces`` (n - 1,), ``multiplier`` the largest modulus,
    ``episodes`` contact episodes of the arc, ``closed`` the fraction of the time with a contact closed,
    ``tangent`` d(x, period) (n + 1,) of any length, ``slope`` df/dE in Hz/J along it, ``newton`` steps, ``step``
    the arclength that led here, ``kind`` regular or the name of a special point,
    ``resonance`` k of the k:1 tongue that an energy fold belongs to (0: not told).
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
    tangent: np.ndarray | None = None
    slope: float = np.nan
    rise: float = np.nan
    index: int = 0
    step: float = 0.0
    kind: str = "regular"
    resonance: int = 0

    @property
    def frequency(self) -> float:
        """Frequency in Hz."""
        return 1 / self.period

    @classmethod
    def of(
        cls,
        problem: Shooting,
        attempt: Attempt,
        chart: Chart,
        tangent: np.ndarray | None = None,
        index: int = 0,
        step: float = 0.0,
        kind: str = "regular",
    ) -> Point:
        """The point that a converged attempt found."""
        x, period = chart.decode(attempt.xi)
        arc: Arc = attempt.arc
        found = stability(problem, arc)
        scale = problem.residual_scale(float(np.abs(x).max()), period)
        rise = slope = np.nan
        if tangent is not None:
            rise = float(problem.energy_gradient(x) @ tangent[:-1])
            slope = float(-tangent[-1] / period**2 / rise) if rise else np.inf
        return cls(
            x=x,
            period=period,
            energy=problem.energy(x),
            residual=float(np.abs(problem.residual(arc)).max()) / scale,
            half_traces=found.half_traces,
            multiplier=found.largest,
            episodes=arc.episodes,
            closed=arc.closed / arc.duration,
            newton=attempt.newton,
            tangent=tangent,
            slope=slope,
            rise=rise,
            index=index,
            step=step,
            kind=kind,
        )


def linear_start(corrector: Corrector, mode: int, energy: float) -> Point:
    """The periodic orbit of linear mode ``mode`` (0-based) at a small ``energy`` in J, corrected.

    Raises
    ------
    ValueError
        If the mode has no stiffness, or Newton does not converge from the linear mode at that energy.
    """
    problem = corrector.problem
    omega, shapes = problem.system.linear_modes()
    if not omega[mode] > 0:
        raise ValueError(f"mode {mode + 1} is a rigid-body motion; it has no period")
    amplitude = np.sqrt(2 * energy) / (omega[mode] if problem.map.start == "rest" else 1.0)
    x, period = shapes[:, mode] * amplitude, 2 * np.pi / omega[mode]
    chart = Relative(problem.system, x, period)
    xi = chart.encode(x, period)
    row = np.append(unit_row(x), 0.0)  # keep the amplitude
    attempt = corrector.solve(chart, xi, row, row @ xi)
    if not attempt.converged:
        history = " ".join(f"{r:.1e}" for r in attempt.history)
        raise ValueError(
            f"no periodic orbit near linear mode {mode + 1} at E = {energy:g} J "
            f"({attempt.reason}; residuals {history}): "
            "lower nnm.start_energy"
        )
    return Point.of(problem, attempt, chart)


def unit_row(x: np.ndarray) -> np.ndarray:
    """x over its length."""
    return x / np.linalg.norm(x)
