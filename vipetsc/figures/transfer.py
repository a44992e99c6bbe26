"""Inter-band transfer in one run: the paper's picture of nine panels, from space-time to spectra."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import h5py
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.dispersion import bloch_branches
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.members import stem, title, transfer_members
from vipetsc.figures.study import Study
from vipetsc.io.run_file import RunFile
from vipetsc.lattice import pass_bands
from vipetsc.spectra import TAPER, Parts, part_kinetic_energy, taper

DECADES = 5
INPUT_CELL = 5  # the paper's cell before the sites; the one behind them is the middle of the lattice, its cell 150
SEGMENTS = {"dispersion_before": ("Input segment", style.SKY), "dispersion_after": ("Output segment", style.YELLOW)}
MASSES = (style.BLUE, style.VERMILION, style.GREEN, style.PURPLE, style.ORANGE, style.SKY)
ROOM = 1e4  # of a spectrum's axis above its peak, for the time history


def transfer(study: Study) -> Iterator[Drawing]:
    """For every whole member: energy in space-time, dispersion and spectra before and behind the first site."""
    for run, analysis in transfer_members(study):
        if "velocity" in run.file and {"kinetic_energy", *SEGMENTS} <= analysis.keys():
            yield stem(run.case), partial(nine_panels, run, analysis)


def nine_panels(run: RunFile, analysis: h5py.File) -> Figure:
    """The paper's Fig. Hertz_Jump: (a) all, (b-e) every pass band, (f, g) both segments, (h, i) two cells' spectra."""
    velocity = run.velocity[...]
    figure = style.new_figure(style.PAGE, 7.6)
    figure.suptitle(title(run.case), fontsize=8, x=0.01, ha="left")
    maps, middle, low = figure.subfigures(3, 1, height_ratios=(1.15, 0.85, 1))
    letters = iter("abcdefghijklmnopqrstuvwxyz")
    _space_time(maps, run, analysis, velocity, letters)
    _dispersions(middle, run, analysis, letters)
    places = run.nearest(INPUT_CELL), run.nearest(run.model.chain.cells // 2)
    for axes, at in zip(low.subplots(1, 2, sharey=True), places, strict=True):
        _spectra(axes, run, velocity[:, at])
        style.letter(axes, f"({next(letters)}) Velocity spectra, cell {run.cells[at]}")
        axes.label_outer()
    return figure


def _space_time(place: object, run: RunFile, analysis: h5py.File, velocity: np.ndarray, letters: Iterator[str]) -> None:
    bands = Parts.of(pass_bands(run.model.chain.cell))
    shown = [p for p, inside in enumerate(bands.bands) if inside]
    columns = -(-len(shown) // 2)
    grid = place.add_gridspec(2, 1 + columns, width_ratios=(1.35, *[1.0] * columns))
    whole = place.add_subplot(grid[:, 0])
    energy = analysis["kinetic_energy"][...]
    norm = style.log_norm(energy.max(), DECADES)
    image = style.draw_map(whole, analysis["time"][...], run.cells, energy.T, norm, "inferno")
    whole.set(xlabel="Time (s)", ylabel="Cell")
    style.letter(whole, f"({next(letters)}) Kinetic energy")
    _mark_segments(whole, run)
    panels = [whole]
    for i, p in enumerate(shown):
        axes = place.add_subplot(grid[i // columns, 1 + i % columns], sharex=whole, sharey=whole)
        low, high = bands.edges[p : p + 2]
        part = part_kinetic_energy(velocity, run.masses, run.field_interval, low, high)
        style.draw_map(axes, run.field_time, run.cells, part.T, norm, "inferno")
        style.letter(axes, f"({next(letters)}) {bands.names[p].capitalize()}")
        axes.tick_params(labelleft=False, labelbottom=i // columns == 1)
        if i // columns == 1:
            axes.set_xlabel("Time (s)")
        panels.append(axes)
    whole.set(ylim=(run.cells[0] - 0.5, run.cells[-1] + 0.5), xlim=run.field_time[[0, -1]])
    place.colorbar(image, ax=panels, label="Kinetic energy of a cell (J)", pad=0.01, extend="min", aspect=35)


def _mark_segments(axes: Axes, run: RunFile) -> None:
    """Bars along the left edge over the cells before and behind the first site, triangles at the sites."""
    across = axes.get_yaxis_transform()
    first, (low, high) = run.site_cells[run.leading_site], run.cells[[0, -1]]
    spans = ((low, first - 1), (first + 1, high))
    if run.model.drive_cell + 1 > first:
        spans = spans[::-1]
    for (name, colour), (a, b) in zip(SEGMENTS.values(), spans, strict=True):
        axes.plot([0.02, 0.02], [a + 1, b - 1], color=colour, lw=2.2, solid_capstyle="butt", transform=across)
        axes.text(0.045, 0.5 * (a + b), name.split()[0].lower(), color=colour, rotation=90, va="center",
                  fontsize=7, transform=across)  # fmt: skip
    sites = run.site_cells
    axes.plot(np.full(len(sites), 0.985), sites, "<", color="white", mec=style.BLACK, mew=0.3, ms=3.5, transform=across)


def _dispersions(place: object, run: RunFile, analysis: h5py.File, letters: Iterator[str]) -> None:
    cell = run.model.chain.cell
    frequency, wavenumber = analysis["frequency"][...], analysis["wavenumber"][...]
    kept = frequency <= 1.1 * pass_bands(cell)[-1].high
    spectra = {name: analysis[name][:, kept] for name in SEGMENTS}
    norm = style.log_norm(max(s.max() for s in spectra.values()), DECADES)
    panels = place.subplots(1, 2, sharey=True)
    for axes, (name, spectrum) in zip(panels, spectra.items(), strict=True):
        image = style.draw_map(axes, wavenumber / np.pi, frequency[kept] / 1e3, spectrum.T, norm, "inferno")
        bloch_branches(axes, cell)
        axes.set(xlabel="Wavenumber κ (π rad/cell)", xlim=(0, wavenumber[-1] / np.pi))
        axes.set_ylim(0, frequency[kept][-1] / 1e3)
        label, colour = SEGMENTS[name]
        style.letter(axes, f"({next(letters)}) {label}")
        axes.plot([0.03, 0.03], [0.03, 0.97], color=colour, lw=2.2, transform=axes.transAxes)
    panels[0].set_ylabel("Frequency ω (krad/s)")
    place.colorbar(image, ax=panels, label="Energy per bin (J)", pad=0.01, extend="min")


def _spectra(axes: Axes, run: RunFile, velocity: np.ndarray) -> None:
    """Amplitude spectra of the masses of one cell, ``velocity`` (t, dof); pass bands shaded, history inset."""
    cell, step = run.model.chain.cell, run.field_interval
    bands = pass_bands(cell)
    frequency = 2e-3 * np.pi * np.fft.rfftfreq(len(velocity), step)
    window = taper(len(velocity), TAPER)[:, None]
    spectrum = np.abs(np.fft.rfft(velocity * window, axis=0)) * step
    kept = frequency <= 1.1e-3 * bands[-1].high
    for band in bands:
        axes.axvspan(1e-3 * band.low, 1e-3 * band.high, color=style.PALE, alpha=0.7, lw=0)
        axes.annotate(str(band.number), (0.5e-3 * (band.low + band.high), 0), (0, 2), ha="center", color=style.GREY,
                      xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=6.5)  # fmt: skip
    inset = axes.inset_axes([0.42, 0.70, 0.56, 0.28])
    roles = {cell.host: " (host)", cell.resonator: " (resonator)"}
    for j, colour in zip(range(velocity.shape[1]), MASSES, strict=False):
        line = {"color": colour, "lw": 0.5, "alpha": 0.85, "rasterized": True}
        label = f"mass {j + 1}{roles.get(j, '')}"
        axes.plot(frequency[kept], np.maximum(spectrum[kept, j], 1e-300), label=label, **line)
        inset.plot(run.field_time, velocity[:, j], **line)
    peak = spectrum.max() or 1.0
    low = min(10.0**-DECADES * peak, axes.get_ylim()[1])
    axes.set(yscale="log", xlim=(0, frequency[kept][-1]), ylim=(low, ROOM * peak))
    axes.set(xlabel="Frequency ω (krad/s)", ylabel="Velocity spectrum (m)")
    axes.legend(loc="upper left", fontsize=5.5, handlelength=1.0, labelspacing=0.2)
    inset.set_xlim(run.field_time[[0, -1]])
    inset.tick_params(labelsize=5, pad=1)
    inset.set_ylabel("m/s", fontsize=5.5, labelpad=0)
    inset.set_xlabel("s", fontsize=5.5, labelpad=-4, loc="right")
