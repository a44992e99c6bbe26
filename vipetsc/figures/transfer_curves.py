"""Inter-band transfer against the amplitude of the drive, from a sweep."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case import Case
from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.members import configuration
from vipetsc.figures.study import Study
from vipetsc.io.ensemble_file import EnsembleFile

LINES = ((style.BLUE, "o"), (style.VERMILION, "s"), (style.GREEN, "^"), (style.PURPLE, "D"), (style.ORANGE, "v"))
FEWEST = 6  # amplitudes that make a curve


@dataclass(frozen=True)
class TransferCurve:
    """IBTET (amplitude) of one law, reading and configuration, NaN where a member failed; ``case`` stands for them.

    ``floor`` is the transfer without any contact, NaN if every member touches. ``share`` (amplitude, part) may be
    None; ``parts`` are its names.
    """

    case: Case
    amplitude: np.ndarray
    ibtet: np.ndarray
    floor: float
    share: np.ndarray | None
    parts: tuple[str, ...]

    @property
    def peak(self) -> int:
        """Index of the largest transfer."""
        return int(np.nanargmax(self.ibtet))


def transfer_curves(study: Study, fewest: int = FEWEST) -> Iterator[TransferCurve]:
    """The curves of all sweeps with at least ``fewest`` amplitudes whose transfer is known."""
    for ensemble in study.ensembles:
        if "ibtet" in ensemble:
            yield from (c for c in _curves(ensemble) if np.isfinite(c.ibtet).sum() >= fewest)


def _curves(ensemble: EnsembleFile) -> Iterator[TransferCurve]:
    ibtet, episodes = ensemble.values("ibtet"), ensemble.values("contact_episodes")
    share = ensemble.values("bands/share") if "bands/share" in ensemble else None
    parts = tuple(ensemble.file["bands/share"].attrs["parts"]) if share is not None else ()
    for case, index in ensemble.curves("amplitude"):
        if not case.contacts.sites:
            continue
        amplitude = ensemble.values("amplitude")
        order = np.argsort(amplitude)
        untouched = ibtet[index][episodes[index] == 0]
        floor = float(untouched.mean()) if untouched.size else np.nan
        own = share[index][order] if share is not None else None
        yield TransferCurve(case, amplitude[order], ibtet[index][order], floor, own, parts)


def ibtet(study: Study) -> Iterator[Drawing]:
    """The paper's Fig. Ejump, one page a reading: laws in columns, linear and log-log scales in rows."""
    pages: dict[str, list[TransferCurve]] = {}
    for curve in transfer_curves(study):
        pages.setdefault(curve.case.lattice.reading, []).append(curve)
    for reading, curves in pages.items():
        yield reading, partial(_page, reading, curves)


def _page(reading: str, curves: list[TransferCurve]) -> Figure:
    laws = sorted({c.case.contacts.law for c in curves}, reverse=True)
    kinds = list(dict.fromkeys(configuration(c.case) for c in curves))
    width = style.PAGE if len(laws) > 1 else style.COLUMN
    figure = style.new_figure(width, 4.6)
    table = figure.subplots(2, len(laws), sharey="row", squeeze=False)
    for column, law in enumerate(laws):
        own = [c for c in curves if c.case.contacts.law == law]
        linear, logarithmic = table[:, column]
        for axes in (linear, logarithmic):
            _draw(axes, own, kinds)
        inset = linear.inset_axes([0.40, 0.30, 0.57, 0.64])
        _draw(inset, own, kinds, size=1.8)
        nearest = min(c.amplitude[np.nonzero(c.ibtet > 0.1 * c.ibtet[c.peak])[0][0]] for c in own)
        inset.set(xlim=(0.0, max(10 * nearest, 2 * max(c.amplitude[c.peak] for c in own))))
        inset.set_ylim(0, 1.18 * max(c.ibtet[c.peak] for c in own))
        inset.tick_params(labelsize=6, pad=1.5)
        for place, curve in enumerate(own):
            _mark_peak(inset, curve, kinds, place)
        linear.set(xlim=(0, None), ylim=(0, None))
        logarithmic.set(xscale="log", yscale="log", ylim=(None, 6.0))
        for row, axes in enumerate((linear, logarithmic)):
            axes.set_xlabel("Amplitude of the drive (N)")
            style.letter(axes, f"({'ab'[column % 2]}.{row + 1}) {law.capitalize()}, {reading}")
        logarithmic.legend(loc="upper right", fontsize=6)
    for axes in table[:, 0]:
        axes.set_ylabel("Inter-band transfer (1)")
    return figure


def _draw(axes: Axes, curves: list[TransferCurve], kinds: list[str], size: float = 2.2) -> None:
    for curve in curves:
        kind = configuration(curve.case)
        colour, mark = LINES[kinds.index(kind) % len(LINES)]
        axes.plot(curve.amplitude, curve.ibtet, color=colour, marker=mark, ms=size, lw=0.7, label=kind)
        if np.isfinite(curve.floor):
            axes.axhline(curve.floor, color=colour, lw=0.6, ls=(0, (4, 3)), zorder=1)


def _mark_peak(axes: Axes, curve: TransferCurve, kinds: list[str], place: int) -> None:
    """A ring round the largest value, and what it is, the ``place``-th line from the top."""
    colour, _ = LINES[kinds.index(configuration(curve.case)) % len(LINES)]
    at = curve.amplitude[curve.peak], curve.ibtet[curve.peak]
    axes.plot(*at, "o", mfc="none", mec=colour, ms=6, mew=0.7)
    text = f"largest: {at[1]:.3f} at {at[0]:.3g} N"
    axes.text(0.97, 0.95 - 0.11 * place, text, ha="right", va="top", fontsize=6, color=colour, transform=axes.transAxes)
