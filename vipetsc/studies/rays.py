r"""Energy of the waves that a site sends out, and what dashpots and absorbing ends take of it along the waves' rays.

A wave of a band with the wavenumber kappa travels at its group velocity v. An end that does not absorb reflects it, and
it goes round a ring. Two rates in 1/s say how fast its energy fades:

- The dashpots of the reference cell take 2 gamma = -2 Re s, with the complex rate s of the damped wave
  (``damped_bloch``). This is exact.
- A cell n of an absorbing end has more dashpots than the reference cell. These, C_n in N s/m, take phi* C_n phi, with
  the mass-normalised vector phi of the wave without dashpots. This is of first order in C_n, which is enough for ends
  that absorb without reflection.

The depth d(tau) is the integral of both rates along the ray, from the time at which the energy was sent to tau later.
Then exp(-d) of the energy is left, and the ends have taken the integral of their rate times exp(-d). Half of the energy
of a site goes to either side.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.case import Model
from vipetsc.lattice import bloch
from vipetsc.lattice.damped import damped_bloch

# Bins of the wavenumber in a band; the waves of a bin share one ray. With half as many bins predicted energies change
# by 0.003 decades, a hundredth of the prediction's own error. Twice as many change them by 0.001 decades and take twice
# the CPU time.
BINS = 48
# Steps of a ray over the whole run. Half as many change energies by 1e-4 decades and save a fifth of the CPU time.
# Twice as many change them by less than 1e-4 decades and take half as much CPU time again.
STEPS = 1024


class RayFractions(NamedTuple):
    """Fractions of the energy that was sent: ``remaining`` in waves at the end of the run, ``absorbed`` by its ends.

    The last axis of both is the instant at which the energy was sent. What is missing from 1 was taken by the dashpots
    of the reference cells.
    """

    remaining: np.ndarray
    absorbed: np.ndarray


class Rays:
    """The rays in the lattice of a ``model`` with dashpots; ``time`` (t,) in s are instants at which energy is sent.

    The run ends at ``model.end``; energy sent later counts as sent at the end, so that all of it remains. ``since``
    (t,) in s is the time from each instant to the end of the run. ``extra`` (cell, dof) in N s/m are the dashpots to
    ground beyond those of the reference cell.
    """

    def __init__(self, model: Model, time: np.ndarray) -> None:
        self.model = model
        chain = model.chain
        self.age = np.linspace(0.0, model.end, STEPS)
        self.since = np.clip(model.end - time, 0.0, model.end)
        grounding = chain.coefficients(0, chain.cells).grounding
        self.extra = grounding - np.array(chain.cell.grounding or np.zeros(chain.cell.dofs))
        # The middles of the bins.
        self.bins = np.pi * (np.arange(BINS) + 0.5) / BINS

    def of_bands(self, site: int, spectrum: np.ndarray) -> RayFractions:
        """Return fractions (band, time) of the energy that a ``site`` (cell, from 0) sends into the bands.

        ``spectrum`` (band, bin) is how the energy of a band is divided between the ``BINS`` of the wavenumber.
        """
        remaining, absorbed = self._fractions(site, self.bins)
        return RayFractions(
            remaining=np.einsum("bk,bkt->bt", spectrum, remaining), absorbed=np.einsum("bk,bkt->bt", spectrum, absorbed)
        )

    def of_wave(self, site: int, band: int, kappa: float) -> RayFractions:
        """Return the share (time,) of the energy that a ``site`` (cell, from 0) sends into a wave of a ``band``."""
        remaining, absorbed = self._fractions(site, np.array([kappa]))
        return RayFractions(remaining=remaining[band, 0], absorbed=absorbed[band, 0])

    def rate(self, band: int, kappa: float) -> float:
        """Return the rate in 1/s at which reference dashpots take the energy of a wave of a ``band`` (from 0)."""
        return float(-2 * damped_bloch(self.model.chain.cell, kappa).rate.real[band])

    def _fractions(self, site: int, kappas: np.ndarray) -> RayFractions:
        """Return fractions (band, kappa, time) of the energy that a ``site`` (cell, from 0) sends into each wave."""
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
        return RayFractions(remaining=self._sent_at(remaining), absorbed=self._sent_at(absorbed))

    def _cells(self, position: np.ndarray) -> np.ndarray:
        """Return the cell at each ``position`` of a ray, in cells along a straight line without end."""
        count = self.model.chain.cells
        cells = np.rint(position).astype(int)
        if self.model.chain.ends == "periodic":
            return cells % count
        # Between two ends the ray repeats itself after the way there and back.
        there_and_back = cells % (2 * count)
        return np.minimum(there_and_back, 2 * count - 1 - there_and_back)

    def _sent_at(self, values: np.ndarray) -> np.ndarray:
        """Return the ``values`` (..., age) at the ages that energy has reached at the end of the run: (..., time)."""
        place = self.since / self.age[1]
        # The last age has no later one to interpolate to.
        before = np.minimum(place.astype(int), STEPS - 2)
        weight = place - before
        return np.asarray(values[..., before] * (1 - weight) + values[..., before + 1] * weight)


def _from_first(values: np.ndarray) -> np.ndarray:
    """Return ``values`` (..., step) at the ends of steps, after a 0 for the beginning of the first one: (..., age)."""
    return np.concatenate([np.zeros_like(values[..., :1]), values], axis=-1)
