"""The contact episodes of a run: their onsets by site, or the indentation of pressed contacts, and sums by site."""

from typing import NamedTuple, Self

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case import Case, Model
from vipetsc.figures import panels, style
from vipetsc.figures.page import Page
from vipetsc.figures.style import NoPicture
from vipetsc.io.read import field_time

MOST_ROWS = 16  # most sites that have a row each, with a marker for each episode; of more there is a map
# Most episodes that have a marker each. More cover each other, and take time: 8,000 markers take as long as the rest of
# the picture, 16,000 twice as long.
MOST_MARKERS = 2000
# Rows and columns of the map, at most. The page is 4.5 inches high at most, so that a row has at least .02 inches, four
# pixels of a picture, which can be seen.
MAP_ROWS = 150
MAP_COLUMNS = 300
MOST_LABELS = 12  # of sites next to a map
SPEEDS = "viridis_r"


class Episodes(NamedTuple):
    """Contact episodes of a run, and the sites where they may be.

    Of each episode (episode,): the ``site``, from 1; its ``side``, 1 or -1; the ``onset`` in s; the ``speed`` of
    approach in m/s; the ``loss`` in J, 0 where it is missing. Of each site (site,) its cell, from 1, in ``cells``.
    ``span`` is the first and the last time of the run in s.
    """

    site: np.ndarray
    side: np.ndarray
    onset: np.ndarray
    speed: np.ndarray
    loss: np.ndarray
    cells: np.ndarray
    span: np.ndarray

    @classmethod
    def of(cls, run: xr.Dataset) -> Self:
        """Return the episodes of ``run``."""
        return cls(
            site=run["impacts/site"].values,
            side=run["impacts/side"].values,
            onset=run["impacts/onset"].values,
            speed=np.abs(run["impacts/approach_velocity"].values),
            loss=np.nan_to_num(run["impacts/loss"].values),
            cells=run["sites/cell"].values,
            span=run["time"].values[[0, -1]],
        )

    @property
    def site_index(self) -> np.ndarray:
        """The site (episode,) of each episode, from 0."""
        return self.site.astype(int) - 1

    @property
    def rows(self) -> np.ndarray:
        """The height (site,) of each site on the common axis of the panels."""
        return np.arange(1, len(self.cells) + 1)

    @property
    def are_few(self) -> bool:
        """True if each site can have a row, and each episode a marker."""
        return len(self.cells) <= MOST_ROWS and len(self.site) <= MOST_MARKERS


