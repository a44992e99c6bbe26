"""Energies of the pass bands and gaps: over time in one run, and against the amplitude over a sweep (paper, A3)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.panels import panel_title
from vipetsc.figures.study import (
    MeasuredRun,
    Study,
    configuration_heading,
    configuration_stem,
    grouped,
    law_name,
    member_heading,
    member_stem,
    transfer_members,
)
from vipetsc.figures.transfer_curves import TransferCurve, transfer_curves

GAPS = (style.DASHED, (0, (1, 1.5)), (0, (4, 1.5, 1, 1.5)), (0, (6, 3)))
DECADES = 6
LARGEST_ERROR = 0.01
LEAST_SHARE = 1e-3  # of the largest total: the error is not judged below


def band_energies(study: Study) -> Iterator[Drawing]:
    """Energies of all parts and their sum over time for every whole member; mean shares for every sweep."""
    for member in transfer_members(study):
        if member.analysis.sizes["bands/part"] and member.analysis.sizes["time"] > 1:
            yield member_stem(member.case), partial(energies_over_time, member)
    with_shares = (curve for curve in transfer_curves(study) if "bands/share" in curve.data)
    for name, curves in grouped(with_shares, lambda curve: configuration_stem(curve.case)).items():
        yield f"shares-{name}", partial(shares, sorted(curves, key=lambda c: c.case.contacts.law, reverse=True))


def closing_error(parts: np.ndarray, total: np.ndarray, samples: int) -> np.ndarray:
    """|sum of ``parts`` (part, t) - ``total`` (t)| over the total, each a running mean over ``samples`` (t').

    Energies beat twice a period, and so do the cross terms that a sum of parts lacks: a mean over a period of the
    drive is what an energy of a part means. NaN where the total is below 1e-3 of its largest.
    """
    samples = max(min(samples, len(total)), 1)
    window = np.full(samples, 1.0 / samples)
    whole = np.convolve(total, window, "valid")
    error = np.abs(np.convolve(parts.sum(axis=0), window, "valid") - whole)
    above_threshold = whole > LEAST_SHARE * whole.max()
    return np.divide(error, whole, out=np.full_like(whole, np.nan), where=above_threshold)


def energies_over_time(member: MeasuredRun) -> Figure:
    """The parts and their sum against the total (mean over a period of the drive), and how far they miss it."""
    analysis = member.analysis
    time, parts, total = (analysis[name].values for name in ("time", "bands/energy", "bands/total"))
    names = list(np.atleast_1d(analysis["bands/energy"].attrs["parts"]))
    samples = max(round(2 * np.pi / member.model.drive.frequency / (time[1] - time[0])), 1)
    time, mean_total, mean_sum, *mean_parts = (
        np.convolve(values, np.full(samples, 1.0 / samples), "valid")
        for values in (time, total, parts.sum(axis=0), *parts)
    )
    figure = style.new_figure(style.PAGE * 0.8, 4.2, member_heading(member.case), left=True)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.4, 1))
    for line, name, part in zip(_lines(names), names, mean_parts, strict=True):
        upper.plot(time, part, label=name, **line)
    upper.plot(time, mean_total, color=style.BLACK, lw=1.6, label="total")
    upper.plot(time, mean_sum, color=style.YELLOW, lw=0.8, ls="--", label="sum of parts")
    top = total.max() or 1.0
    upper.set(yscale="log", ylim=(top * 10.0**-DECADES, 3 * top), ylabel="Kinetic energy (J)")
    upper.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=6.5)
    panel_title(upper, "(a) Parts of the frequency axis, mean over a period of the drive")

    error = closing_error(parts, total, samples)
    lower.plot(time, 100 * np.maximum(error, 1e-12), color=style.BLUE, lw=0.7)
    lower.axhline(100 * LARGEST_ERROR, color=style.VERMILION, lw=0.7, ls="--")
    whole = abs(parts.sum() / (total.sum() or 1.0) - 1)
    below = np.mean(error[np.isfinite(error)] <= LARGEST_ERROR)
    text = f"whole record: {100 * whole:.2g} %; at most 1 % for {100 * below:.3g} % of the time"
    lower.text(0.5, 0.93, text, ha="center", va="top", fontsize=6.5, transform=lower.transAxes)
    lower.set(yscale="log", ylim=(1e-4, 1e3), xlim=analysis["time"][[0, -1]], xlabel="Time (s)", ylabel="Error (%)")
    panel_title(lower, "(b) Sum of the parts against the total")
    return figure


def shares(curves: Sequence[TransferCurve]) -> Figure:
    """Mean share of every part after the wave's arrival against the amplitude; a column a law."""
    width = style.PAGE if len(curves) > 1 else 4.6
    figure = style.new_figure(width, 2.7, configuration_heading(curves[0].case), left=True)
    panels = figure.subplots(1, len(curves), sharey=True, squeeze=False)[0]
    for i, (axes, curve) in enumerate(zip(panels, curves, strict=True)):
        _shares(axes, curve)
        panel_title(axes, f"({'abcdef'[i]}) {law_name(curve.case)}")
    panels[0].set_ylabel("Mean share of the energy (1)")
    panels[-1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=6.5)
    return figure


def _shares(axes: Axes, curve: TransferCurve) -> None:
    share = curve.data["bands/share"]
    names = list(np.atleast_1d(share.attrs["parts"]))
    for line, name, part in zip(_lines(names), names, share.values.T, strict=True):
        axes.plot(curve.amplitude, np.maximum(part, 1e-300), label=name, **line)
    axes.plot(curve.amplitude, share.values.sum(axis=1), color=style.BLACK, lw=0.6, ls=":", label="sum")
    axes.set(xscale="log", yscale="log", ylim=(10.0**-DECADES, 2), xlabel="Amplitude of the drive (N)")


def _lines(names: Sequence[str]) -> Iterator[dict[str, Any]]:
    """A colour for each pass band, grey dashes for each gap and for what lies above."""
    bands, gaps = cycle(style.SERIES), cycle(GAPS)
    for name in names:
        is_band = name.startswith("band")
        yield {"color": next(bands), "lw": 1.0} if is_band else {"color": style.GREY, "lw": 0.7, "ls": next(gaps)}
