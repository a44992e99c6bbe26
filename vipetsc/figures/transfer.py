"""Inter-band transfer: nine panels of a run (paper, Figs. 7, S6), dispersions (Fig. 8), energies of bands (A3)."""

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import count, cycle
from pathlib import Path
from string import ascii_lowercase

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from vipetsc.case import Case
from vipetsc.figures import panels, style
from vipetsc.figures.sweep_members import Files, Labels, MeasuredRun, Sweeps, grouped, transfer_members
from vipetsc.figures.transfer_curves import Curve, columns_of_laws, transfer_curves
from vipetsc.io.read import field_interval, field_time, leading_site, nearest_cell
from vipetsc.lattice import pass_bands
from vipetsc.spectra import TAPER, taper

FIELD = "bands/kinetic_energy"  # (band, t, cell)
INPUT_CELL = 5  # the paper's cell before the sites; the one behind them is the middle of the lattice, its cell 150
SEGMENTS = {"dispersion_before": ("Input segment", style.SKY), "dispersion_after": ("Output segment", style.YELLOW)}
ROOM = 1e4  # of a spectrum's axis above its peak, for the time history
GAPS = (style.DASHED, (0, (1, 1.5)), (0, (4, 1.5, 1, 1.5)), (0, (6, 3)))
SHARE_DECADES = 6
LARGEST_ERROR = 0.01
LEAST_SHARE = 1e-3  # of the largest total: the error is not judged below


def transfer(sweeps: Sweeps) -> Iterator[style.Drawing]:
    """For every whole member: energy in space-time, dispersion and spectra before and behind the first site."""
    for member in transfer_members(sweeps):
        if "velocity" in member.run and all(name in member.analysis for name in (FIELD, *SEGMENTS)):
            yield style.Drawing(Labels.of(member.case).member_stem, partial(nine_panels, member))


def nine_panels(member: MeasuredRun) -> Figure:
    """(a) All energy, (b-e) that of every pass band, (f, g) both segments, (h, i) spectra of two cells."""
    run, cell = member.run, member.model.chain.cell
    tags = iter(ascii_lowercase)
    figure = style.new_figure(style.PAGE, 7.6, Labels.of(member.case).member)
    upper, middle, lower = figure.subfigures(3, 1, height_ratios=(1.15, 0.85, 1))
    _space_time(upper, member, tags)
    spectra, maps = panels.below_cutoff(member.analysis, cell, list(SEGMENTS)), middle.subplots(1, 2, sharey=True)
    norm = panels.log_norm(*spectra.values())
    for axes, (name, (label, colour)) in zip(maps, SEGMENTS.items(), strict=True):
        image = panels.dispersion_map(axes, spectra[name], norm, cell)
        axes.set_title(f"({next(tags)}) {label}")
        axes.plot([0.03, 0.03], [0.03, 0.97], color=colour, lw=2.2, transform=axes.transAxes)
        axes.label_outer()
    panels.colour_bar(image, maps, "Energy per bin (J)")
    shown = INPUT_CELL, member.model.chain.cells // 2
    for axes, index in zip(lower.subplots(1, 2, sharey=True), (nearest_cell(run, n) for n in shown), strict=True):
        _spectra(axes, member, run["velocity"][:, index].values)
        axes.set_title(f"({next(tags)}) Velocity spectra, cell {run['cell'].values[index]}")
        axes.label_outer()
    return figure