def impacts(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Draw the onset of every contact episode by site and side, coloured by approach speed; energy lost per site.

    With more than ``MOST_ROWS`` sites or ``MOST_MARKERS`` episodes there is a map of the largest approach speed
    instead. Where all contacts touch or are pressed from the beginning, there are no impacts: the map is one of their
    indentation, if all displacements were recorded.
    """
    if not run.sizes["site"]:
        raise NoPicture("the lattice has no contact sites")
    if not run.sizes["episode"]:
        raise NoPicture("no contact closed in this run")

    episodes = Episodes.of(run)
    model = Case.of(run).model()
    are_pressed = bool((model.chain.sites.gaps.min(axis=1) <= 0).all()) and "displacement" in run
    has_indentation = are_pressed and len(run["cell"]) == model.chain.cells
    has_rows = episodes.are_few and not has_indentation
    every = 1
    if not has_rows:
        every = -(-len(episodes.cells) // MOST_LABELS)

    height = min(1.3 + 0.24 * len(episodes.cells), 4.5)
    page = Page.of(columns=2, height=height, sharey=True, width_ratios=(4, 1))
    raster, bars = page.panels
    if has_indentation:
        _draw_indentation(raster, run, model)
    elif has_rows:
        _draw_markers(raster, episodes)
    else:
        _draw_speed_map(raster, episodes)
    raster.set_xlabel("Time (s)")
    raster.set_xlim(episodes.span)
    raster.set_ylim(0.4, len(episodes.cells) + 0.6)
    raster.set_yticks(episodes.rows[::every], panels.site_labels(run)[::every])
    raster.set_ylabel(f"Contact site ({panels.sites_title(run)})")
    force = np.abs(run["impacts/force"].values) if are_pressed else None
    _draw_bars(bars, episodes, has_rows, force)
    return page.lettered()


def _draw_indentation(axes: Axes, run: xr.Dataset, model: Model) -> None:
    """Draw a map of the indentation of every contact over time."""
    depth = panels.indentations(run, model)
    rows = np.arange(1, len(depth) + 1)
    image = panels.draw_map(axes, field_time(run), rows, depth, panels.log_norm(depth, decades=3))
    axes.set_title("Indentation")
    panels.colour_bar(image, axes, "Indentation (m)")


def _draw_markers(axes: Axes, episodes: Episodes) -> None:
    """Draw a triangle at the onset of every episode, those of the two sides a little above and below their row."""
    norm = panels.log_norm(episodes.speed, decades=2)
    # Shifted, since both stops of a site may be struck within the width of a marker.
    for side, marker, shift in ((1, "^", 0.13), (-1, "v", -0.13)):
        at = episodes.side == side
        heights = episodes.site[at] + shift
        look = {"marker": marker, "lw": 0, "rasterized": True, "norm": norm, "cmap": SPEEDS}
        image = axes.scatter(episodes.onset[at], heights, 14, episodes.speed[at], **look)
    axes.grid(axis="y", color=style.PALE, lw=0.5)
    axes.set_axisbelow(True)
    axes.set_title(f"{len(episodes.site)} contact episodes (▲ positive side, ▼ negative side)")
    panels.colour_bar(image, axes, "Approach speed (m/s)")


def _draw_speed_map(axes: Axes, episodes: Episodes) -> None:
    """Draw a map of the largest approach speed by site and time, blank where there is no episode."""
    sites_per_row = -(-len(episodes.cells) // MAP_ROWS)
    rows = -(-len(episodes.cells) // sites_per_row)
    begin, end = episodes.span
    column = (episodes.onset - begin) / (end - begin) * MAP_COLUMNS
    column = np.minimum(column, MAP_COLUMNS - 1).astype(int)  # an onset at the end of the run is in the last one

    # fmax takes the speed where there is only a NaN, of a place without an episode so far. By ``at``, since several
    # episodes may fall on one place.
    largest = np.full((rows, MAP_COLUMNS), np.nan)
    np.fmax.at(largest, (episodes.site_index // sites_per_row, column), episodes.speed)

    extent = (begin, end, 0.5, 0.5 + sites_per_row * rows)
    norm = panels.log_norm(episodes.speed, decades=2)
    image = axes.imshow(largest, extent=extent, norm=norm, cmap=SPEEDS)
    axes.set_title(f"{len(episodes.site)} contact episodes")
    panels.colour_bar(image, axes, "Largest approach speed (m/s)")


def _draw_bars(axes: Axes, episodes: Episodes, has_rows: bool, force: np.ndarray | None) -> None:
    """Draw a bar for every site: the largest ``force`` of its episodes if given, or the loss, or how many there are."""
    sites = len(episodes.cells)
    count = np.bincount(episodes.site_index, minlength=sites)
    loss = np.bincount(episodes.site_index, episodes.loss, sites)
    length: np.ndarray
    if force is not None:
        length = np.zeros(sites)
        np.fmax.at(length, episodes.site_index, force)
        axes.set(title="Largest force", xlabel="Force (N)")
    elif loss.any():
        length = loss
        axes.set(title="Loss, episodes" if has_rows else "Loss", xlabel="Energy lost (J)")
    else:
        length = count
        axes.set(title="Episodes", xlabel="Episodes")

    colour = style.VERMILION if loss.any() else style.BLUE
    # Bars of many sites touch each other, so that they form a profile.
    height = 0.6 if has_rows else 1.0
    row = axes.barh(episodes.rows, length, height, color=colour)
    room = 1.05
    if has_rows:
        axes.bar_label(row, count, padding=2)
        room = 1.25
    axes.set_xlim(0, room * length.max())
    axes.tick_params(left=False)
