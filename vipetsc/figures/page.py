"""A page of panels: letters before their titles, empty places behind the last one, a legend in a strip below all."""

from collections.abc import Iterable
from dataclasses import dataclass
from string import ascii_lowercase
from typing import Any, Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from vipetsc.figures import style

# Numerals of the panels of a group. Further ones have none.
ROMAN = ("i", "ii", "iii", "iv", "v", "vi", "vii", "viii", "ix", "x", "xi", "xii")
LEGEND_LINE = 0.14  # height in inches of a line of a legend
LEGEND_MARGIN = 0.08  # above and below a legend together


@dataclass(frozen=True)
class Page:
    """A ``figure`` with a ``grid`` (row, column) of panels.

    They stand in ``body``, the figure without the ``strip`` of its legend, which is None on a page without one.
    ``count`` is the number of panels where they are a list: the places behind are empty. It is 0 for a table, whose
    columns and rows each have a meaning.
    """

    figure: Figure
    body: Figure | SubFigure
    grid: np.ndarray
    strip: SubFigure | None = None
    count: int = 0

    @classmethod
    def of(
        cls,
        rows: int = 1,
        columns: int = 1,
        *,
        height: float,
        width: float = 0.0,
        heading: str = "",
        count: int = 0,
        legend: int = 0,
        **options: Any,
    ) -> Self:
        """Return a page, ``height`` inches high without its legend, of that many lines, 0 for none.

        By default its ``width`` in inches is that of a page, or of a journal's column for one column of panels.
        ``options`` are those of ``Figure.subplots``.
        """
        if not width:
            width = style.PAGE if columns > 1 else style.COLUMN
        if not legend:
            figure = style.new_figure(width, height, heading)
            return cls(figure, figure, _grid(figure, rows, columns, count, options), count=count)

        strip_height = LEGEND_MARGIN + LEGEND_LINE * legend
        figure = style.new_figure(width, height + strip_height)
        body, strip = figure.subfigures(2, 1, height_ratios=(height, strip_height), hspace=0)
        if heading:
            body.suptitle(style.wrapped_heading(heading, width))
        return cls(figure, body, _grid(body, rows, columns, count, options), strip=strip, count=count)

    @property
    def panels(self) -> list[Axes]:
        """The panels that show something, row by row."""
        panels: list[Axes] = self.grid.ravel().tolist()
        return panels[: self.count or None]

    def write_legend(self, handles: Iterable[Any], labels: Iterable[str], columns: int = 1) -> None:
        """Write the ``labels`` of curves into the strip below the panels."""
        assert self.strip is not None
        self.strip.legend(list(handles), list(labels), loc="center", ncols=columns)

    def lettered(self) -> Figure:
        """Begin the titles of the panels with letters, if there are several; return the figure.

        Panels of a table have the letter of their column and the numeral of their row.
        """
        if self.count or min(self.grid.shape) == 1:
            add_letters(self.panels)
        else:
            add_letters(self.grid.T)
        return self.figure


def _grid(body: Figure | SubFigure, rows: int, columns: int, count: int, options: dict[str, Any]) -> np.ndarray:
    """Return the grid (row, column) of axes in ``body``, of which those behind the first ``count`` are hidden."""
    grid: np.ndarray = body.subplots(rows, columns, squeeze=False, **options)
    for axes in grid.flat[count or grid.size :]:
        axes.set_axis_off()
    return grid


def add_letters(groups: Iterable[Axes | Iterable[Axes]]) -> None:
    """Begin the titles of panels with (a), (b), ..., those of a group with (b.i), (b.ii), ...; a single one has none.

    Panels beyond the last letter or numeral have none either. Titles stand at the left, where the style puts them.
    """
    listed = [[group] if isinstance(group, Axes) else list(group) for group in groups]
    if sum(map(len, listed)) == 1:
        return
    for tag, group in zip(ascii_lowercase, listed, strict=False):
        numerals = [f".{numeral}" for numeral in ROMAN] if len(group) > 1 else [""]
        for axes, numeral in zip(group, numerals, strict=False):
            axes.set_title(f"({tag}{numeral}) {axes.get_title('left')}".rstrip())


def legend_entries(panels: Iterable[Axes]) -> dict[str, Any]:
    """Return the handles of all curves in ``panels`` by their labels, each label once."""
    entries: dict[str, Any] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    return entries
