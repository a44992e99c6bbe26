"""Ticks of axes that are placed and measured once, as long as the axes stay where they are.

Matplotlib places the ticks of an axis, and measures their labels, up to six times for a layout and again for a picture:
for the box of the axes, for the place of the axis' label, for each of three titles, and where it draws them.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from matplotlib.axis import Axis, Tick
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

Boxes = tuple[list[Bbox], list[Bbox]]  # of the labels on both sides


@contextmanager
def kept_ticks(figure: Figure) -> Iterator[None]:
    """Place and measure the ticks of ``figure`` once within the block, as long as an axis stays where it is.

    In the block only the axes' places and limits may change, not what is written on them.
    """
    # Two methods of each axis are replaced by those of an object that remembers what they returned.
    every = [axis for axes in figure.get_axes() for axis in (axes.xaxis, axes.yaxis)]
    for axis in every:
        ticks = _Ticks(axis)
        axis._update_ticks = ticks.placed
        axis._get_ticklabel_bboxes = ticks.boxes
    try:
        yield
    finally:
        for axis in every:
            del axis._update_ticks
            del axis._get_ticklabel_bboxes


class _Ticks:
    """The ticks of an ``axis`` and the boxes of their labels, kept until the frame or the limits change."""

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self._place: tuple[Any, ...] = ()
        self._ticks: list[Tick] = []
        self._measured: tuple[Any, Boxes] | None = None

    def placed(self) -> list[Tick]:
        """The ticks within the limits, as of ``Axis._update_ticks``."""
        # In pixels: another resolution moves the frame as well.
        place = (*self._axis.axes.bbox.extents, *self._axis.get_view_interval())
        if place != self._place:
            self._ticks = type(self._axis)._update_ticks(self._axis)
            self._measured = None
            self._place = place
        return self._ticks

    def boxes(self, ticks: list[Tick], renderer: Any = None) -> Boxes:
        """The boxes of the labels of ``ticks`` in pixels, as of ``Axis._get_ticklabel_bboxes``."""
        # The caller may have placed other ticks, whose boxes are not kept.
        if ticks is not self.placed():
            return type(self._axis)._get_ticklabel_bboxes(self._axis, ticks, renderer)
        if self._measured is None or self._measured[0] is not renderer:
            self._measured = renderer, type(self._axis)._get_ticklabel_bboxes(self._axis, ticks, renderer)
        return self._measured[1]
