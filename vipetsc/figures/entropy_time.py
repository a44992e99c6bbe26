"""Wavenumber entropy in time: over the cells at three amplitudes, and over all amplitudes (paper, Fig. A2)."""

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.entropy import FACETS, facet_title, facets, row_title, with_entropies
from vipetsc.figures.panels import label_outer, mark_sites, panel_title, space_time_map
from vipetsc.figures.study import AMPLITUDE, AmplitudeSeries, MeasuredRun, Study, from_series, suffix
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import member_folder

MOST_COLUMNS = 3
COLOURS = "viridis"
LEAST_WEIGHT = 1e-5  # of the largest: cells with less energy are left blank


@from_series("entropy/local")
def entropy_maps(series: AmplitudeSeries) -> Figure:
    """H(x, t) at three amplitudes to one scale, with the energy-weighted H(t) over each; quiet cells are blank."""
    figure = style.new_figure(style.PAGE, 2.7, series.title)
    panels = figure.subplots(1, 3, sharey=True)
    local = [_above_threshold(member) for member in series.runs]
    norm = _limits([field.values for field in local])
    for column, member, heading in series.headings():
        axes, analysis = panels[column], member.analysis
        time = analysis["entropy/snapshot"].values
        image = space_time_map(axes, local[column], norm, COLOURS)
        mark_sites(axes, member.run, style.GREY)
        # The line shares the colours' limits, so that the colour bar is its axis too.
        over = axes.twinx()
        over.plot(time, analysis["entropy/history"], color="white", lw=2.0)
        over.plot(time, analysis["entropy/history"], color=style.VERMILION, lw=0.9, label="H(t)")
        over.axvline(analysis.attrs["entropy/start"], color=style.BLACK, lw=0.7, ls="--", label="averages begin")
        over.set(ylim=(norm.vmin, norm.vmax), xlim=time[[0, -1]], yticks=[])
        panel_title(axes, f"({'abc'[column]}) {heading}")
        axes.set_ylabel("Cell" if column == 0 else "")
    over.legend(loc="upper left")
    figure.colorbar(image, ax=list(panels), label="H(x, t) and line: H(t) (bit)", pad=0.01, extend="both")
    return figure


def _above_threshold(member: MeasuredRun) -> xr.DataArray:
    """H (t, cell), NaN where only the wavelets' tails are: below ``LEAST_WEIGHT`` of their largest energy."""
    weight = member.analysis["entropy/weight"]
    return member.analysis["entropy/local"].where(weight > LEAST_WEIGHT * weight.max())


def _limits(fields: Sequence[np.ndarray]) -> Normalize:
    """Colours from the lowest to the highest percentile of what is finite in the fields."""
    finite = np.concatenate([field[np.isfinite(field)] for field in fields])
    low, high = np.percentile(finite if len(finite) else [0, 1], (2, 99.8))
    return Normalize(low, high if high > low else low + 1)


def entropy_history(study: Study) -> Iterator[Drawing]:
    """H(t) against amplitude as an image for every configuration of a reading and wavenumber."""
    for ensemble, named in with_entropies(study, "entropy/history"):
        for facet in facets(ensemble):
            rows = [row for row in facet if np.isfinite(row["entropy/history"]).any()]
            if rows:
                yield suffix(rows[0], ensemble, named, FACETS), partial(_history, ensemble, rows)


def _history(ensemble: xr.Dataset, configurations: Sequence[xr.Dataset]) -> Figure:
    columns = min(len(configurations), MOST_COLUMNS)
    rows = -(-len(configurations) // columns)
    width = max(style.PAGE * columns / MOST_COLUMNS, style.COLUMN)
    heading = f"{facet_title(configurations[0], ensemble)}, entropy H(t) of every amplitude"
    figure = style.new_figure(width, 0.7 + 1.9 * rows, heading)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    starts = [_start_of_averages(row) for row in configurations]
    norm = _limits([
        row["entropy/history"].where(row["entropy/time"] >= start).values
        for row, start in zip(configurations, starts, strict=True)
    ])  # fmt: skip
    for axes, row, start in zip(grid.flat, configurations, starts, strict=False):
        image = _image(axes, row, norm)
        if start > 0:
            axes.axvline(start, color="white", lw=0.7, ls="--")
        panel_title(axes, row_title(row, ensemble))
    for axes in grid.flat[len(configurations) :]:
        axes.set_axis_off()
    label_outer(grid, "Time (s)", "Amplitude A (N)")
    figure.colorbar(image, ax=list(grid.flat), label="H(t) (bit)", pad=0.01, extend="both")
    return figure


def _image(axes: Axes, row: xr.Dataset, norm: Normalize) -> QuadMesh:
    """The image of H(t) over amplitude, dotted where contact begins."""
    times, history, amplitude = (row[name].values for name in ("entropy/time", "entropy/history", AMPLITUDE))
    time = times[np.argmax(np.isfinite(times).sum(axis=1))]
    finite = np.isfinite(time)
    options = {"norm": norm, "cmap": COLOURS, "shading": "nearest", "rasterized": True}
    image = axes.pcolormesh(time[finite], amplitude, history[:, finite], **options)
    axes.set(yscale="log", xlim=time[finite][[0, -1]])
    touched = row["contact_episodes"].values > 0
    if touched.any() and not touched.all():
        first = int(np.argmax(touched))
        axes.axhline(np.sqrt(amplitude[first - 1] * amplitude[first]), color="white", lw=0.8, ls=":")
    return image


def _start_of_averages(row: xr.Dataset) -> float:
    """When the averages over time begin, in s, from the analysis of the first member; 0 if it is gone."""
    folder = member_folder(row.isel({AMPLITUDE: 0}))
    if folder is None or not (folder / "analysis.h5").exists():
        return 0.0
    with open_netcdf(folder / "analysis.h5", "analysis") as analysis:
        return float(analysis.attrs.get("entropy/start", 0.0))
