"""The wave's energy in twelve wavenumber bins, in space-time and reconstructed (paper, Figs. 4 and A1)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.panels import ROMAN, colour_bar, log_norm, mark_sites, panel_title, space_time_map
from vipetsc.figures.series import AmplitudeSeries, series_of
from vipetsc.figures.study import MeasuredRun, Study
from vipetsc.lattice import bloch

SHOWN = 7
DECADES = 4
LEVEL = 0.003  # of the largest energy of any bin: where the contours lie
FIELD = "partition/kinetic_energy"  # (bin, snapshot, cell)
BLUR = 0.006, 0.01  # of all snapshots and cells: the carrier's beat is smoothed out before contours are drawn


def bin_colours(count: int) -> np.ndarray:
    """Colours (bin, rgba) in the order of the spectrum, dark enough for lines."""
    return mpl.colormaps["turbo"](np.linspace(0.04, 0.96, count)) * (0.85, 0.85, 0.85, 1.0)


def shown_bins(wavenumber: float, count: int, shown: int = SHOWN) -> list[int]:
    """``shown`` of ``count`` bins (0-based), spread evenly, the bin of ``wavenumber`` and the nearer neighbour in it.

    At 5 pi/9 these are bins 1, 3, 5, 7, 8, 10 and 12 of twelve.
    """
    position = wavenumber * count / np.pi
    driven = min(int(position), count - 1)
    above = driven + 1 < count and (position - driven >= 0.5 or driven == 0)
    pair = driven, driven + 1 if above else driven - 1
    bins = [round(b) for b in np.linspace(0, count - 1, min(shown, count))]
    for b in pair:
        if b not in bins:
            bins[min((i for i, c in enumerate(bins) if c not in pair), key=lambda i: abs(bins[i] - b))] = b
    return sorted(bins)


def partition(study: Study) -> Iterator[Drawing]:
    """Energy of seven bins in space-time at the medium amplitude; contours of all bins; the band in their colours."""
    for series in series_of(study, FIELD):
        if series.drives_a_wave:
            yield series.suffix, partial(_partition, series)


def _partition(series: AmplitudeSeries) -> Figure:
    medium = series.runs[1]
    heading = f"{series.title}; maps: medium amplitude, {medium.amplitude:g} N"
    figure = style.new_figure(style.PAGE, 6.6, heading)
    upper, lower = figure.subfigures(2, 1, height_ratios=(2, 1.1))
    field = medium.analysis[FIELD].load()
    colours = bin_colours(len(field))
    *maps, band = upper.subplots(2, 4).flat
    _maps(maps, medium.run, field, shown_bins(series.wave.wavenumber, len(field)))
    colour_bar(upper, maps[0].images[0], [*maps, band], "Energy of a bin in a cell (J)", aspect=40)
    _coloured_band(band, series, medium.analysis["partition/bounds"].values, colours)
    panels = lower.subplots(1, 3, sharey=True)
    for column, member, heading in series.headings():
        _contours(panels[column], member, colours)
        panel_title(panels[column], f"(b.{ROMAN[column]}) {heading}")
        panels[column].set_xlabel("Time (s)")
    panels[0].set_ylabel("Cell")
    edges = np.arange(len(colours) + 1) + 0.5
    keys = mpl.cm.ScalarMappable(BoundaryNorm(edges, len(colours)), ListedColormap(colours))
    bar = lower.colorbar(keys, ax=panels, label="Bin", pad=0.01, ticks=np.arange(1, len(colours) + 1))
    bar.ax.tick_params(length=0, labelsize=6)
    bar.minorticks_off()
    return figure


def _maps(panels: Sequence[Axes], run: xr.Dataset, field: xr.DataArray, bins: Sequence[int]) -> None:
    """Energy of the ``bins`` in space-time to one scale; panels without a bin are left empty."""
    norm = log_norm(float(field[list(bins)].max()), DECADES)
    for i, axes in enumerate(panels):
        if i >= len(bins):
            axes.set_axis_off()
            continue
        space_time_map(axes, field[bins[i]], norm)
        mark_sites(axes, run)
        panel_title(axes, f"(a.{ROMAN[i]}) $K_{{{bins[i] + 1}}}$")
        axes.set_ylabel("" if i % 4 else "Cell")
        axes.tick_params(labelleft=i % 4 == 0)


def _contours(axes: Axes, member: MeasuredRun, colours: np.ndarray) -> None:
    """Every bin where its energy exceeds ``LEVEL`` of the largest of any, filled and outlined in its colour."""
    field, cells = member.analysis[FIELD].values, member.analysis["cell"].values
    time = member.analysis["partition/snapshot"].values
    step = max(1, len(cells) // 300)
    widths = [share * length for share, length in zip(BLUR, field.shape[1:], strict=True)]
    smooth = [gaussian_filter(energy, widths, mode="nearest")[:, ::step] for energy in field]
    level = LEVEL * max(float(energy.max()) for energy in smooth)
    # The strongest lie beneath, so that what is scattered out of them is seen.
    for b in sorted(range(len(smooth)), key=lambda b: -smooth[b].sum()):
        if smooth[b].max() > level > 0:
            axes.contourf(time, cells[::step], smooth[b].T, [level, np.inf], colors=[colours[b]], alpha=0.35)
            axes.contour(time, cells[::step], smooth[b].T, [level], colors=[colours[b]], linewidths=0.6)
    mark_sites(axes, member.run, style.GREY)
    axes.set(xlim=time[[0, -1]], ylim=cells[[0, -1]])


def _coloured_band(axes: Axes, series: AmplitudeSeries, bounds: np.ndarray, colours: np.ndarray) -> None:
    """The driven band, each bin's part of it in the bin's colour; the driven wavenumber dotted."""
    cell, band = series.runs[0].model.chain.cell, series.wave.band
    for low, high, colour in zip(bounds[:-1], bounds[1:], colours, strict=True):
        kappa = np.linspace(low, high, 31)
        axes.plot(kappa / np.pi, bloch(cell, kappa).frequency[:, band - 1] / 1e3, color=colour, lw=3,
                  solid_capstyle="butt")  # fmt: skip
    axes.axvline(series.wave.wavenumber / np.pi, color=style.BLACK, lw=0.6, ls=":")
    axes.set(xlabel="κ (π rad/cell)", ylabel="ω (krad/s)", xlim=(0, 1))
    panel_title(axes, f"(c) Band {band} by bin")


def reconstruction(study: Study) -> Iterator[Drawing]:
    """Kinetic energy and that of the bins' sum over time, their relative error, and the share between bins."""
    for series in series_of(study, "partition/reconstructed"):
        yield series.suffix, partial(_reconstruction, series)


