"""Inter-band transfer: nine panels of a run (paper, Figs. 7, S6), dispersions (Fig. 8), energies of bands (A3).

The *parts* of the frequency axis are pass bands, the gaps between them and what lies above; their energies are those of
the velocities filtered to each part. IBTET is the paper's inter-band targeted energy transfer: the fraction of the
energy that is in the bands above the driven one, as a mean over time.
"""

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import cycle
from pathlib import Path
from textwrap import wrap
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patheffects import withStroke
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from vipetsc.case import Case
from vipetsc.figures import panels, style
from vipetsc.figures.page import Page, add_letters
from vipetsc.figures.style import Drawing, Shown
from vipetsc.figures.sweep_members import Files, Labels, MemberRun, Sweeps, grouped, phrase, transfer_members
from vipetsc.figures.transfer_curves import TransferCurve, columns_of_laws, transfer_curves
from vipetsc.io.read import field_interval, field_time, nearest_cell
from vipetsc.lattice import pass_bands
from vipetsc.spectra import TAPER, taper

FIELD = "bands/kinetic_energy"  # (band, t, cell) in J
# The paper shows spectra of two cells: this one, before the sites, and cell 150, the middle of its lattice, which the
# wave reaches after it has met sites.
INPUT_CELL = 5


class SegmentLook(NamedTuple):
    """Cells before or behind the first site: how they are named and marked on a page."""

    label: str
    colour: str


# By the names of their spectra in the analysis.
SEGMENTS = {
    "dispersion_before": SegmentLook("Input segment", style.SKY),
    "dispersion_after": SegmentLook("Output segment", "white"),
}
OUTLINE = [withStroke(linewidth=3.4, foreground=style.BLACK)]  # seen on bright and dark places of a map
TEXT_OUTLINE = [withStroke(linewidth=1.4, foreground=style.BLACK)]
ROOM = 1e4  # factor from the largest peak of spectra to the end of its axis: room for the inset with the time history
GAPS = (style.DASHED, (0, (1, 1.5)), (0, (4, 1.5, 1, 1.5)), (0, (6, 3)))
MOST_COLUMNS = 4  # of dispersions on a page
MOST_PANELS = 12  # on a page of members that have nothing in common
LETTERS = 14  # of the titles of dispersions on an inch
DECADES = 6  # decades below the total energy over which energies of parts are shown
# Largest error of the sum of the parts over the total. The paper says that they "matched nearly identically"; this is
# the 1 % that it allows for wavenumber bins.
LARGEST_ERROR = 0.01
# Total energy over its largest, below which the sum of the parts is not compared with it: there the error of the sum is
# that of the filters' tails.
LEAST_TOTAL = 1e-3


def transfer(sweeps: Sweeps) -> Iterator[Drawing]:
    """Offer a page for every whole member: energy in space-time, dispersion and spectra before and behind a site."""
    for member in transfer_members(sweeps):
        if "velocity" in member.run and all(name in member.analysis for name in (FIELD, *SEGMENTS)):
            yield Drawing(member.labels.member_stem, partial(nine_panels, member), [member.shown()])


def nine_panels(member: MemberRun) -> Figure:
    """Draw energy in space-time, of all frequencies and of each pass band; dispersions; spectra of two cells.

    A cell with four bands has nine panels.
    """
    run = member.run
    cell = member.model.chain.cell
    figure = style.new_figure(style.PAGE, 7.6, member.labels.member)
    upper, middle, lower = figure.subfigures(3, 1, height_ratios=(1.15, 0.85, 1))
    _draw_space_time(upper, member)

    # Both segments have one scale, and each the mark that it has in the space-time map.
    spectra = panels.below_cutoff(member.analysis, cell, list(SEGMENTS))
    norm = panels.log_norm(*spectra.values())
    maps = middle.subplots(1, 2, sharey=True)
    for axes, (name, segment) in zip(maps, SEGMENTS.items(), strict=True):
        image = panels.dispersion_map(axes, spectra[name], norm, cell)
        axes.set_title(segment.label)
        axes.plot(
            [0.03, 0.03], [0.03, 0.97], color=segment.colour, lw=2.2, path_effects=OUTLINE, transform=axes.transAxes
        )
        axes.label_outer()
    panels.colour_bar(image, maps, "Energy per bin (J)")

    cells = INPUT_CELL, member.model.chain.cells // 2
    both = lower.subplots(1, 2, sharey=True)
    peaks: list[float] = []
    for axes, number in zip(both, cells, strict=True):
        index = nearest_cell(run, number)
        peaks.append(_draw_spectra(axes, member, run["velocity"][:, index].values))
        axes.set_title(f"Velocity spectra, cell {run['cell'].values[index]}")
        axes.label_outer()
    # Their axis is common.
    both[0].set_ylim(_spectra_limits(peaks))
    add_letters([*upper.axes[: 1 + len(member.analysis[FIELD])], *maps, *both])
    return figure


