"""The relative motion of contact pairs in a recorded run."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import xarray as xr
from scipy.interpolate import CubicHermiteSpline

from vipetsc.lattice import UnitCell


class PairMotion(NamedTuple):
    """Motion of the resonators relative to the hosts of the recorded cells.

    ``displacement`` (time, cell) is w in m, resonator less host, ``velocity`` (time, cell) its rate in m/s, at ``time``
    in s.
    """

    time: np.ndarray
    displacement: np.ndarray
    velocity: np.ndarray

    @classmethod
    def of(cls, run: xr.Dataset, cell: UnitCell, columns: Sequence[int] | slice = slice(None)) -> Self:
        """The motion in a ``run`` with all samples of both fields, in those ``columns`` of its recorded cells."""
        displacement = run["displacement"].values[:, columns]
        velocity = run["velocity"].values[:, columns]
        return cls(
            time=run["time"].values,
            displacement=displacement[..., cell.resonator] - displacement[..., cell.host],
            velocity=velocity[..., cell.resonator] - velocity[..., cell.host],
        )

    def largest(self) -> list[float]:
        """Largest |w| (cell) in m at or between the samples."""
        pairs = zip(self.displacement.T, self.velocity.T, strict=True)
        return [largest_between(self.time, w, rate) for w, rate in pairs]


def largest_between(times: np.ndarray, w: np.ndarray, rate: np.ndarray) -> float:
    """Largest |w| at or between samples at ``times``, from the cubic through ``w`` with slopes ``rate``."""
    curve = CubicHermiteSpline(times, w, rate)
    extrema = curve.derivative().roots(extrapolate=False)
    # A piece on which w is constant has NaN for its root.
    candidates = np.concatenate([times, extrema[np.isfinite(extrema)]])
    return float(np.abs(curve(candidates)).max())
