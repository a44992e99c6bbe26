"""The layout of a figure, for which the text next to its axes is measured once.

Constrained layout goes twice over a figure, because the ticks depend on the sizes of the axes, and these on the labels
of the ticks. Nearly all of its time measures text, which is the same in both passes where the ticks are.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox


def lay_out(figure: Figure) -> None:
    """Place the axes of ``figure`` by its layout engine, which it loses: they stay where they are."""
    with _measured_once(figure):
        figure.get_layout_engine().execute(figure)
    figure.set_layout_engine("none")


@contextmanager
def _measured_once(figure: Figure) -> Iterator[None]:
    """Let a ``_Measurement`` of each of the axes of ``figure`` answer for them within the block."""
    # The engine asks the axes themselves; a class of axes would have to be named wherever axes are created. An aspect
    # changes the frame within its place, so that such axes answer themselves.
    stretched = [axes for axes in figure.get_axes() if axes.get_aspect() == "auto" and axes.get_visible()]
    for axes in stretched:
        axes.get_tightbbox = _Measurement(axes)
    try:
        yield
    finally:
        for axes in stretched:
            del axes.get_tightbbox


class _Measurement:
    """Boxes of ``axes`` with all that is next to them, which is measured again only when the ticks are others."""

    def __init__(self, axes: Axes) -> None:
        self._axes = axes
        self._ticks: list[Any] | None = None
        self._around = np.zeros((2, 2))  # from the corners of the frame to those of the box

    def __call__(self, renderer: Any, **options: Any) -> Bbox:
        """The box in pixels where the axes are now; arguments are those of ``Axes.get_tightbbox``."""
        locator = self._axes.get_axes_locator()
        self._axes.apply_aspect(locator(self._axes, renderer) if locator else None)
        frame = self._axes.get_window_extent(renderer).get_points()

        ticks = [axis.get_majorticklocs().tolist() for axis in (self._axes.xaxis, self._axes.yaxis)]
        # The labels' texts follow from the ticks, and their sizes from the texts.
        if ticks != self._ticks:
            box = type(self._axes).get_tightbbox(self._axes, renderer, **options)
            self._around = box.get_points() - frame
            self._ticks = ticks
        return Bbox(frame + self._around)
