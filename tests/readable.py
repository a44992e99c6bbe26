"""Faults of a figure's text: outside the page, over other text, too few labels, panels without letters, legends."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.text import Text

OVERLAP = 2  # pixels that boxes of text may have in common: a box is higher than the letters in it
FEWEST = 3  # labels of a logarithmic axis: with fewer the values between them cannot be estimated


def complaints(figure: Figure) -> list[str]:
    """Return a sentence for each fault of the text in a laid-out figure."""
    return [*_texts(figure), *_logarithmic_axes(figure), *_letters(figure), *_legends(figure)]


def _texts(figure: Figure) -> Iterator[str]:
    """Yield a sentence for each text outside the page, and for each two texts that overlap."""
    FigureCanvasAgg(figure)
    figure.draw_without_rendering()
    renderer = figure.canvas.get_renderer()
    hidden = set(_hidden(figure))
    boxes = []
    for text in figure.findobj(Text):
        if text.get_visible() and text.get_text().strip() and text not in hidden:
            box = text.get_window_extent(renderer)
            boxes.append((text.get_text(), box))
            if min(box.x0, box.y0) < -1 or box.x1 > figure.bbox.width + 1 or box.y1 > figure.bbox.height + 1:
                yield f"outside the page: {text.get_text()!r}"

    for (first, a), (second, b) in combinations(boxes, 2):
        width = min(a.x1, b.x1) - max(a.x0, b.x0)
        height = min(a.y1, b.y1) - max(a.y0, b.y0)
        if min(width, height) > OVERLAP:
            yield f"one over the other: {first!r}, {second!r}"


def _hidden(figure: Figure) -> Iterator[Text]:
    """Yield labels that are not drawn: of ticks beyond their axis, of ticks and of axes that are switched off."""
    for axes in figure.findobj(Axes):
        for axis in (axes.xaxis, axes.yaxis):
            if not axes.axison:
                yield from axis.findobj(Text)
            low, high = sorted(axis.get_view_interval())
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
                beyond = not low <= tick.get_loc() <= high
                yield from (label for label in (tick.label1, tick.label2) if beyond or not label.get_visible())


def _logarithmic_axes(figure: Figure) -> Iterator[str]:
    """Yield a sentence for each logarithmic axis with fewer than ``FEWEST`` labels within its limits."""
    for axes in figure.get_axes():
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            inside = [place for place in axis.get_majorticklocs() if low * (1 - 1e-9) <= place <= high * (1 + 1e-9)]
            if axes.axison and axis.get_scale() == "log" and len(inside) < FEWEST:
                yield f"{axes.get_title('left')!r}: {len(inside)} labels along {axis.axis_name}"


def _letters(figure: Figure) -> Iterator[str]:
    """Yield a sentence for each panel without a letter in a figure of several panels.

    The panels of a subfigure may share one letter, in the title of the subfigure.
    """
    together = {part for part in figure.findobj(lambda one: getattr(one, "_suptitle", None)) if _begins(part._suptitle)}
    shown = [axes for axes in figure.get_axes() if axes.axison and axes.get_label() != "<colorbar>"]
    # A second axis of a panel has the letter of the first.
    shown = [axes for number, axes in enumerate(shown) if not any(_on_one_place(axes, one) for one in shown[:number])]
    for axes in shown:
        if len(shown) > 1 and axes.figure not in together and not axes.get_title("left").startswith("("):
            yield f"no letter: {axes.get_title('left')!r}, {axes.get_ylabel()!r}"


def _legends(figure: Figure) -> Iterator[str]:
    """Yield a sentence for each entry that a legend has twice."""
    for legend in figure.findobj(Legend):
        entries = [text.get_text() for text in legend.get_texts()]
        yield from (f"twice in a legend: {entry!r}" for entry in set(entries) if entries.count(entry) > 1)


def _on_one_place(axes: Axes, other: Axes) -> bool:
    """Whether two axes are those of one panel."""
    return bool(np.allclose(axes.get_position().bounds, other.get_position().bounds))


def _begins(text: Text) -> bool:
    """Whether a title begins with a panel's letter."""
    return text.get_text().startswith("(")
