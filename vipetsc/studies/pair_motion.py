"""The relative motion w = u_resonator - u_host of contact pairs in a recorded run, its maximum, and its contacts."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import xarray as xr
from scipy.interpolate import CubicHermiteSpline

from vipetsc.lattice.sites import Pair


class PairMotion(NamedTuple):
    """Relative motion of pairs of masses, as those that contacts join.

    ``displacement`` (time, pair) is w in m, resonator less host, ``velocity`` (time, pair) its rate in m/s, at ``time``
    in s.
    """

    time: np.ndarray
    displacement: np.ndarray
    velocity: np.ndarray

    @classmethod
    def between(cls, run: xr.Dataset, columns: Sequence[int], pairs: Sequence[Pair]) -> Self:
        """Return motion of ``pairs``, each with its host in one of the ``columns`` of the recorded cells of a ``run``.

        A pair that joins cells has its resonator in the next column, behind the last one in the first.
        """

        def relative(name: str) -> np.ndarray:
            field = run[name].values
            return np.stack([pair.relative(field, column) for column, pair in zip(columns, pairs, strict=True)], axis=1)

        return cls(time=run["time"].values, displacement=relative("displacement"), velocity=relative("velocity"))

    def reached(self, gaps: Sequence[tuple[float, float]] | np.ndarray) -> list[float]:
        """Return the largest w (pair) on either side, at or between the samples, over the clearance there.

        ``gaps`` (pair) are the clearances on the sides + and -, in any unit.
        """
        pairs = zip(self.displacement.T, self.velocity.T, gaps, strict=True)
        return [largest_between(self.time, w, rate, sides) for w, rate, sides in pairs]


def largest_between(
    times: np.ndarray, w: np.ndarray, rate: np.ndarray, gaps: tuple[float, float] = (1.0, 1.0)
) -> float:
    """Return the largest of w and -w at or between samples at ``times``, over the ``gaps`` of both sides; at least 0.

    It is that of the cubic through ``w`` (time,) in m with slopes ``rate`` (time,) in m/s.
    """
    # The run has the rates. The error of the cubic through both is of fourth order in the interval between samples; the
    # largest sample alone misses a peak by an error of second order.
    curve = CubicHermiteSpline(times, w, rate)
    extrema = curve.derivative().roots(extrapolate=False)
    # A piece on which w is constant has NaN for its root.
    candidates = np.concatenate([times, extrema[np.isfinite(extrema)]])
    values = curve(candidates)
    plus, minus = gaps
    return float(max(values.max() / plus, -values.min() / minus, 0.0))


class ContactSpan(NamedTuple):
    """The times in s between which the contacts of a run act: ``first`` begins one, ``last`` ends one; NaN without any.

    A contact that is closed when the run ends lasts until then.
    """

    first: float
    last: float

    @classmethod
    def of(cls, run: xr.Dataset) -> Self:
        """Return the span of all contacts in the log of a ``run``."""
        onset = run["impacts/onset"].values
        if not len(onset):
            return cls(first=np.nan, last=np.nan)
        # The log has NaN for the separation of a contact that is still closed.
        separation = np.nan_to_num(run["impacts/separation"].values, nan=float(run["time"][-1]))
        return cls(first=float(onset.min()), last=float(separation.max()))