def _reconstruction(series: AmplitudeSeries) -> Figure:
    figure = style.new_figure(style.PAGE, 5.0, series.title)
    grid = figure.subplots(3, 3, sharex="col", sharey="row")
    for column, member, heading in series.headings():
        time, kinetic, reconstructed, error, cross, parts = (
            member.analysis[f"partition/{name}"].values
            for name in ("snapshot", "kinetic", "reconstructed", "error", "cross_share", "energy")
        )
        square = member.amplitude**2
        energies, errors, shares = grid[:, column]
        energies.plot(time, kinetic / square, color=style.BLACK, lw=1.4, label="KE of the lattice")
        energies.plot(time, reconstructed / square, color=style.ORANGE, lw=0.8, ls=(0, (3, 2)),
                      label="KE of the bins' sum")  # fmt: skip
        energies.plot(time, parts.sum(axis=0) / square, color=style.BLUE, lw=0.7, label="sum of the twelve KE")
        errors.semilogy(time, np.where(error > 0, error, np.nan), color=style.BLUE, lw=0.7)
        errors.axhline(0.01, color=style.VERMILION, lw=0.8, ls="--")
        shares.plot(time, cross, color=style.GREEN, lw=0.8)
        shares.set(ylim=(0, 1), xlabel="Time (s)", xlim=time[[0, -1]])
        shares.locator_params(axis="x", nbins=5)
        for row, axes in enumerate(grid[:, column]):
            panel_title(axes, f"({'abc'[column]}.{ROMAN[row]})" + f" {heading}" * (row == 0))
    grid[0, 0].set(ylabel="Kinetic energy / A² (J/N²)", ylim=(0, None))
    grid[0, 0].legend(loc="upper left")
    grid[1, 0].set(ylabel="Relative error")
    grid[1, 0].annotate("1 %", (1, 0.01), (-2, -2), xycoords=("axes fraction", "data"), textcoords="offset points",
                        ha="right", va="top", color=style.VERMILION)  # fmt: skip
    grid[2, 0].set(ylabel="Share of KE between bins")
    return figure
