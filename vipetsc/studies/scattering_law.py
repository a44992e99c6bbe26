"""The scattering law of one site: the fractions into which it divides a wave's energy, over the wave's amplitude."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vipetsc.io.netcdf import open_netcdf
from vipetsc.studies.linear_run import LinearRun

FORWARD, BACKWARD = 0, 1  # directions: from the drive to the site and on, and the other
LEAST = 0.02  # least loss 1-T of the driven wave at which the efficiency U/(1-T) is judged: below, it is 0 over 0
NEAR = 5  # cells from the site within which energy counts as near it: evanescent waves have decayed beyond
# Relative differences of the efficiency that are within its scatter: in the built-in lattice it is 0.42 to 0.46 from
# the onset to z = 1.3.
FLAT = 0.1
# Half the width in log z over which the efficiency is averaged: a design has to bear such an error of a clearance.
BROAD = 0.05
# Values of z in the printed table: near the onset the law changes with z - 1, far above it with log z.
LISTED = (1.01, 1.1, 1.5, 3.0, 10.0, 30.0, 100.0)

POINT_LAYOUT = {
    "transmitted": ("z", "1", "transmitted fraction in the driven band"),
    "reflected": ("z", "1", "reflected fraction in the driven band"),
    "upper": ("z", "1", "fraction transferred to the bands above the driven one"),
    "share": ("z band direction", "1", "outgoing fraction by band and direction"),
    "dissipated": ("z", "1", "dissipated fraction"),
    "contact": ("z", "1", "fraction stored in a closed contact at the end"),
    "dashpots": ("z", "1", "fraction that dashpots take at the site, where waves overlap"),
    "onset": ("z", "s", "time of the first contact"),
    "separation": ("z", "s", "time at which the last contact ends"),
    "release": ("z", "1", "linear envelope over the clearance at the end of the last contact"),
}
DAMPED = {"dashpots"}  # fractions that the file of a lattice without dashpots does not have
LAYOUT = {
    "z": ("z", "1", "largest relative displacement of the linear wave at the site, over the clearance"),
    "band": ("band", "1", "band, from 1"),
    "direction": ("direction", "1", "forward: from the drive to the site and beyond; backward"),
    "time": ("time", "s", "time"),
    "envelope": ("time", "m/N", "sqrt(w^2 + (w'/Om)^2) of the linear wave at the site under 1 N"),
    "amplitude": ("z", "N", "amplitude of the drive; in m of a moved wall"),
    "episodes": ("z", "1", "contact episodes"),
    "near": (
        "z",
        "1",
        f"twice the kinetic energy within {NEAR} cells of the site at the end, included in the fractions",
    ),
    "interpolation_error": ("z", "1", "largest deviation of a fraction from the line between its previous neighbours"),
    "efficiency": (
        "z",
        "1",
        "U/(1-T), both averaged over 5 % of z on either side; 0 where the driven wave loses little",
    ),
    **POINT_LAYOUT,
    **{f"{name}_scatter": (dims, unit, f"deviation: {text}") for name, (dims, unit, text) in POINT_LAYOUT.items()},
}


class ScatteringOutcome(NamedTuple):
    """Outcome of a wave at one site, as arrays (...) over z.

    Energies are fractions of what arrives in the drive's band. ``share`` (..., band, direction) is what leaves the site
    in each band, forward (0) and backward (1); in the drive's band these are ``transmitted`` and ``reflected``, and
    ``upper`` is the sum over the bands above it. With what is ``dissipated`` in the contact, what a ``contact`` that is
    still closed holds at the end, and what the ``dashpots`` at the site take, the whole ``share`` adds up to 1.

    ``onset`` and ``separation`` are the times in s at which the first contact begins and the last one ends, NaN without
    any; a contact that is closed at the end of a run lasts until then. ``release`` is the linear envelope over the
    clearance at ``separation``.
    """

    share: np.ndarray
    transmitted: np.ndarray
    reflected: np.ndarray
    upper: np.ndarray
    dissipated: np.ndarray
    contact: np.ndarray
    dashpots: np.ndarray
    onset: np.ndarray
    separation: np.ndarray
    release: np.ndarray


@dataclass(frozen=True)
class ScatteringLaw:
    """The law at points ``z`` (z,): largest relative displacement of the linear wave at the site, over the clearance.

    ``mean`` and ``scatter`` hold arrays over the points: mean and standard deviation over runs with amplitudes a little
    apart. ``drive_band`` counts from 0; ``clearance`` is in m. Under 1 N the linear wave at the site reaches ``peak``
    in m, and has the envelope ``linear_envelope`` (time,), sqrt(w^2 + (w'/Om)^2) in m, at ``linear_time`` (time,) in s.
    ``about`` are the attributes of ``law.h5``.
    """

    z: np.ndarray
    mean: ScatteringOutcome
    scatter: ScatteringOutcome
    drive_band: int
    clearance: float
    peak: float
    linear_time: np.ndarray
    linear_envelope: np.ndarray
    about: Mapping[str, Any]

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Return the law in a file ``law.h5``; raises OSError or ValueError if it is none."""
        with open_netcdf(path, "law", ("share", "drive_band")) as data:
            return cls.of(data)

    @classmethod
    def of(cls, data: xr.Dataset) -> Self:
        """Return the law in the content ``data`` of ``law.h5``."""
        # Fractions that a lattice does not have (``DAMPED``) are not in its file.
        none = xr.zeros_like(data["dissipated"])
        mean = {name: data.get(name, none).values for name in ScatteringOutcome._fields}
        scatter = {name: data.get(f"{name}_scatter", none).values for name in ScatteringOutcome._fields}
        return cls(
            z=data["z"].values,
            mean=ScatteringOutcome(**mean),
            scatter=ScatteringOutcome(**scatter),
            drive_band=int(data.attrs["drive_band"]) - 1,
            clearance=float(data.attrs["clearance"]),
            peak=float(data.attrs["peak"]),
            linear_time=data["time"].values,
            linear_envelope=data["envelope"].values,
            about=data.attrs,
        )

    def at(self, z: ArrayLike) -> ScatteringOutcome:
        """Return the outcome of a wave at ``z`` (any shape), interpolated linearly in log z.

        Below the first point, at which nothing is touched yet, and above the last one the outcome is that of the point.
        """
        return self._interpolated(self.mean, z)

    def deviation(self, z: ArrayLike) -> ScatteringOutcome:
        """Return the scatter at ``z`` (any shape), interpolated as ``at`` interpolates the mean."""
        return self._interpolated(self.scatter, z)

    def _interpolated(self, values: ScatteringOutcome, z: ArrayLike) -> ScatteringOutcome:
        """Return the ``values`` of the points at ``z`` (any shape), as ``at`` has them."""
        x = np.log(np.clip(np.asarray(z, float), self.z[0], self.z[-1]))
        grid = np.log(self.z)
        right = np.clip(np.searchsorted(grid, x), 1, len(grid) - 1)
        weight = (x - grid[right - 1]) / (grid[right] - grid[right - 1])

        def between(array: np.ndarray) -> np.ndarray:
            w = weight.reshape(weight.shape + (1,) * (array.ndim - 1))
            mixed = (1 - w) * array[right - 1] + w * array[right]
            # Exactly the point's value at a point, and no NaN of its neighbour.
            return np.where(w == 0, array[right - 1], np.where(w == 1, array[right], mixed))

        return ScatteringOutcome(*map(between, values))

    def efficiency(self) -> np.ndarray:
        """Return the efficiency of the transfer (z,): U/(1-T), both averaged over 5 % of z on either side.

        It is 0 where the driven wave loses less than ``LEAST`` at any z of that range.
        """
        neighbourhood = np.exp(np.linspace(-BROAD, BROAD, 41))[:, None] * self.z
        outcome = self.at(neighbourhood)
        lost = 1 - outcome.transmitted
        mean_efficiency = outcome.upper.mean(axis=0) / lost.mean(axis=0).clip(LEAST)
        return np.where(lost.min(axis=0) > LEAST, mean_efficiency, 0.0)

    def matched(self) -> tuple[float, float]:
        """Return the best amplitude z* for the transfer to upper bands, and the transmitted fraction T there.

        The efficiency U/(1-T) is flat about its maximum. Of the points within 10 % of it, z* is the one with the
        largest T, which leaves most for further sites. Raises ValueError if no energy is transferred.
        """
        efficiency = self.efficiency()
        if not efficiency.any():
            raise ValueError("it transfers no energy to bands above the driven one")

        near_best = efficiency >= (1 - FLAT) * efficiency.max()
        best = int(np.argmax(np.where(near_best, self.mean.transmitted, -np.inf)))
        return float(self.z[best]), float(self.at(self.z[best]).transmitted)

    def summary(self) -> list[tuple[str, str]]:
        """Return rows (name, text) of a table on the law: its ring, the packet, its points, some of its values."""
        about = self.about
        mean = self.mean
        sums = mean.share.sum(axis=(1, 2)) + mean.dissipated + mean.contact + mean.dashpots
        arrives = f"at {about['arrival']:.4g} s, {about['spread']:.4g} times as long as the burst"
        rows = [
            ("ring", f"{about['cells']} cells, site at {about['distance']}, clearance {self.clearance:.5g} m"),
            ("packet", f"{arrives}; {about['under_way']:.1e} of its energy has not passed the site at the end"),
            (
                "points",
                f"{len(self.z)} from z = 1 to {self.z[-1]:g}; fractions sum to 1 within {abs(sums - 1).max():.0e}",
            ),
        ]
        if "taken_before" in about:
            taken = f"take {about['taken_before']:.3g} of the wave before the site"
            rows.append(("dashpots", f"{taken}, up to {np.abs(mean.dashpots).max():.2g} at the site"))
        rows += [(f"z = {z:g}", self._fractions_at(z)) for z in LISTED if z < self.z[-1]]

        best = "no energy is transferred to bands above the driven one"
        if self.efficiency().any():
            best = f"z* = {about['matched_z']:.4g}, T = {about['matched_transmitted']:.3g}"
        return [*rows, ("matched", best)]

    def _fractions_at(self, z: float) -> str:
        """Return the fractions at ``z`` with their scatter, as text: T, R and U, L dissipated, D taken by dashpots."""
        mean = self.at(z)
        scatter = self.deviation(z)
        symbols = {"T": "transmitted", "R": "reflected", "U": "upper", "L": "dissipated"}
        if "taken_before" in self.about:
            symbols["D"] = "dashpots"
        return ", ".join(
            f"{symbol} {getattr(mean, name):.3f}+-{getattr(scatter, name):.3f}" for symbol, name in symbols.items()
        )


def matched_clearances(law: ScatteringLaw, linear: LinearRun, sites: Sequence[int], amplitude: float) -> np.ndarray:
    """Return clearances (site,) in m with which all ``sites`` (cells from 1, in the order of the wave) operate at z*.

    D_k = A env(s_k) sqrt(T^k)/z* for the site k = 0, 1, ...: the envelope env of the ``linear`` run under 1 N, times
    the ``amplitude`` A in N, times what the k sites before leave of the wave. Raises ValueError as ``matched``.
    """
    z, transmitted = law.matched()
    left = np.sqrt(transmitted ** np.arange(len(sites)))
    return abs(amplitude) * linear.envelope[np.asarray(sites) - 1] * left / z
