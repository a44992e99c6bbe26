"""Ticks of axes that are placed and measured once, as long as the axes stay where they are.

Matplotlib places the ticks of an axis, and measures their labels, up to six times for a layout and again for a picture:
for the box of the axes, for the place of the axis' label, for each of three titles, and where it draws them. It also
makes each tick anew, in a millisecond, and gives it the properties of the first one; a copy takes a tenth of that.
"""

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from matplotlib.axis import Axis, Tick, XAxis, YAxis
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

PARTS = "tick1line", "tick2line", "gridline", "label1", "label2"  # of a tick
Boxes = tuple[list[Bbox], list[Bbox]]  # of the labels on both sides


@contextmanager
def kept_ticks(figure: Figure) -> Iterator[None]:
    """Place and measure the ticks of ``figure`` once within the block, as long as an axis stays where it is.

    In the block only the axes' places and limits may change, not what is written on them.
    """
    # Methods of each axis are replaced by those of an object that remembers what they returned.
    every = [axis for axes in figure.get_axes() for axis in (axes.xaxis, axes.yaxis)]
    replaced = {axis: _Ticks(axis).methods() for axis in every}
    for axis, methods in replaced.items():
        vars(axis).update(methods)
    try:
        yield
    finally:
        for axis, methods in replaced.items():
            for name in methods:
                delattr(axis, name)


class _Ticks:
    """The ticks of an ``axis`` and the boxes of their labels, kept until the frame or the limits change."""

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self._place: tuple[Any, ...] = ()
        self._ticks: list[Tick] = []
        self._measured: tuple[Any, Boxes] | None = None

    def methods(self) -> dict[str, Callable[..., Any]]:
        """The methods of the axis that are replaced, by name."""
        methods: dict[str, Callable[..., Any]] = {"_update_ticks": self.placed, "_get_ticklabel_bboxes": self.boxes}
        # Other axes, as polar ones, have ticks of further parts.
        if type(self._axis) in (XAxis, YAxis):
            methods |= {"_get_tick": self.another, "_copy_tick_props": _keep_properties}
        return methods

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

    def another(self, major: bool) -> Tick:
        """One more tick, as of ``Axis._get_tick``: a copy of the first one if there is one."""
        ticks = self._axis.majorTicks if major else self._axis.minorTicks
        if not ticks:
            return type(self._axis)._get_tick(self._axis, major)

        tick = copy.copy(ticks[0])
        for part in PARTS:
            setattr(tick, part, copy.copy(getattr(tick, part)))
        return tick


def _keep_properties(first: Tick, another: Tick) -> None:
    """Take the place of ``Axis._copy_tick_props``: a copy of the first tick has its properties."""
