"""Wavenumber entropy in time: over the cells at three amplitudes, and over the amplitudes of an ensemble."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import h5py
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.entropy import FACETS, Curves, measured, stem
from vipetsc.figures.scattering import mark_sites
from vipetsc.figures.series import Series, series_of

if TYPE_CHECKING:
    from vipetsc.figures.studies import Study

MOST_COLUMNS = 3
COLOURS = "viridis"


def entropy_maps(study: Study) -> Iterator[tuple[str, Figure]]:
    """H(x, t) at three amplitudes to one scale, with the energy-weighted H(t) over each."""
    for series in series_of(study, "entropy/local"):
        yield series.suffix, _maps(series)


def _maps(series: Series) -> Figure:
    figure = style.new_figure(style.PAGE, 2.7)
    figure.suptitle(series.title, fontsize=8)
    panels = figure.subplots(1, 3, sharey=True)
    local = [member.analysis["entropy/local"][...].T for member in series.runs]
    norm = Normalize(0, max(float(h.max()) for h in local) or 1.0)
    twins = []
    for column, member, heading in series.headings():
        axes, group = panels[column], member.analysis["entropy"]
        time, cells = group["snapshot"][...], member.analysis["cell"][...]
        image = style.draw_map(axes, time, cells, local[column], norm, COLOURS)
        mark_sites(axes, member, "y")
        over = axes.twinx()
        over.plot(time, group["history"][...], color="white", lw=1.8)
        over.plot(time, group["history"][...], color=style.VERMILION, lw=0.9)
        over.axvline(group.attrs["start"], color="white", lw=0.7, ls="--")
        over.set(ylim=(norm.vmin, norm.vmax), xlim=time[[0, -1]])
        over.tick_params(axis="y", colors=style.VERMILION, labelright=column == 2)
        style.letter(axes, f"({'abc'[column]}) {heading}")
        axes.set_xlabel("Time (s)")
        twins.append(over)
    panels[0].set_ylabel("Cell")
    twins[-1].set_ylabel("H(t) (bit)", color=style.VERMILION)
    figure.colorbar(image, ax=[*panels, *twins], label="H(x, t) (bit)", pad=0.01)
    return figure


def entropy_history(study: Study) -> Iterator[tuple[str, Figure]]:
    """H(t) against amplitude as an image for every configuration of a reading and wavenumber."""
    for curves, named in measured(study):
        if not Curves.there(curves.ensemble, "entropy/history"):
            continue
        for facet in curves.facets():
            places = [p for p in curves.places(facet) if np.isfinite(curves.row("entropy/history", p)).any()]
            if places:
                yield stem(curves, places[0], named, FACETS), _history(curves, places)


def _history(curves: Curves, places: list[tuple[int, ...]]) -> Figure:
    columns = min(len(places), MOST_COLUMNS)
    rows = -(-len(places) // columns)
    figure = style.new_figure(max(style.PAGE * columns / MOST_COLUMNS, style.COLUMN), 0.7 + 1.9 * rows)
    words = f"{curves.reading(places[0])} reading".capitalize(), curves.wavenumber(places[0])
    figure.suptitle(", ".join(filter(None, (*words, "entropy H(t) of every amplitude"))), fontsize=8)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    found = [curves.row("entropy/history", place) for place in places]
    norm = Normalize(0, max(float(np.nanmax(h)) for h in found) or 1.0)
    for axes, place, history in zip(grid.flat, places, found, strict=False):
        image = _image(axes, curves, place, history, norm)
        style.letter(axes, curves.words(place))
    for axes in grid.flat[len(places) :]:
        axes.set_axis_off()
    for axes in grid[-1]:
        axes.set_xlabel("Time (s)")
    for axes in grid[:, 0]:
        axes.set_ylabel("Amplitude A (N)")
    figure.colorbar(image, ax=list(grid.flat), label="H(t) (bit)", pad=0.01)
    return figure


def _image(axes: Axes, curves: Curves, place: tuple[int, ...], history: np.ndarray, norm: Normalize):
    """The image; dotted where contact begins, dashed where the averages over time do."""
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
    start = _start(curves, place)
    if start is not None:
        axes.axvline(start, color="white", lw=0.7, ls="--")
    return image


def _start(curves: Curves, place: tuple[int, ...]) -> float | None:
    """When the averages begin, from the analysis of the first member; None if it is gone."""
    path = curves.ensemble.member(curves.full(place)) / "analysis.h5"
    if not path.exists():
        return None
    with h5py.File(path, "r") as file:
        return float(file["entropy"].attrs["start"]) if "entropy" in file else None
