"""The layout of a figure, for which the text next to its axes is measured once.

Matplotlib's constrained layout goes over a figure twice, because the ticks depend on the sizes of the axes, and these
on the labels of the ticks. Nearly all of its time goes into measuring text, which is the same in both passes if the
ticks are.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from vipetsc.figures.kept_ticks import kept_ticks


def lay_out(figure: Figure) -> None:
    """Place the axes of ``figure`` by its layout engine, and remove the engine: they then stay where they are."""
    with kept_ticks(figure), _measured_once(figure):
        figure.get_layout_engine().execute(figure)
    remove_engine(figure)


def remove_engine(figure: Figure) -> None:
    """Leave ``figure`` without a layout engine: its axes stay where they are."""
    # ``set_layout_engine("none")`` would give the figure an engine that does nothing, with which ``savefig`` draws it
    # twice. None gives it the engine that the settings ask for, here none.
    with mpl.rc_context({"figure.autolayout": False, "figure.constrained_layout.use": False}):
        figure.set_layout_engine(None)


def apply_aspects(figure: Figure) -> None:
    """Give all axes of ``figure`` the frames that matplotlib gives them when it draws the figure."""
    renderer = pixel_canvas(figure).get_renderer()
    for axes in figure.get_axes():
        _apply_aspect(axes, renderer)


def pixel_canvas(figure: Figure) -> FigureCanvasAgg:
    """The canvas of ``figure`` if it draws pixels, else a new one: a user's module may have made another canvas."""
    canvas = figure.canvas
    if not isinstance(canvas, FigureCanvasAgg):
        canvas = FigureCanvasAgg(figure)
    return canvas


def _apply_aspect(axes: Axes, renderer: Any) -> None:
    """Give ``axes`` the frame that their aspect leaves of their place, and their locator, which colour bars have."""
    locator = axes.get_axes_locator()
    axes.apply_aspect(locator(axes, renderer) if locator else None)


@contextmanager
def _measured_once(figure: Figure) -> Iterator[None]:
    """Measure the text next to the axes of ``figure`` once within the block, as long as the ticks stay the same."""
    # A method of each object is replaced, since a class of axes of our own would have to be named wherever axes are
    # created. Axes with an aspect keep theirs: their frame changes within its place.
    stretched = [axes for axes in figure.get_axes() if axes.get_aspect() == "auto" and axes.get_visible()]
    for axes in stretched:
        axes.get_tightbbox = _Measurement(axes)
    try:
        yield
    finally:
        for axes in stretched:
            del axes.get_tightbbox


class _Measurement:
    """The box of ``axes`` with all that is written next to them, measured again only when the ticks have changed."""

    def __init__(self, axes: Axes) -> None:
        self._axes = axes
        self._ticks: list[Any] | None = None
        self._around = np.zeros((2, 2))  # from the corners of the frame to those of the box

    def __call__(self, renderer: Any, **options: Any) -> Bbox:
        """The box in pixels where the axes are now; arguments are those of ``Axes.get_tightbbox``."""
        _apply_aspect(self._axes, renderer)
        frame = self._axes.get_window_extent(renderer).get_points()

        ticks = [axis.get_majorticklocs().tolist() for axis in (self._axes.xaxis, self._axes.yaxis)]
        # The sizes of labels follow from their texts, and these from the ticks.
        if ticks != self._ticks:
            box = type(self._axes).get_tightbbox(self._axes, renderer, **options)
            self._around = box.get_points() - frame
            self._ticks = ticks
        return Bbox(frame + self._around)
