"""Panels of a sweep's measures: curves with bands, maps with contours, samples; their titles, legends and ticks."""

from collections.abc import Sequence
from textwrap import wrap
from typing import Any, NamedTuple, Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import Locator, LogLocator, MaxNLocator, NullLocator

from vipetsc.figures import style
from vipetsc.figures.log_ticks import has_room, label_log_axis, log_ticks
from vipetsc.figures.page import Page, add_letters
from vipetsc.figures.panels import colour_bar
from vipetsc.figures.series import Series
from vipetsc.figures.swept_axes import SweptAxis
from vipetsc.wording import key_name

MARKERS = "os^Dv*"  # of curves, in their order
SINGLE = 4.8  # width in inches of a page with one panel
LETTERS = 17  # letters of a page's title that fit into an inch
BELOW = 0.4  # inches that the ticks and the label below a panel take
PANEL_LETTERS = 15  # letters of a panel's title on an inch; fewer, since titles side by side must not touch
LEGEND_LETTERS = 17  # letters of a legend that fit into an inch
MOST_COLUMNS = 4  # columns of panels
MOST_TICKS = 8  # values of a key up to which each is a tick with a label
SIDES = 0.9  # inches of a page's width that its labels and its colour bar take
PANEL_HEIGHT = 1.4  # inches that a panel is high at least
USED = 0.85  # fraction of the length of an axis between the first and the last position
# Ratio of the largest to the smallest value of a measure above which its scale is logarithmic: of the two decades the
# lower one would have a tenth of a linear scale.
LOG_RATIO = 100.0
# Most contours on a map: on a single map, and on one of several, where labels have less room.
CONTOURS_ON_ONE = 6
CONTOURS_ON_SEVERAL = 3
BAND = "band "
TOGETHER = "band\u00a0"  # no line ends between a band and its number


class Curve(NamedTuple):
    """A curve of a panel: ``values`` (position,), and the ends of its ``band`` (position,) over samples or None.

    ``number`` is that of the curve among those of its panel, from 0, which are the same in all panels. ``colour`` is
    that of the pass band that the curve shows, or empty where curves are no bands.
    """

    label: str
    number: int
    values: np.ndarray
    band: tuple[np.ndarray, np.ndarray] | None
    colour: str = ""

    @property
    def look(self) -> dict[str, Any]:
        """The colour, the marker and the line of the curve in all panels."""
        colour = self.colour or f"C{self.number}"
        return {"color": colour, "marker": MARKERS[self.number % len(MARKERS)], "ms": 3, "lw": 0.9}


class CommonAxes(NamedTuple):
    """What the axes of one measure have to show on the pages of several sweeps: values, and positions along x (and y).

    Each is a list of all numbers (n,), in no order.
    """

    values: np.ndarray
    x: np.ndarray
    y: np.ndarray


