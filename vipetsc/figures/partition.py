"""The wave's energy in twelve wavenumber bins: in space-time, reconstructed, and how the bins are made."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.scattering import ROMAN, mark_sites
from vipetsc.figures.series import Series, WholeRun, series_of
from vipetsc.figures.study import Study
from vipetsc.lattice import bloch

SHOWN = 7
DECADES = 4
LEVEL = 0.003  # of the loudest bin: where the contours lie
FIELD = "partition/kinetic_energy"
BLUR = 0.006, 0.01  # of all snapshots and cells: the carrier's beat is smoothed out before contours are drawn


def bin_colours(count: int) -> np.ndarray:
    """Colours (bin, rgba) in the order of the spectrum, dark enough for lines."""
    return mpl.colormaps["turbo"](np.linspace(0.04, 0.96, count)) * (0.85, 0.85, 0.85, 1.0)


def shown_bins(wavenumber: float, count: int, shown: int = SHOWN) -> list[int]:
    """``shown`` of ``count`` bins (0-based), spread evenly, the bin of ``wavenumber`` and the nearer neighbour in it.

    At 5 pi/9 these are bins 1, 3, 5, 7, 8, 10 and 12 of twelve.
    """
    place = wavenumber * count / np.pi
    own = min(int(place), count - 1)
    above = own + 1 < count and (place - own >= 0.5 or own == 0)
    driven = own, own + 1 if above else own - 1
    chosen = [round(b) for b in np.linspace(0, count - 1, min(shown, count))]
    for b in driven:
        if b not in chosen:
            chosen[min((i for i, c in enumerate(chosen) if c not in driven), key=lambda i: abs(chosen[i] - b))] = b
    return sorted(chosen)


def partition(study: Study) -> Iterator[Drawing]:
    """Energy of seven bins in space-time at the medium amplitude; contours of all bins; the band in their colours."""
    for series in series_of(study, FIELD):
        if series.wave:
            yield series.suffix, partial(_partition, series)


def _partition(series: Series) -> Figure:
    figure = style.new_figure(style.PAGE, 6.6)
    upper, lower = figure.subfigures(2, 1, height_ratios=(2, 1.1))
    medium = series.runs[1]
    field = medium.analysis[FIELD]
    bins = shown_bins(series.wave.wavenumber, len(field))
    figure.suptitle(f"{series.title}; maps: medium amplitude, {medium.amplitude:g} N", fontsize=8)
    colours = bin_colours(len(field))
    *maps, band = upper.subplots(2, 4).flat
    _maps(maps, medium, bins)
    image = maps[0].images[0]
    upper.colorbar(image, ax=[*maps, band], label="Energy of a bin in a cell (J)", pad=0.01, extend="min", aspect=40)
    _coloured_band(band, series, medium.analysis["partition/bounds"][...], colours)
    panels = lower.subplots(1, 3, sharey=True)
    for column, member, heading in series.headings():
        _contours(panels[column], member, colours)
        style.letter(panels[column], f"(b.{ROMAN[column]}) {heading}")
        panels[column].set_xlabel("Time (s)")
    panels[0].set_ylabel("Cell")
    edges = np.arange(len(colours) + 1) + 0.5
    keys = mpl.cm.ScalarMappable(BoundaryNorm(edges, len(colours)), ListedColormap(colours))
    bar = lower.colorbar(keys, ax=panels, label="Bin", pad=0.01, ticks=np.arange(1, len(colours) + 1))
    bar.ax.tick_params(length=0, labelsize=6)
    bar.minorticks_off()
    return figure


def _maps(panels: Sequence[Axes], member: WholeRun, bins: Sequence[int]) -> None:
    """Energy of the ``bins`` in space-time to one scale; panels without a bin are left empty."""
    field = member.analysis[FIELD]
    time, cells = member.analysis["partition/snapshot"][...], member.analysis["cell"][...]
    norm = style.log_norm(float(max(field[b].max() for b in bins)), DECADES)
    for i, axes in enumerate(panels):
        if i >= len(bins):
            axes.set_axis_off()
            continue
        style.draw_map(axes, time, cells, field[bins[i]].T, norm, "inferno")
        mark_sites(axes, member, "y")
        style.letter(axes, f"(a.{ROMAN[i]}) $K_{{{bins[i] + 1}}}$")
        axes.set(xlabel="Time (s)", ylabel="" if i % 4 else "Cell")
        axes.tick_params(labelleft=i % 4 == 0)


def _contours(axes: Axes, member: WholeRun, colours: np.ndarray) -> None:
    """Every bin where its energy exceeds ``LEVEL`` of the loudest bin's, filled and outlined in its colour."""
    field, cells = member.analysis[FIELD], member.analysis["cell"][...]
    time = member.analysis["partition/snapshot"][...]
    step = max(1, len(cells) // 300)
    widths = [share * length for share, length in zip(BLUR, (len(time), len(cells)), strict=True)]
    smooth = [gaussian_filter(field[b], widths, mode="nearest")[:, ::step] for b in range(len(field))]
    largest = max(float(s.max()) for s in smooth)
    # The loudest lie beneath, so that what is scattered out of them is seen.
    for b in sorted(range(len(smooth)), key=lambda b: -smooth[b].sum()):
        if smooth[b].max() > LEVEL * largest > 0:
            axes.contourf(time, cells[::step], smooth[b].T, [LEVEL * largest, np.inf], colors=[colours[b]], alpha=0.35)
            axes.contour(time, cells[::step], smooth[b].T, [LEVEL * largest], colors=[colours[b]], linewidths=0.6)
    mark_sites(axes, member, "y", style.GREY)
    axes.set(xlim=time[[0, -1]], ylim=cells[[0, -1]])


def _coloured_band(axes: Axes, series: Series, bounds: np.ndarray, colours: np.ndarray) -> None:
    cell, band = series.case.model().chain.cell, series.wave.band
    for low, high, colour in zip(bounds[:-1], bounds[1:], colours, strict=True):
        kappa = np.linspace(low, high, 31)
        axes.plot(kappa / np.pi, bloch(cell, kappa).frequency[:, band - 1] / 1e3, color=colour, lw=3,
                  solid_capstyle="butt")  # fmt: skip
    wave = series.wave.wavenumber
    axes.axvline(wave / np.pi, color=style.BLACK, lw=0.6, ls=":")
    axes.set(xlabel="κ (π rad/cell)", ylabel="ω (krad/s)", xlim=(0, 1))
    style.letter(axes, f"(c) Band {band} by bin")


def reconstruction(study: Study) -> Iterator[Drawing]:
    """Kinetic energy and that of the bins' sum over time, their relative error, and the share between bins."""
    for series in series_of(study, "partition/reconstructed"):
        yield series.suffix, partial(_reconstruction, series)


def _reconstruction(series: Series) -> Figure:
    figure = style.new_figure(style.PAGE, 5.0)
    figure.suptitle(series.title, fontsize=8)
    grid = figure.subplots(3, 3, sharex="col", sharey="row")
    for column, member, heading in series.headings():
        found = {name: member.analysis[f"partition/{name}"][...] for name in
                 ("snapshot", "kinetic", "reconstructed", "error", "cross_share")}  # fmt: skip
        time, total = found["snapshot"], member.analysis["partition/energy"][...].sum(axis=0)
        square = member.amplitude**2
        energy, error, cross = grid[:, column]
        energy.plot(time, found["kinetic"] / square, color=style.BLACK, lw=1.4, label="KE of the lattice")
        energy.plot(time, found["reconstructed"] / square, color=style.ORANGE, lw=0.8, ls=(0, (3, 2)),
                    label="KE of the bins' sum")  # fmt: skip
        energy.plot(time, total / square, color=style.BLUE, lw=0.7, label="sum of the twelve KE")
        style.letter(energy, f"({'abc'[column]}.i) {heading}")
        error.semilogy(time, np.where(found["error"] > 0, found["error"], np.nan), color=style.BLUE, lw=0.7)
        error.axhline(0.01, color=style.VERMILION, lw=0.8, ls="--")
        style.letter(error, f"({'abc'[column]}.ii)")
        cross.plot(time, found["cross_share"], color=style.GREEN, lw=0.8)
        cross.set(ylim=(0, 1), xlabel="Time (s)", xlim=time[[0, -1]])
        cross.locator_params(axis="x", nbins=5)
        style.letter(cross, f"({'abc'[column]}.iii)")
    grid[0, 0].set(ylabel="Kinetic energy / A² (J/N²)", ylim=(0, None))
    grid[0, 0].legend(loc="upper left")
    grid[1, 0].set(ylabel="Relative error")
    grid[1, 0].annotate("1 %", (1, 0.01), (-2, -2), xycoords=("axes fraction", "data"), textcoords="offset points",
                        ha="right", va="top", color=style.VERMILION)  # fmt: skip
    grid[2, 0].set(ylabel="Share of KE between bins")
    return figure
