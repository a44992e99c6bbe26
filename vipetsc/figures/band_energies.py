"""Energies of the pass bands and gaps: over time in one run, and against the amplitude over a sweep."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import h5py
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.members import configuration, configuration_stem, law_name, stem, title, transfer_members
from vipetsc.figures.study import Study
from vipetsc.figures.transfer_curves import TransferCurve, transfer_curves
from vipetsc.io.run_file import RunFile

BANDS = (style.BLUE, style.VERMILION, style.GREEN, style.PURPLE, style.ORANGE, style.SKY)
GAPS = ((0, (4, 2)), (0, (1, 1.5)), (0, (4, 1.5, 1, 1.5)), (0, (6, 3)))
DECADES = 6
LARGEST_ERROR = 0.01


def band_energies(study: Study) -> Iterator[Drawing]:
    """Energies of all parts and their sum over time for every whole member; mean shares for every sweep."""
    for run, analysis in transfer_members(study):
        if len(analysis["bands/energy"].attrs["parts"]) and len(analysis["time"]) > 1:
            yield stem(run.case), partial(energies_over_time, run, analysis)
    pages: dict[str, list[TransferCurve]] = {}
    for curve in transfer_curves(study):
        if curve.share is not None:
            pages.setdefault(configuration_stem(curve.case), []).append(curve)
    for name, curves in pages.items():
        yield f"shares-{name}", partial(shares, curves)


def closing_error(parts: np.ndarray, total: np.ndarray, samples: int) -> np.ndarray:
    """|sum of ``parts`` (part, t) - ``total`` (t)| over the total, each a running mean over ``samples`` (t').

    Energies beat twice a period, and so do the cross terms that a sum of parts lacks: a mean over a period of the
    drive is what an energy of a part means. NaN where the total is below 1e-3 of its largest.
    """
    samples = max(min(samples, len(total)), 1)
    window = np.full(samples, 1.0 / samples)
    whole = np.convolve(total, window, "valid")
    error = np.abs(np.convolve(parts.sum(axis=0), window, "valid") - whole)
    loud = whole > 1e-3 * whole.max()
    return np.divide(error, whole, out=np.full_like(whole, np.nan), where=loud)


def energies_over_time(run: RunFile, analysis: h5py.File) -> Figure:
    """The parts and their sum against the total (mean over a period of the drive), and how far they miss it."""
    time, energy, total = analysis["time"][...], analysis["bands/energy"][...], analysis["bands/total"][...]
    names = [str(n) for n in analysis["bands/energy"].attrs["parts"]]
    step = time[1] - time[0]
    samples = max(round(2 * np.pi / run.model.drive.frequency / step), 1)
    window = np.full(samples, 1.0 / samples)
    middle = np.convolve(time, window, "valid")
    figure = style.new_figure(style.PAGE * 0.8, 4.2)
    figure.suptitle(title(run.case), fontsize=8, x=0.01, ha="left")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.4, 1))
    for line, name, part in zip(_lines(names), names, energy, strict=True):
        upper.plot(middle, np.convolve(part, window, "valid"), label=name, **line)
    upper.plot(middle, np.convolve(total, window, "valid"), color=style.BLACK, lw=1.6, label="total")
    upper.plot(middle, np.convolve(energy.sum(axis=0), window, "valid"), color=style.YELLOW, lw=0.8, ls="--",
               label="sum of parts")  # fmt: skip
    top = total.max() or 1.0
    upper.set(yscale="log", ylim=(top * 10.0**-DECADES, 3 * top), ylabel="Kinetic energy (J)")
    upper.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=6.5)
    style.letter(upper, "(a) Parts of the frequency axis, mean over a period of the drive")

    error = closing_error(energy, total, samples)
    lower.plot(middle, 100 * np.maximum(error, 1e-12), color=style.BLUE, lw=0.7)
    lower.axhline(100 * LARGEST_ERROR, color=style.VERMILION, lw=0.7, ls="--")
    whole = abs(energy.sum() / (total.sum() or 1.0) - 1)
    below = np.mean(error[np.isfinite(error)] <= LARGEST_ERROR)
    text = f"whole record: {100 * whole:.2g} %; at most 1 % for {100 * below:.3g} % of the time"
    lower.text(0.5, 0.93, text, ha="center", va="top", fontsize=6.5, transform=lower.transAxes)
    lower.set(yscale="log", ylim=(1e-4, 1e3), xlim=time[[0, -1]], xlabel="Time (s)", ylabel="Error (%)")
    style.letter(lower, "(b) Sum of the parts against the total")
    return figure


def shares(curves: Sequence[TransferCurve]) -> Figure:
    """Mean share of every part after the wave's arrival against the amplitude; a column a law."""
    curves = sorted(curves, key=lambda c: c.case.contacts.law, reverse=True)
    figure = style.new_figure(style.PAGE if len(curves) > 1 else 4.6, 2.7)
    case = curves[0].case
    figure.suptitle(f"{case.lattice.reading.capitalize()}, {configuration(case)}", fontsize=8, x=0.01, ha="left")
    panels = figure.subplots(1, len(curves), sharey=True, squeeze=False)[0]
    for i, (axes, curve) in enumerate(zip(panels, curves, strict=True)):
        _shares(axes, curve)
        style.letter(axes, f"({'abcdef'[i]}) {law_name(curve.case)}")
    panels[0].set_ylabel("Mean share of the energy (1)")
    panels[-1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=6.5)
    return figure


def _shares(axes: Axes, curve: TransferCurve) -> None:
    for line, name, share in zip(_lines(curve.parts), curve.parts, curve.share.T, strict=True):
        axes.plot(curve.amplitude, np.maximum(share, 1e-300), label=name, **line)
    axes.plot(curve.amplitude, curve.share.sum(axis=1), color=style.BLACK, lw=0.6, ls=":", label="sum")
    axes.set(xscale="log", yscale="log", ylim=(10.0**-DECADES, 2), xlabel="Amplitude of the drive (N)")


def _lines(names: Sequence[str]) -> Iterator[dict[str, object]]:
    """A colour for each pass band, grey dashes for each gap and for what lies above."""
    bands = gaps = 0
    for name in names:
        if name.startswith("band"):
            yield {"color": BANDS[bands % len(BANDS)], "lw": 1.0}
            bands += 1
        else:
            yield {"color": style.GREY, "lw": 0.7, "ls": GAPS[gaps % len(GAPS)]}
            gaps += 1
