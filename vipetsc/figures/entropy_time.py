"""Wavenumber entropy in time: over the cells at three amplitudes, and over the amplitudes of an ensemble."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import h5py
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.entropy import FACETS, Curves, measured, stem
from vipetsc.figures.scattering import mark_sites
from vipetsc.figures.series import Series, WholeRun, series_of
from vipetsc.figures.study import Study

MOST_COLUMNS = 3
COLOURS = "viridis"
QUIET = 1e-5  # cells quieter than this share of the loudest are left blank


def entropy_maps(study: Study) -> Iterator[Drawing]:
    """H(x, t) at three amplitudes to one scale, with the energy-weighted H(t) over each; quiet cells are blank."""
    for series in series_of(study, "entropy/local"):
        yield series.suffix, partial(_maps, series)


def _maps(series: Series) -> Figure:
    figure = style.new_figure(style.PAGE, 2.7)
    figure.suptitle(series.title, fontsize=8)
    panels = figure.subplots(1, 3, sharey=True)
    local = [_heard(member).T for member in series.runs]
    norm = _limits(local)
    for column, member, heading in series.headings():
        axes, group = panels[column], member.analysis["entropy"]
        time, cells, history = group["snapshot"][...], member.analysis["cell"][...], group["history"][...]
        image = style.draw_map(axes, time, cells, local[column], norm, COLOURS)
        mark_sites(axes, member, "y", style.GREY)
        # The line shares the colours' limits, so that the colour bar is its axis too.
        over = axes.twinx()
        over.plot(time, history, color="white", lw=2.0)
        over.plot(time, history, color=style.VERMILION, lw=0.9, label="H(t)")
        over.axvline(group.attrs["start"], color=style.BLACK, lw=0.7, ls="--", label="averages begin")
        over.set(ylim=(norm.vmin, norm.vmax), xlim=time[[0, -1]], yticks=[])
        style.letter(axes, f"({'abc'[column]}) {heading}")
        axes.set_xlabel("Time (s)")
    over.legend(loc="upper left")
    panels[0].set_ylabel("Cell")
    figure.colorbar(image, ax=list(panels), label="H(x, t) and line: H(t) (bit)", pad=0.01, extend="both")
    return figure


def _heard(member: WholeRun) -> np.ndarray:
    """H (t, cell), NaN where only the wavelets' tails are: where their energy is below ``QUIET`` of its largest."""
    local, weight = member.analysis["entropy/local"][...], member.analysis["entropy/weight"][...]
    return np.where(weight > QUIET * weight.max(), local, np.nan)


def _limits(fields: Sequence[np.ndarray]) -> Normalize:
    """Colours from the lowest to the highest percentile of what is finite in the fields."""
    low, high = np.nanpercentile(np.concatenate([f[np.isfinite(f)].ravel() for f in fields] or [[0, 1]]), (2, 99.8))
    return Normalize(low, high if high > low else low + 1)


def entropy_history(study: Study) -> Iterator[Drawing]:
    """H(t) against amplitude as an image for every configuration of a reading and wavenumber."""
    for curves, named in measured(study):
        if not Curves.there(curves.ensemble, "entropy/history"):
            continue
        for facet in curves.facets():
            places = [p for p in curves.places(facet) if np.isfinite(curves.row("entropy/history", p)).any()]
            if places:
                yield stem(curves, places[0], named, FACETS), partial(_history, curves, places)


def _history(curves: Curves, places: list[tuple[int, ...]]) -> Figure:
    columns = min(len(places), MOST_COLUMNS)
    rows = -(-len(places) // columns)
    figure = style.new_figure(max(style.PAGE * columns / MOST_COLUMNS, style.COLUMN), 0.7 + 1.9 * rows)
    figure.suptitle(f"{curves.title(places[0])}, entropy H(t) of every amplitude", fontsize=8)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    found = [curves.row("entropy/history", place) for place in places]
    starts = [_start(curves, place) for place in places]
    later = [
        np.where(curves.row("entropy/time", place) >= start, history, np.nan)
        for place, history, start in zip(places, found, starts, strict=True)
    ]
    norm = _limits(later)
    for axes, place, history, start in zip(grid.flat, places, found, starts, strict=False):
        image = _image(axes, curves, place, history, norm)
        if start > 0:
            axes.axvline(start, color="white", lw=0.7, ls="--")
        style.letter(axes, curves.words(place))
    for axes in grid.flat[len(places) :]:
        axes.set_axis_off()
    for axes in grid[-1]:
        axes.set_xlabel("Time (s)")
    for axes in grid[:, 0]:
        axes.set_ylabel("Amplitude A (N)")
    figure.colorbar(image, ax=list(grid.flat), label="H(t) (bit)", pad=0.01, extend="both")
    return figure


def _image(axes: Axes, curves: Curves, place: tuple[int, ...], history: np.ndarray, norm: Normalize):
    """The image of H(t), dotted where contact begins."""
    times = curves.row("entropy/time", place)
    time = times[np.argmax(np.isfinite(times).sum(axis=1))]
    kept = np.isfinite(time)
    image = axes.pcolormesh(
        time[kept], curves.amplitude, history[:, kept], norm=norm, cmap=COLOURS, shading="nearest", rasterized=True
    )
    axes.set(yscale="log", xlim=time[kept][[0, -1]])
    touched = curves.row("contact_episodes", place) > 0
    if touched.any() and not touched.all():
        first = int(np.argmax(touched))
        axes.axhline(np.sqrt(curves.amplitude[first - 1] * curves.amplitude[first]), color="white", lw=0.8, ls=":")
    return image


def _start(curves: Curves, place: tuple[int, ...]) -> float:
    """When the averages over time begin, in s, from the analysis of the first member; 0 if it is gone."""
    path = curves.ensemble.member(curves.full(place)) / "analysis.h5"
    if not path.exists():
        return 0.0
    with h5py.File(path, "r") as file:
        return float(file["entropy"].attrs["start"]) if "entropy" in file else 0.0