def _draw_space_time(page: SubFigure, member: MemberRun) -> None:
    """Draw kinetic energy of all frequencies and of each pass band with one scale of colours; segments are marked."""
    run = member.run
    energy = member.analysis["kinetic_energy"]
    fields = member.analysis[FIELD]
    parts = np.atleast_1d(member.analysis["bands/energy"].attrs["parts"])
    norm = panels.log_norm(energy)
    columns = -(-len(fields) // 2)
    grid = page.add_gridspec(2, 1 + columns, width_ratios=(1.35, *[1.0] * columns))

    whole = page.add_subplot(grid[:, 0])
    image = panels.space_time_map(whole, energy, norm, run)
    whole.set_title("Kinetic energy")
    for i, field in enumerate(fields):
        axes = page.add_subplot(grid[i // columns, 1 + i % columns], sharex=whole, sharey=whole)
        panels.draw_map(axes, energy["time"].values, energy["cell"].values, field.values.T, norm)
        part = parts[int(field["bands/band"]) - 1]
        axes.set(title=part.capitalize(), xlabel="Time (s)")
        axes.label_outer()
    panels.colour_bar(image, page.axes, "Kinetic energy of a cell (J)", aspect=35)
    _mark_segments(whole, member)


def _mark_segments(axes: Axes, member: MemberRun) -> None:
    """Draw lines along the cells before and behind the first site, on the right edge of a map over cells."""
    cells = member.analysis["kinetic_energy"]["cell"].values
    sites = member.run["sites/cell"].values
    first = sites[member.case.nearest_site(sites)]
    lower_cells = (cells[0], first - 1)
    higher_cells = (first + 1, cells[-1])
    driven_below = member.model.drive_cell + 1 <= first
    spans = (lower_cells, higher_cells) if driven_below else (higher_cells, lower_cells)

    across = axes.get_yaxis_transform()
    for segment, (low, high) in zip(SEGMENTS.values(), spans, strict=True):
        line = {"color": segment.colour, "lw": 2.2, "solid_capstyle": "butt", "path_effects": OUTLINE}
        axes.plot([0.98, 0.98], [low + 1, high - 1], transform=across, **line)
        name = segment.label.split()[0].lower()
        text = {"color": segment.colour, "rotation": 90, "ha": "right", "va": "center", "path_effects": TEXT_OUTLINE}
        axes.text(0.955, 0.5 * (low + high), name, transform=across, **text)


def _spectra_limits(peaks: Sequence[float]) -> tuple[float, float]:
    """Return the limits of a logarithmic axis of spectra with these ``peaks``, 0 for a cell that no wave reaches."""
    positive = [peak for peak in peaks if peak > 0] or [1.0]
    decades = 10.0**-panels.DECADES
    # Behind a site a spectrum may be far smaller; rounding errors are no spectrum.
    smallest = max(min(positive), decades * max(positive))
    return decades * smallest, ROOM * max(positive)


def _draw_spectra(axes: Axes, member: MemberRun, velocity: np.ndarray) -> float:
    """Draw amplitude spectra of the masses of one cell by their ``velocity`` (t, dof) in m/s, which is in an inset.

    Pass bands are shaded and numbered. Returns the largest value in m.
    """
    cell = member.model.chain.cell
    step = field_interval(member.run)
    frequency = 2e-3 * np.pi * np.fft.rfftfreq(len(velocity), step)  # krad/s
    # Times the step, so that the sum approximates the integral over time, and does not depend on the sample interval.
    spectrum = np.abs(np.fft.rfft(velocity * taper(len(velocity), TAPER)[:, None], axis=0)) * step
    bands = pass_bands(cell)
    shown = frequency <= 1.1e-3 * bands[-1].high

    panels.shade_bands(axes, ((band.low, band.high) for band in bands), "x")
    across = axes.get_xaxis_transform()
    for band in bands:
        middle = 0.5e-3 * (band.low + band.high)
        axes.text(middle, 0.02, str(band.number), ha="center", color=style.GREY, transform=across)

    roles = {cell.host: " (host)", cell.resonator: " (resonator)"}
    labels = [f"mass {mass + 1}{roles.get(mass, '')}" for mass in range(cell.dofs)]
    line = {"lw": 0.5, "alpha": 0.85, "rasterized": True}
    axes.plot(frequency[shown], np.maximum(spectrum[shown], 1e-300), label=labels, **line)
    axes.set(yscale="log", xlim=(0, frequency[shown][-1]))
    axes.set(xlabel=panels.OMEGA, ylabel="Velocity spectrum (m)")
    axes.legend(loc="upper left", fontsize=5.5, handlelength=1.0, labelspacing=0.2)

    inset = axes.inset_axes([0.42, 0.70, 0.56, 0.28])
    inset.plot(field_time(member.run), velocity, **line)
    inset.margins(x=0)
    inset.tick_params(labelsize=5, pad=1)
    inset.set_ylabel("m/s", fontsize=5.5, labelpad=0)
    inset.set_xlabel("time (s)", fontsize=5.5, labelpad=0)
    return float(spectrum.max())


class CaseFolder(NamedTuple):
    """A member of which case, names and folder are kept; its fields are read again when a picture needs them."""

    case: Case
    labels: Labels
    folder: Path


class DispersionPanel(NamedTuple):
    """A panel of dispersion: its member, None where the sweep has none there, and its title."""

    member: CaseFolder | None
    title: str


def transfer_dispersions(sweeps: Sweeps) -> Iterator[Drawing]:
    """Offer a page for each reading and configuration, with its laws and amplitudes, and others for single members.

    Amplitudes are in columns and laws in rows, if there are ``MOST_COLUMNS`` amplitudes or fewer; more go on in the
    next row. Configurations with one member are put together on pages of ``MOST_PANELS``.
    """
    members = [CaseFolder(m.case, m.labels, m.folder) for m in transfer_members(sweeps) if "dispersion" in m.analysis]
    pages = grouped(members, lambda member: member.labels.page_stem)
    for name, group in pages.items():
        if len(group) > 1:
            yield Drawing(name, partial(_dispersion_table, group, sweeps.files), _shown(group, sweeps.files))

    alone = [group[0] for group in pages.values() if len(group) == 1]
    for first in range(0, len(alone), MOST_PANELS):
        group = alone[first : first + MOST_PANELS]
        name = group[0].labels.page_stem
        if len(group) > 1:
            name = f"members-{first + 1}-to-{first + len(group)}"
        yield Drawing(name, partial(_dispersion_page, group, sweeps.files), _shown(group, sweeps.files))


def _shown(members: Sequence[CaseFolder], files: Files) -> list[Shown]:
    """Return ``members`` for the warnings of a page, named by what its heading does not say."""
    is_of_one_page = len({member.labels.page_stem for member in members}) == 1
    shown = []
    for member in members:
        name = member.labels.member
        if is_of_one_page:
            name = phrase(member.labels.law, member.labels.amplitude)
        shown.append(files.get(member.folder, MemberRun.open).shown(name))
    return shown


def _dispersion_table(members: Sequence[CaseFolder], files: Files) -> Figure:
    """Draw a panel for each law and amplitude of ``members``, which have one heading."""
    laws = sorted({member.case.contacts.law for member in members}, reverse=True)
    amplitudes = sorted({member.case.drive.amplitude for member in members})
    at = {(member.case.contacts.law, member.case.drive.amplitude): member for member in members}
    names = {member.case.drive.amplitude: member.labels.amplitude for member in members}
    panels_of_page = [
        DispersionPanel(at.get((law, amplitude)), f"{law.capitalize()}, {names[amplitude]}")
        for law in laws
        for amplitude in amplitudes
    ]
    return _dispersion_panels(members[0].labels.page, panels_of_page, len(amplitudes), files)


def _dispersion_page(members: Sequence[CaseFolder], files: Files) -> Figure:
    """Draw a panel for each of ``members``, with its name as the title."""
    panels_of_page = [DispersionPanel(member, member.labels.member) for member in members]
    return _dispersion_panels("", panels_of_page, MOST_COLUMNS - 1, files)


def _dispersion_panels(heading: str, shown: Sequence[DispersionPanel], columns: int, files: Files) -> Figure:
    """Draw panels in rows of ``columns``; colours are over five decades below the largest value of each panel."""
    columns = min(len(shown), columns, MOST_COLUMNS)
    rows = -(-len(shown) // columns)
    # A full grid is a table.
    count = len(shown) % (rows * columns)
    options = {"sharex": True, "sharey": True}
    page = Page.of(rows, columns, width=style.PAGE, height=0.4 + 2.1 * rows, heading=heading, count=count, **options)
    letters = int(LETTERS * style.PAGE / columns)
    for axes, (member_folder, text) in zip(page.panels, shown, strict=True):
        axes.set_title("\n".join(wrap(text, letters)))
        if member_folder is None:
            panels.annotate_empty(axes, "no such run")
            continue
        member = files.get(member_folder.folder, MemberRun.open)
        cell = member.model.chain.cell
        energy = panels.below_cutoff(member.analysis, cell, ["dispersion"])["dispersion"]
        energy = energy / (float(energy.max()) or 1.0)
        image = panels.dispersion_map(axes, energy, panels.log_norm(energy), cell)
        axes.label_outer()
        transferred = f"IBTET {float(member.analysis['ibtet']):.2g}"
        axes.text(0.03, 0.41, transferred, color="white", transform=axes.transAxes)

    if columns == MOST_COLUMNS:
        # Narrow panels have no room for labels of their own.
        page.body.supxlabel(panels.KAPPA)
        for axes in page.panels:
            axes.set_xlabel("")
    panels.colour_bar(image, page.grid, "Energy per bin / maximum", aspect=35)
    return page.lettered()


def band_energies(sweeps: Sweeps) -> Iterator[Drawing]:
    """Offer a page for every whole member: energies of all parts and their sum over time."""
    for member in transfer_members(sweeps):
        if member.analysis.sizes["bands/part"] and "bands/total" in member.analysis:
            yield Drawing(member.labels.member_stem, partial(energies_over_time, member), [member.shown()])


def band_shares(sweeps: Sweeps) -> Iterator[Drawing]:
    """Offer a page for each configuration and reading: mean fractions of all parts over the amplitude."""
    with_fractions = (curve for curve in transfer_curves(sweeps) if "bands/share" in curve.data)
    for name, curves in grouped(with_fractions, lambda curve: Labels.of(curve.case).page_stem).items():
        page = partial(columns_of_laws, curves, "Mean fraction of the energy (1)", _draw_fractions)
        yield Drawing(name, page)


def closing_error(parts: np.ndarray, total: np.ndarray, samples: int) -> np.ndarray:
    """Return |sum of ``parts`` - ``total``| / total (t - samples + 1,) of running means over ``samples``.

    ``parts`` (part, t) and ``total`` (t,) are energies. The total has products of velocities of different parts, which
    a sum of the parts' energies lacks. They oscillate, as energies do: over a period of the drive they nearly cancel.
    NaN where the total is below ``LEAST_TOTAL`` of its largest value.
    """
    samples = max(min(samples, len(total)), 1)
    energies = np.stack([parts.sum(axis=0), total])
    # The difference of means, not the mean of differences without their signs.
    together, whole = sliding_window_view(energies, samples, axis=1).mean(axis=2)
    above_threshold = whole > LEAST_TOTAL * whole.max()
    return np.divide(np.abs(together - whole), whole, out=np.full_like(whole, np.nan), where=above_threshold)


def energies_over_time(member: MemberRun) -> Figure:
    """Draw the energies of the parts, their sum and the total over time, and the error of the sum.

    All are running means over a period of the drive.
    """
    analysis = member.analysis
    time = analysis["bands/sample"].values
    parts = analysis["bands/energy"].values
    total = analysis["bands/total"].values
    # A record may be shorter than a period of the drive.
    period = 2 * np.pi / member.model.drive.frequency
    samples = int(np.clip(round(period / (time[1] - time[0])), 1, len(time)))
    series = np.stack([time, total, parts.sum(axis=0), *parts])
    mean_time, mean_total, mean_sum, *mean_parts = sliding_window_view(series, samples, axis=1).mean(axis=2)

    width = style.PAGE * 0.8
    options: dict[str, Any] = {"sharex": True, "height_ratios": (2.4, 1)}
    page = Page.of(rows=2, width=width, height=4.2, heading=member.labels.member, **options)
    upper, lower = page.panels
    draw_parts(upper, mean_time, analysis["bands/energy"].attrs["parts"], mean_parts)
    upper.plot(mean_time, mean_total, color=style.BLACK, lw=1.6, label="total")
    upper.plot(mean_time, mean_sum, color=style.SKY, lw=0.8, ls="--", label="sum of parts")
    top = total.max() or 1.0
    upper.set(yscale="log", ylim=(top * 10.0**-DECADES, 3 * top), ylabel="Kinetic energy (J)")
    upper.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    upper.set_title("Parts of the frequency axis, mean over a period of the drive")

    error = closing_error(parts, total, samples)
    # Sums that agree to the last bit would leave gaps in the curve.
    lower.plot(mean_time, 100 * np.maximum(error, 1e-12), lw=0.7)
    lower.axhline(100 * LARGEST_ERROR, color=style.VERMILION, lw=0.7, ls="--")
    whole_record = abs(parts.sum() / (total.sum() or 1.0) - 1)
    below = np.mean(error[np.isfinite(error)] <= LARGEST_ERROR)
    text = f"whole record: {100 * whole_record:.2g} %; at most 1 % for {100 * below:.3g} % of the time"
    lower.text(0.5, 0.93, text, ha="center", va="top", transform=lower.transAxes)
    lower.set(yscale="log", ylim=(1e-4, 1e3), xlim=time[[0, -1]], xlabel="Time (s)", ylabel="Error (%)")
    lower.set_title("Sum of the parts compared with the total")
    return page.lettered()


def _draw_fractions(axes: Axes, curve: TransferCurve) -> str:
    """Draw the mean fraction of every part after the arrival of the wave over the amplitude; return the law's name."""
    amplitude = curve.data["amplitude"]
    fraction = curve.data["bands/share"]
    draw_parts(axes, amplitude, fraction.attrs["parts"], np.maximum(fraction.values.T, 1e-300))
    axes.plot(amplitude, fraction.values.sum(axis=1), color=style.BLACK, lw=0.6, ls=":", label="sum")
    axes.set(xscale="log", yscale="log", ylim=(10.0**-DECADES, 2), xlabel="Amplitude of the drive (N)")
    if axes.get_subplotspec().is_last_col():
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return Labels.of(curve.case).law


def draw_parts(axes: Axes, x: ArrayLike, names: ArrayLike, energies: Iterable[np.ndarray]) -> None:
    """Draw a curve (x,) for each part: a colour for a pass band, grey dashes for a gap and for what lies above."""
    gap_dashes = cycle(GAPS)
    for name, energy in zip(np.atleast_1d(names), energies, strict=True):
        band = style.band_number(name)
        if band:
            axes.plot(x, energy, label=name, **style.band_look(band))
        else:
            axes.plot(x, energy, label=name, color=style.GREY, lw=0.7, ls=next(gap_dashes))
