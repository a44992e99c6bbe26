"""Inter-band transfer in one run: nine panels, from space-time to spectra (paper, Figs. 7 and S6)."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.panels import (
    DECADES,
    KAPPA,
    below_cutoff,
    colour_bar,
    colours,
    dispersion_map,
    draw_map,
    log_norm,
    panel_title,
    shade_bands,
    space_time_map,
)
from vipetsc.figures.study import MeasuredRun, Study, member_heading, member_stem, transfer_members
from vipetsc.io.read import field_interval, field_time, leading_site, nearest_cell
from vipetsc.lattice import pass_bands
from vipetsc.spectra import TAPER, Parts, part_kinetic_energy, taper

INPUT_CELL = 5  # the paper's cell before the sites; the one behind them is the middle of the lattice, its cell 150
SEGMENTS = {"dispersion_before": ("Input segment", style.SKY), "dispersion_after": ("Output segment", style.YELLOW)}
ROOM = 1e4  # of a spectrum's axis above its peak, for the time history


def transfer(study: Study) -> Iterator[Drawing]:
    """For every whole member: energy in space-time, dispersion and spectra before and behind the first site."""
    for member in transfer_members(study):
        if "velocity" in member.run and all(name in member.analysis for name in ("kinetic_energy", *SEGMENTS)):
            yield member_stem(member.case), partial(nine_panels, member)


def nine_panels(member: MeasuredRun) -> Figure:
    """(a) All energy, (b-e) that of every pass band, (f, g) both segments, (h, i) spectra of two cells."""
    run = member.run
    velocity = run["velocity"].values
    figure = style.new_figure(style.PAGE, 7.6, member_heading(member.case), left=True)
    upper, middle, lower = figure.subfigures(3, 1, height_ratios=(1.15, 0.85, 1))
    letters = iter("abcdefghijklmnopqrstuvwxyz")
    _space_time(upper, member, velocity, letters)
    _dispersions(middle, member, letters)
    cells = INPUT_CELL, member.model.chain.cells // 2
    for axes, cell in zip(lower.subplots(1, 2, sharey=True), cells, strict=True):
        index = nearest_cell(run, cell)
        _spectra(axes, member, velocity[:, index])
        panel_title(axes, f"({next(letters)}) Velocity spectra, cell {run['cell'].values[index]}")
        axes.label_outer()
    return figure


def _space_time(page: SubFigure, member: MeasuredRun, velocity: np.ndarray, letters: Iterator[str]) -> None:
    run, cell = member.run, member.model.chain.cell
    parts = Parts.of(pass_bands(cell))
    bands = [p for p, inside in enumerate(parts.bands) if inside]
    columns = -(-len(bands) // 2)
    grid = page.add_gridspec(2, 1 + columns, width_ratios=(1.35, *[1.0] * columns))
    whole = page.add_subplot(grid[:, 0])
    energy = member.analysis["kinetic_energy"]
    norm = log_norm(float(energy.max()))
    image = space_time_map(whole, energy, norm)
    panel_title(whole, f"({next(letters)}) Kinetic energy")
    _mark_segments(whole, member)
    panels, cells, time = [whole], run["cell"].values, field_time(run)
    for i, p in enumerate(bands):
        axes = page.add_subplot(grid[i // columns, 1 + i % columns], sharex=whole, sharey=whole)
        part = part_kinetic_energy(velocity, cell.masses, field_interval(run), *parts.edges[p : p + 2])
        draw_map(axes, time, cells, part.T, norm)
        panel_title(axes, f"({next(letters)}) {parts.names[p].capitalize()}")
        axes.tick_params(labelleft=False, labelbottom=i // columns == 1)
        if i // columns == 1:
            axes.set_xlabel("Time (s)")
        panels.append(axes)
    whole.set(ylim=(cells[0] - 0.5, cells[-1] + 0.5), xlim=time[[0, -1]])
    colour_bar(page, image, panels, "Kinetic energy of a cell (J)", aspect=35)


def _mark_segments(axes: Axes, member: MeasuredRun) -> None:
    """Bars along the left edge over the cells before and behind the first site, triangles at the sites."""
    across, sites = axes.get_yaxis_transform(), member.run["sites/cell"].values
    first, (low, high) = sites[leading_site(member.run)], member.run["cell"].values[[0, -1]]
    spans = ((low, first - 1), (first + 1, high))
    if member.model.drive_cell + 1 > first:
        spans = spans[::-1]
    for (name, colour), (a, b) in zip(SEGMENTS.values(), spans, strict=True):
        axes.plot([0.02, 0.02], [a + 1, b - 1], color=colour, lw=2.2, solid_capstyle="butt", transform=across)
        axes.text(0.045, 0.5 * (a + b), name.split()[0].lower(), color=colour, rotation=90, va="center",
                  fontsize=7, transform=across)  # fmt: skip
    axes.plot(np.full(len(sites), 0.985), sites, "<", color="white", mec=style.BLACK, mew=0.3, ms=3.5, transform=across)


def _dispersions(page: SubFigure, member: MeasuredRun, letters: Iterator[str]) -> None:
    cell = member.model.chain.cell
    spectra = below_cutoff(member.analysis, cell, list(SEGMENTS))
    norm = log_norm(max(float(s.max()) for s in spectra.values()))
    panels = page.subplots(1, 2, sharey=True)
    for axes, (name, (label, colour)) in zip(panels, SEGMENTS.items(), strict=True):
        image = dispersion_map(axes, spectra[name], norm, cell)
        axes.set_xlabel(KAPPA)
        panel_title(axes, f"({next(letters)}) {label}")
        axes.plot([0.03, 0.03], [0.03, 0.97], color=colour, lw=2.2, transform=axes.transAxes)
    panels[0].set_ylabel("Frequency ω (krad/s)")
    colour_bar(page, image, panels, "Energy per bin (J)")


def _spectra(axes: Axes, member: MeasuredRun, velocity: np.ndarray) -> None:
    """Amplitude spectra of the masses of one cell, ``velocity`` (t, dof); pass bands shaded, history inset."""
    cell, time = member.model.chain.cell, field_time(member.run)
    step, bands = field_interval(member.run), pass_bands(cell)
    frequency = 2e-3 * np.pi * np.fft.rfftfreq(len(velocity), step)
    spectrum = np.abs(np.fft.rfft(velocity * taper(len(velocity), TAPER)[:, None], axis=0)) * step
    shown = frequency <= 1.1e-3 * bands[-1].high
    shade_bands(axes, ((band.low, band.high) for band in bands), "x")
    for band in bands:
        axes.annotate(str(band.number), (0.5e-3 * (band.low + band.high), 0), (0, 2), ha="center", color=style.GREY,
                      xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=6.5)  # fmt: skip
    inset = axes.inset_axes([0.42, 0.70, 0.56, 0.28])
    roles = {cell.host: " (host)", cell.resonator: " (resonator)"}
    for j, colour in enumerate(colours(cell.dofs)):
        line = {"color": colour, "lw": 0.5, "alpha": 0.85, "rasterized": True}
        label = f"mass {j + 1}{roles.get(j, '')}"
        axes.plot(frequency[shown], np.maximum(spectrum[shown, j], 1e-300), label=label, **line)
        inset.plot(time, velocity[:, j], **line)
    peak = spectrum.max() or 1.0
    low = min(10.0**-DECADES * peak, axes.get_ylim()[1])
    axes.set(yscale="log", xlim=(0, frequency[shown][-1]), ylim=(low, ROOM * peak))
    axes.set(xlabel="Frequency ω (krad/s)", ylabel="Velocity spectrum (m)")
    axes.legend(loc="upper left", fontsize=5.5, handlelength=1.0, labelspacing=0.2)
    inset.set_xlim(time[[0, -1]])
    inset.tick_params(labelsize=5, pad=1)
    inset.set_ylabel("m/s", fontsize=5.5, labelpad=0)
    inset.set_xlabel("s", fontsize=5.5, labelpad=-4, loc="right")
