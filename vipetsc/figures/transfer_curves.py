"""Inter-band transfer against the amplitude of the drive, from a sweep (paper, Fig. 9)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case import Case
from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.panels import panel_title
from vipetsc.figures.study import AMPLITUDE, Study, configuration, grouped, sites_of
from vipetsc.io.read import curves

LINES = ((style.BLUE, "o"), (style.VERMILION, "s"), (style.GREEN, "^"), (style.PURPLE, "D"), (style.ORANGE, "v"))
FEWEST = 6  # amplitudes that make a curve


class TransferCurve(NamedTuple):
    """The measures of one law, reading and configuration over rising amplitude; ``case`` stands for them."""

    case: Case
    data: xr.Dataset

    @property
    def amplitude(self) -> np.ndarray:
        """Amplitudes (amplitude) of the drive in N."""
        return self.data[AMPLITUDE].values

    @property
    def ibtet(self) -> np.ndarray:
        """Inter-band transfer (amplitude), NaN where a member failed."""
        return self.data["ibtet"].values

    @property
    def floor(self) -> float:
        """The transfer without any contact, NaN if every member touches."""
        untouched = self.ibtet[self.data["contact_episodes"].values == 0]
        return float(untouched.mean()) if untouched.size else np.nan

    @property
    def peak(self) -> int:
        """Index of the largest transfer."""
        return int(np.nanargmax(self.ibtet))


def transfer_curves(study: Study, fewest: int = FEWEST) -> Iterator[TransferCurve]:
    """The curves of all sweeps with at least ``fewest`` amplitudes whose transfer is known."""
    for ensemble in study.ensembles:
        for data, folder in curves(ensemble, AMPLITUDE) if "ibtet" in ensemble else ():
            curve = TransferCurve(Case.load(folder / "case.toml"), data.sortby(AMPLITUDE))
            if sites_of(curve.case) and np.isfinite(curve.ibtet).sum() >= fewest:
                yield curve


def ibtet(study: Study) -> Iterator[Drawing]:
    """One page a reading: laws in columns, linear and log-log scales in rows."""
    for reading, of_reading in grouped(transfer_curves(study), lambda curve: curve.case.lattice.reading).items():
        yield reading, partial(_page, reading, of_reading)


def _page(reading: str, of_reading: Sequence[TransferCurve]) -> Figure:
    laws = sorted({c.case.contacts.law for c in of_reading}, reverse=True)
    kinds = dict(zip(dict.fromkeys(configuration(c.case) for c in of_reading), LINES * 5, strict=False))
    figure = style.new_figure(style.PAGE if len(laws) > 1 else style.COLUMN, 4.6)
    grid = figure.subplots(2, len(laws), sharey="row", squeeze=False)
    for column, law in enumerate(laws):
        of_law = [c for c in of_reading if c.case.contacts.law == law]
        linear, logarithmic = grid[:, column]
        for row, axes in enumerate((linear, logarithmic)):
            _draw(axes, of_law, kinds)
            axes.set_xlabel("Amplitude of the drive (N)")
            panel_title(axes, f"({'ab'[column % 2]}.{row + 1}) {law.capitalize()}, {reading}")
        _inset(linear, of_law, kinds)
        linear.set(xlim=(0, None), ylim=(0, None))
        logarithmic.set(xscale="log", yscale="log", ylim=(None, 6.0))
        logarithmic.legend(loc="upper right", fontsize=6)
    for axes in grid[:, 0]:
        axes.set_ylabel("Inter-band transfer (1)")
    return figure


def _inset(axes: Axes, of_law: Sequence[TransferCurve], kinds: dict[str, tuple[str, str]]) -> None:
    """The curves about their peaks: a ring round the largest value of each, and what it is."""
    inset = axes.inset_axes([0.40, 0.30, 0.57, 0.64])
    _draw(inset, of_law, kinds, size=1.8)
    nearest = min(c.amplitude[np.nonzero(c.ibtet > 0.1 * c.ibtet[c.peak])[0][0]] for c in of_law)
    inset.set(xlim=(0.0, max(10 * nearest, 2 * max(c.amplitude[c.peak] for c in of_law))))
    inset.set_ylim(0, 1.18 * max(c.ibtet[c.peak] for c in of_law))
    inset.tick_params(labelsize=6, pad=1.5)
    for line, curve in enumerate(of_law):
        colour, _ = kinds[configuration(curve.case)]
        amplitude, largest = curve.amplitude[curve.peak], curve.ibtet[curve.peak]
        inset.plot(amplitude, largest, "o", mfc="none", mec=colour, ms=6, mew=0.7)
        inset.text(0.97, 0.95 - 0.11 * line, f"largest: {largest:.3f} at {amplitude:.3g} N", ha="right", va="top",
                   fontsize=6, color=colour, transform=inset.transAxes)  # fmt: skip


def _draw(axes: Axes, shown: Sequence[TransferCurve], kinds: dict[str, tuple[str, str]], size: float = 2.2) -> None:
    """The curves, each with its floor dashed; ``kinds`` has colour and mark by configuration."""
    for curve in shown:
        kind = configuration(curve.case)
        colour, mark = kinds[kind]
        axes.plot(curve.amplitude, curve.ibtet, color=colour, marker=mark, ms=size, lw=0.7, label=kind)
        if np.isfinite(curve.floor):
            axes.axhline(curve.floor, color=colour, lw=0.6, ls=(0, (4, 3)), zorder=1)
