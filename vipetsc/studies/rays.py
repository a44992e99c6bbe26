r"""Energy that a site sends out and that dashpots and absorbing ends leave, along the rays of its waves.

A wave of a band at the wavenumber kappa travels with its group velocity v, is reflected by ends that do not absorb, and
goes round a ring. Dashpots of the cell take its energy at the rate 2 gamma = -2 Re s, exactly (``damped_bloch``); those
that a cell n has beyond them, of an absorbing end, at phi* C_n phi in addition, with the mass-normalised vector phi of
the wave without dashpots: their first order, which is enough for ends that absorb without reflection. With the depth

    d(tau) = integral of both rates over the ray's cells until tau after it was sent, exp(-d) of the energy is left,

and what the ends have taken is the integral of their rate times exp(-d). Half of the energy goes to either side.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.case import Model
from vipetsc.lattice import bloch
from vipetsc.lattice.damped import damped_bloch

# Bins of the wavenumber in a band, in each of which waves are one ray. With half as many energies change by 0.003
# decades, a hundredth of the prediction's own error, with twice as many by 0.001, and in twice the CPU time.
BINS = 48
# Steps of a ray over the whole run. With half as many energies change by 1e-4 decades and the CPU time by a fifth, with
# twice as many by less than 1e-4 decades and by a half.
STEPS = 1024


class Left(NamedTuple):
    """Fractions of the energy of waves that are left, and that absorbing ends have taken, at the end of the run.

    Both are over the instants at which the energy was sent, ``remaining`` as the last axis.
    """

    remaining: np.ndarray
    absorbed: np.ndarray


class Rays:
    """The rays in the lattice of a ``model`` with dashpots; ``time`` (t,) in s are instants at which energy is sent.

    After ``model.end`` nothing is sent.
    """

    def __init__(self, model: Model, time: np.ndarray) -> None:
        self.model = model
        chain = model.chain
        self.age = np.linspace(0.0, model.end, STEPS)
        self.since = np.clip(model.end - time, 0.0, model.end)
        # Dashpots to ground that cells have beyond those of the reference cell.
        grounding = chain.coefficients(0, chain.cells).grounding
        self.extra = grounding - np.array(chain.cell.grounding or np.zeros(chain.cell.dofs))
        self.bins = np.pi * (np.arange(BINS) + 0.5) / BINS

    def of_bands(self, site: int, spectrum: np.ndarray) -> Left:
        """Fractions (band, time) that are left of the energy that a ``site`` (cell) sends into the bands.

        Of that in a band the fraction ``spectrum`` (band, bin) is in each bin of the wavenumber.
        """
        remaining, absorbed = self._fractions(site, self.bins)
        return Left(np.einsum("bk,bkt->bt", spectrum, remaining), np.einsum("bk,bkt->bt", spectrum, absorbed))

    def of_wave(self, site: int, band: int, kappa: float) -> Left:
        """Fractions (time,) that are left of the energy that a ``site`` (cell) sends into one wave."""
        remaining, absorbed = self._fractions(site, np.array([kappa]))
        return Left(remaining[band, 0], absorbed[band, 0])

    def rate(self, band: int, kappa: float) -> float:
        """Rate in 1/s at which dashpots of the cell take the energy of a wave."""
        return float(-2 * damped_bloch(self.model.chain.cell, kappa).rate.real[band])

    def _fractions(self, site: int, kappas: np.ndarray) -> Left:
        """Fractions (band, kappa, time) that are left of the energy that a ``site`` (cell) sends into each wave."""
        chain = self.model.chain
        point = bloch(chain.cell, kappas)
        speed = np.abs(point.group_velocity).T
        everywhere = -2 * damped_bloch(chain.cell, kappas).rate.real.T
        in_ends = np.einsum("nd,kdb->bkn", self.extra, np.abs(point.vectors) ** 2)

        remaining = np.zeros((*speed.shape, STEPS))
        absorbed = np.zeros_like(remaining)
        step = self.age[1]
        for side in (1, -1):
            cells = self._cells(site + side * speed[..., None] * self.age)
            rate = np.take_along_axis(in_ends, cells, axis=-1)
            # Trapezoids: the rate of an end changes from cell to cell, and a step is a part of a cell.
            in_step = step * (rate[..., 1:] + rate[..., :-1]) / 2
            all_in_step = in_step + step * everywhere[..., None]
            left = np.exp(-_from_first(np.cumsum(all_in_step, axis=-1)))
            remaining += left / 2
            # Of what is lost in a step the ends get their part of the depth.
            part = np.divide(in_step, all_in_step, out=np.zeros_like(in_step), where=all_in_step > 0)
            absorbed += _from_first(np.cumsum(-np.diff(left, axis=-1) * part, axis=-1)) / 2
        return Left(self._sent_at(remaining), self._sent_at(absorbed))

    def _cells(self, position: np.ndarray) -> np.ndarray:
        """The cell at each ``position`` along a line that goes on: through a ring again, or back from an end."""
        count = self.model.chain.cells
        cells = np.rint(position).astype(int)
        if self.model.chain.ends == "periodic":
            return cells % count
        there_and_back = cells % (2 * count)
        return np.minimum(there_and_back, 2 * count - 1 - there_and_back)

    def _sent_at(self, values: np.ndarray) -> np.ndarray:
        """The ``values`` (..., age) at the ages that energy has reached at the end of the run: (..., time)."""
        place = self.since / self.age[1]
        # The last age has no later one to interpolate to.
        before = np.minimum(place.astype(int), STEPS - 2)
        weight = place - before
        return np.asarray(values[..., before] * (1 - weight) + values[..., before + 1] * weight)


def _from_first(values: np.ndarray) -> np.ndarray:
    """The ``values`` (..., step) at the ends of steps, with 0 at the begin of the first: (..., age)."""
    return np.concatenate([np.zeros_like(values[..., :1]), values], axis=-1)