class MeasurePage(NamedTuple):
    """A ``page`` of panels of a measure with its ``label``.

    ``legend_labels`` are the texts of its legend, in ``legend_columns``. ``label_height``, the length of a label along
    y, is in inches.
    """

    page: Page
    label: str
    label_height: float
    legend_labels: Sequence[str]
    legend_columns: int

    @classmethod
    def of(
        cls, label: str, lines: Sequence[str], titles: Sequence[str], legend: Sequence[str] = (), columns: int = 0
    ) -> Self:
        """Return a page with a panel for each of ``titles``, in so many ``columns`` unless they are 0 or too many.

        The first of its ``lines`` is the heading, the others are notes below the picture.
        """
        count = len(titles)
        if not 0 < columns <= MOST_COLUMNS:
            # As few rows as possible, and these equally long: five panels are three and two, not four and one.
            columns = -(-count // -(-count // MOST_COLUMNS))
        rows = -(-count // columns)
        width = SINGLE if count == 1 else style.PAGE
        heading = style.wrapped_heading(lines[0], width)
        height = 2.4
        if rows > 1:
            height = 0.3 + 1.75 * rows
        above = 0.15 * (1 + heading.count("\n"))

        # As many columns as the longest label has room for, with six letters for its mark and the gaps.
        longest = max(map(len, legend), default=0) + 6
        legend_columns = max(1, min(len(legend), int(LEGEND_LETTERS * width / longest)))
        page = Page.of(
            rows,
            columns,
            width=width,
            height=height + above,
            heading=lines[0],
            count=count,
            legend=-(-len(legend) // legend_columns),
            sharex=True,
            sharey=True,
        )
        for line in filter(None, lines[1:]):
            style.add_note(page.figure, line)
        for index, (axes, title) in enumerate(zip(page.panels, titles, strict=True)):
            axes.set_title(title.replace(BAND, TOGETHER))
            # The last panel of each column has the labels of the ticks, also above an empty place.
            axes.tick_params(labelbottom=index + columns >= count)
        add_letters(page.panels)
        letters = int(PANEL_LETTERS * (width - 0.6) / columns)
        for axes in page.panels:
            axes.set_title("\n".join(wrap(axes.get_title("left"), letters)))
        # A label in the middle of the page's left edge ends below the title, and above the label of the other axis.
        return cls(page, label, height - above - BELOW, legend, legend_columns)

    @property
    def width(self) -> float:
        """The width of the page in inches."""
        return float(self.page.figure.get_figwidth())

    def label_axes(self, x: SweptAxis, y: str) -> None:
        """Write what the axes of all panels are, and ticks at the values of ``x``."""
        columns = self.page.grid.shape[1]
        for axes in self.page.panels:
            label_positions(axes.xaxis, x, (self.width - SIDES) / columns)
        self.page.body.supxlabel("\n".join(wrap(x.label, int(LETTERS * self.width))))
        self.page.body.supylabel("\n".join(wrap(y, int(LETTERS * self.label_height))))

    def finish_curves(self, x: SweptAxis, values: np.ndarray, common: CommonAxes | None = None) -> Figure:
        """Label and scale the axes of all panels of curves, and write the legend; return the figure.

        ``values`` (...) are those of all curves and the ends of their bands. With pages of other sweeps the axes are
        ``common`` to all, but along categories, which each page has of its own.
        """
        if common:
            values = common.values
        finite = values[np.isfinite(values)]
        first = self.page.panels[0]

        # The panels share their axes: scales and limits of the first one are those of all.
        if common:
            corners = [(common.x.min(), finite.min()), (common.x.max(), finite.max())]
            first.update_datalim(corners, updatex=x.is_number)
            first.autoscale_view()
        if finite.min() > 0 and finite.max() > LOG_RATIO * finite.min():
            first.set_yscale("log")
            label_log_axis(first.yaxis, float(finite.min()), float(finite.max()), USED * PANEL_HEIGHT)
        # From 0 on, where that takes less than half of the axis: ratios can then be read off.
        elif 0 <= finite.min() < 0.5 * finite.max():
            first.set_ylim(bottom=0)

        self.label_axes(x, self.label)
        self.write_legend()
        return self.page.figure

    def write_legend(self) -> None:
        """Write the legend of the curves in the strip below all panels."""
        handles = self.page.panels[0].get_legend_handles_labels()[0]
        if self.legend_labels:
            self.page.write_legend(handles, self.legend_labels, self.legend_columns)


def draw_curves(axes: Axes, x: SweptAxis, curves: Sequence[Curve], ring: tuple[int, float] | None) -> None:
    """Draw ``curves`` over ``x``, without lines over categories, and a ring at the position and value of ``ring``."""
    # A case may have the values of a key in any order.
    order = np.argsort(x.positions, kind="stable")
    for place, curve in enumerate(curves):
        shift = 0.0
        line = "-"
        if not x.is_number:
            # Points over one category stand side by side, and no line joins categories. The ``MOST_CURVES`` of a panel,
            # six, take 0.6 of the distance to the next category.
            shift = 0.12 * (curve.number - 0.5 * (len(curves) - 1))
            line = ""
        positions = x.positions[order] + shift
        # Thinner from curve to curve: those that coincide are seen under one another.
        look = curve.look | {"ls": line, "lw": 0.9 + 0.7 * (len(curves) - 1 - place)}
        band = (curve.band[0][order], curve.band[1][order]) if curve.band else None
        Series(positions, curve.values[order], look, curve.label, band=band).draw(axes)
        # Of the curves the ring belongs to the one that has this value.
        if ring and curve.values[ring[0]] == ring[1]:
            at = x.positions[ring[0]] + shift, ring[1]
            axes.plot(*at, "o", mfc="none", mec=style.BLACK, ms=8, mew=0.8)
    if x.scale == "log":
        axes.set_xscale("log")


class LargestOnMap(NamedTuple):
    """Place of the largest value on a page of maps: its index along ``x`` and ``y``, and that of its ``panel``."""

    x: int
    y: int
    panel: int


def draw_maps(
    page: MeasurePage,
    x: SweptAxis,
    y: SweptAxis,
    fields: Sequence[np.ndarray],
    ring: LargestOnMap | None,
    common: CommonAxes | None = None,
) -> Figure:
    """Draw ``fields`` (y, x) in the panels of ``page`` with one scale of colours and contours; return the figure.

    A ``ring`` marks the largest value. With pages of other sweeps, axes and colours are ``common`` to all.
    """
    x_order = np.argsort(x.positions, kind="stable")
    y_order = np.argsort(y.positions, kind="stable")
    norm = _norm(np.stack(fields))
    if common:
        norm = _norm(common.values)
    most_contours = CONTOURS_ON_ONE
    if len(fields) > 1:
        most_contours = CONTOURS_ON_SEVERAL
    panels = page.page.panels
    for axes, unordered in zip(panels, fields, strict=True):
        values = unordered[np.ix_(y_order, x_order)]
        # The ground shows where values are missing.
        axes.set(xscale=x.scale, yscale=y.scale, facecolor=style.PALE)
        edges = cell_edges(x.positions[x_order], x.scale), cell_edges(y.positions[y_order], y.scale)
        # Values of both signs have the two sides of a diverging map, white at 0.
        cmap = "RdBu_r" if norm.vmin == -norm.vmax else "viridis"
        image = axes.pcolormesh(*edges, values, norm=norm, cmap=cmap, rasterized=True)
        _draw_contours(axes, x.positions[x_order], y.positions[y_order], values, norm, most_contours)
        label_positions(axes.yaxis, y, PANEL_HEIGHT)
        if common:
            axes.set_xlim(cell_edges(np.unique(common.x), x.scale)[[0, -1]])
            axes.set_ylim(cell_edges(np.unique(common.y), y.scale)[[0, -1]])

    if ring:
        at = x.positions[ring.x], y.positions[ring.y]
        # A white ring below the red one, which is then seen on any colour of the map.
        for colour, thickness in (("white", 2.2), (style.RED, 1.2)):
            panels[ring.panel].plot(*at, "o", mfc="none", mec=colour, mew=thickness, ms=9)
    page.label_axes(x, y.label)
    ticks: dict[str, Any] = {}
    if isinstance(norm, LogNorm):
        ticks = {"ticks": log_ticks(norm.vmin, norm.vmax), "format": "%g"}
    colour_bar(image, panels, "\n".join(wrap(page.label, int(LETTERS * page.label_height))), extend="neither", **ticks)
    return page.page.figure


def _norm(values: np.ndarray) -> Normalize:
    """Return colours for all finite ``values``: logarithmic where these are positive and range far."""
    finite = values[np.isfinite(values)]
    low = float(finite.min())
    high = float(finite.max())
    if low > 0 and high > LOG_RATIO * low:
        return LogNorm(low, high)
    if low < 0 < high:
        return Normalize(-max(-low, high), max(-low, high))
    # A field of one value still needs a scale.
    if high == low:
        high = low + 1
    return Normalize(low, high)


def _draw_contours(axes: Axes, x: np.ndarray, y: np.ndarray, values: np.ndarray, norm: Normalize, most: int) -> None:
    """Draw labelled contours of ``values`` (y, x), at most ``most``; they are light where the map is dark."""
    finite = values[np.isfinite(values)]
    if len(finite) < 4 or np.ptp(finite) == 0:
        return

    locator: Locator = MaxNLocator(most)
    if isinstance(norm, LogNorm):
        locator = LogLocator(numticks=most)
    levels = [level for level in locator.tick_values(norm.vmin, norm.vmax) if finite.min() < level < finite.max()]
    if not levels:
        return
    # The map is dark up to about 0.6 of its scale; a diverging one at both ends.
    is_diverging = norm.vmin == -norm.vmax
    colours = ["white" if norm(level) < (0.15 if is_diverging else 0.6) else "black" for level in levels]
    lines = axes.contour(x, y, np.ma.masked_invalid(values), levels=levels, colors=colours, linewidths=0.6)
    axes.clabel(lines, fmt="%.3g", fontsize=6)


def draw_samples(page: MeasurePage, seeds: np.ndarray, series: Sequence[Curve]) -> Figure:
    """Draw the samples of each of ``series`` over their ``seeds`` (sample,), with their mean and the band of 5 to 95 %.

    Return the figure.
    """
    (axes,) = page.page.panels
    for curve in series:
        look = curve.look
        axes.plot(seeds, curve.values, label=curve.label, **look | {"ls": ""})
        axes.axhspan(*np.nanquantile(curve.values, (0.05, 0.95)), color=look["color"], alpha=0.2, lw=0)
        axes.axhline(np.nanmean(curve.values), color=look["color"], lw=0.9)
    axes.set(xlabel=key_name("disorder.seed"), ylabel=page.label)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return page.page.figure


def cell_edges(positions: np.ndarray, scale: str) -> np.ndarray:
    """Return the edges (n + 1,) of a map's cells around two or more rising ``positions`` (n,).

    They are halfway between the positions on the ``scale``, "linear" or "log"; the outermost cells are symmetric.
    """
    if scale == "log":
        return np.exp(cell_edges(np.log(positions), "linear"))
    middles = 0.5 * (positions[1:] + positions[:-1])
    first = 2 * positions[0] - middles[0]
    last = 2 * positions[-1] - middles[-1]
    return np.concatenate([[first], middles, [last]])


def label_positions(axis: Axis, swept: SweptAxis, length: float) -> None:
    """Put ticks at all values of a ``swept`` axis if their labels have room, else where a scale of numbers has them.

    ``length`` in inches is that of the axis. Categories all have ticks.
    """
    positions = swept.positions
    texts = swept.value_texts
    if not swept.is_number:
        look: dict[str, Any] = {}
        if axis.axis_name == "x" and not has_room(positions, texts, USED * length, is_horizontal=True):
            look = {"rotation": 25, "ha": "right"}
        axis.set_ticks(positions, texts, **look)
        if axis.axis_name == "x":
            axis.axes.set_xlim(-0.5, len(positions) - 0.5)
        return

    on_scale = positions
    if swept.scale == "log":
        on_scale = np.log(positions)
    number = swept.first_number
    assert number is not None
    are_few = len(positions) <= MOST_TICKS
    if are_few and has_room(on_scale, number.value_texts, USED * length, axis.axis_name == "x"):
        axis.set_ticks(positions, number.value_texts)
        axis.set_minor_locator(NullLocator())
    elif swept.scale == "log":
        label_log_axis(axis, float(positions.min()), float(positions.max()), USED * length)