def _space_time(page: SubFigure, member: MeasuredRun, tags: Iterator[str]) -> None:
    """Kinetic energy of all frequencies beside that of each pass band, to one scale; segments and sites marked."""
    run, energy, fields = member.run, member.analysis["kinetic_energy"], member.analysis[FIELD]
    cells, norm, names = energy["cell"].values, panels.log_norm(energy), member.analysis["bands/energy"].attrs["parts"]
    columns = -(-len(fields) // 2)
    grid = page.add_gridspec(2, 1 + columns, width_ratios=(1.35, *[1.0] * columns))
    whole = page.add_subplot(grid[:, 0])
    image = panels.space_time_map(whole, energy, norm, run)
    whole.set_title(f"({next(tags)}) Kinetic energy")
    for i, field in enumerate(fields):
        axes = page.add_subplot(grid[i // columns, 1 + i % columns], sharex=whole, sharey=whole)
        panels.draw_map(axes, energy["time"].values, cells, field.values.T, norm)
        name = np.atleast_1d(names)[int(field["bands/band"]) - 1]
        axes.set(title=f"({next(tags)}) {name.capitalize()}", xlabel="Time (s)")
        axes.label_outer()
    panels.colour_bar(image, page.axes, "Kinetic energy of a cell (J)", aspect=35)

    across, first = whole.get_yaxis_transform(), run["sites/cell"].values[leading_site(run)]
    spans = (cells[0], first - 1), (first + 1, cells[-1])
    in_order = spans if member.model.drive_cell + 1 <= first else spans[::-1]
    for (name, colour), (low, high) in zip(SEGMENTS.values(), in_order, strict=True):
        whole.plot([0.98, 0.98], [low + 1, high - 1], color=colour, lw=2.2, solid_capstyle="butt", transform=across)
        whole.text(0.955, 0.5 * (low + high), name.split()[0].lower(), color=colour, rotation=90, ha="right",
                   va="center", transform=across)  # fmt: skip


def _spectra(axes: Axes, member: MeasuredRun, velocity: np.ndarray) -> None:
    """Amplitude spectra of the masses of one cell, ``velocity`` (t, dof); pass bands shaded, history inset."""
    cell, step = member.model.chain.cell, field_interval(member.run)
    bands = pass_bands(cell)
    frequency = 2e-3 * np.pi * np.fft.rfftfreq(len(velocity), step)
    spectrum = np.abs(np.fft.rfft(velocity * taper(len(velocity), TAPER)[:, None], axis=0)) * step
    shown = frequency <= 1.1e-3 * bands[-1].high
    panels.shade_bands(axes, ((band.low, band.high) for band in bands), "x")
    for band in bands:
        middle, across = 0.5e-3 * (band.low + band.high), axes.get_xaxis_transform()
        axes.text(middle, 0.02, str(band.number), ha="center", color=style.GREY, transform=across)
    roles = {cell.host: " (host)", cell.resonator: " (resonator)"}
    labels = [f"mass {j + 1}{roles.get(j, '')}" for j in range(cell.dofs)]
    line = {"lw": 0.5, "alpha": 0.85, "rasterized": True}
    axes.plot(frequency[shown], np.maximum(spectrum[shown], 1e-300), label=labels, **line)
    peak = spectrum.max() or 1.0
    low = min(10.0**-panels.DECADES * peak, axes.get_ylim()[1])
    axes.set(yscale="log", xlim=(0, frequency[shown][-1]), ylim=(low, ROOM * peak))
    axes.set(xlabel=panels.OMEGA, ylabel="Velocity spectrum (m)")
    axes.legend(loc="upper left", fontsize=5.5, handlelength=1.0, labelspacing=0.2)
    inset = axes.inset_axes([0.42, 0.70, 0.56, 0.28])
    inset.plot(field_time(member.run), velocity, **line)
    inset.margins(x=0)
    inset.tick_params(labelsize=5, pad=1)
    inset.set_ylabel("m/s", fontsize=5.5, labelpad=0)
    inset.set_xlabel("s", fontsize=5.5, labelpad=-4, loc="right")


def transfer_dispersions(sweeps: Sweeps) -> Iterator[style.Drawing]:
    """Every reading and configuration: laws in rows, amplitudes in columns."""
    members = ((m.case, m.folder) for m in transfer_members(sweeps) if "dispersion" in m.analysis)
    for name, group in grouped(members, lambda pair: Labels.of(pair[0]).page_stem).items():
        yield style.Drawing(name, partial(_dispersion_table, group, sweeps.files))


def _dispersion_table(members: Sequence[tuple[Case, Path]], files: Files) -> Figure:
    """One panel a member; colours run over five decades below each panel's own largest value."""
    runs = {(case.contacts.law, case.drive.amplitude): folder for case, folder in members}
    laws, amplitudes = sorted({law for law, _ in runs}, reverse=True), sorted({amplitude for _, amplitude in runs})
    figure = style.new_figure(style.PAGE, 0.4 + 2.1 * len(laws), Labels.of(members[0][0]).page)
    grid = figure.subplots(len(laws), len(amplitudes), sharex=True, sharey=True, squeeze=False)
    for (i, j), axes in np.ndenumerate(grid):
        if (laws[i], amplitudes[j]) not in runs:
            panels.annotate_empty(axes, "no such run")
            continue
        member = files.get(runs[laws[i], amplitudes[j]], MeasuredRun.open)
        cell = member.model.chain.cell
        energy = panels.below_cutoff(member.analysis, cell, ["dispersion"])["dispersion"]
        energy = energy / (float(energy.max()) or 1.0)
        image = panels.dispersion_map(axes, energy, panels.log_norm(energy), cell)
        axes.label_outer()
        transferred = f"IBTET {float(member.analysis['ibtet']):.2g}"
        axes.set_title(f"({'abcdef'[i]}.{j + 1}) {laws[i].capitalize()}, {amplitudes[j]:.4g} N")
        axes.text(0.03, 0.41, transferred, color="white", transform=axes.transAxes)
    panels.colour_bar(image, grid, "Energy per bin over its largest", aspect=35)
    return figure


def band_energies(sweeps: Sweeps) -> Iterator[style.Drawing]:
    """Energies of all parts and their sum over time for every whole member; mean shares for every sweep."""
    for member in transfer_members(sweeps):
        if member.analysis.sizes["bands/part"] and "bands/total" in member.analysis:
            yield style.Drawing(Labels.of(member.case).member_stem, partial(energies_over_time, member))
    with_shares = (curve for curve in transfer_curves(sweeps) if "bands/share" in curve.data)
    for name, curves in grouped(with_shares, lambda curve: Labels.of(curve.case).page_stem).items():
        yield style.Drawing(f"shares-{name}", partial(columns_of_laws, curves, "Mean share of the energy (1)", _shares))


def closing_error(parts: np.ndarray, total: np.ndarray, samples: int) -> np.ndarray:
    """|sum of ``parts`` (part, t) - ``total`` (t)| over the total, each a running mean over ``samples`` (t').

    Energies beat twice a period, and so do the cross terms that a sum of parts lacks: a mean over a period of the
    drive is what an energy of a part means. NaN where the total is below 1e-3 of its largest.
    """
    samples = max(min(samples, len(total)), 1)
    energies = np.stack([parts.sum(axis=0), total])
    together, whole = sliding_window_view(energies, samples, axis=1).mean(axis=2)
    above_threshold = whole > LEAST_SHARE * whole.max()
    return np.divide(np.abs(together - whole), whole, out=np.full_like(whole, np.nan), where=above_threshold)


def energies_over_time(member: MeasuredRun) -> Figure:
    """The parts and their sum against the total (mean over a period of the drive), and how far they miss it."""
    analysis = member.analysis
    time, parts, total = (analysis[name].values for name in ("bands/sample", "bands/energy", "bands/total"))
    samples = max(round(2 * np.pi / member.model.drive.frequency / (time[1] - time[0])), 1)
    series = np.stack([time, total, parts.sum(axis=0), *parts])
    time, mean_total, mean_sum, *mean_parts = sliding_window_view(series, samples, axis=1).mean(axis=2)
    figure = style.new_figure(style.PAGE * 0.8, 4.2, Labels.of(member.case).member)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.4, 1))
    _draw_parts(upper, time, analysis["bands/energy"].attrs["parts"], mean_parts)
    upper.plot(time, mean_total, color=style.BLACK, lw=1.6, label="total")
    upper.plot(time, mean_sum, color=style.YELLOW, lw=0.8, ls="--", label="sum of parts")
    top = total.max() or 1.0
    upper.set(yscale="log", ylim=(top * 10.0**-SHARE_DECADES, 3 * top), ylabel="Kinetic energy (J)")
    upper.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    upper.set_title("(a) Parts of the frequency axis, mean over a period of the drive")

    error = closing_error(parts, total, samples)
    lower.plot(time, 100 * np.maximum(error, 1e-12), lw=0.7)
    lower.axhline(100 * LARGEST_ERROR, color=style.VERMILION, lw=0.7, ls="--")
    whole = abs(parts.sum() / (total.sum() or 1.0) - 1)
    below = np.mean(error[np.isfinite(error)] <= LARGEST_ERROR)
    text = f"whole record: {100 * whole:.2g} %; at most 1 % for {100 * below:.3g} % of the time"
    lower.text(0.5, 0.93, text, ha="center", va="top", transform=lower.transAxes)
    lower.set(yscale="log", ylim=(1e-4, 1e3), xlim=series[0, [0, -1]], xlabel="Time (s)", ylabel="Error (%)")
    lower.set_title("(b) Sum of the parts against the total")
    return figure


def _shares(axes: Axes, curve: Curve) -> str:
    """Mean share of every part after the wave's arrival against the amplitude."""
    share = curve.data["bands/share"]
    _draw_parts(axes, curve.data["amplitude"], share.attrs["parts"], np.maximum(share.values.T, 1e-300))
    axes.plot(curve.data["amplitude"], share.values.sum(axis=1), color=style.BLACK, lw=0.6, ls=":", label="sum")
    axes.set(xscale="log", yscale="log", ylim=(10.0**-SHARE_DECADES, 2), xlabel="Amplitude of the drive (N)")
    if axes.get_subplotspec().is_last_col():
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return Labels.of(curve.case).law


def _draw_parts(axes: Axes, x: ArrayLike, names: ArrayLike, energies: Iterable[np.ndarray]) -> None:
    """A colour for each pass band, grey dashes for each gap and for what lies above."""
    bands, gaps = (f"C{i}" for i in count()), cycle(GAPS)
    for name, energy in zip(np.atleast_1d(names), energies, strict=True):
        is_band = name.startswith("band")
        line = {"color": next(bands)} if is_band else {"color": style.GREY, "lw": 0.7, "ls": next(gaps)}
        axes.plot(x, energy, label=name, **line)
