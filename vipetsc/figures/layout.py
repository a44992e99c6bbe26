"""The layout of a figure by matplotlib's engine, once for all formats in which it is written."""

from collections.abc import Iterator
from contextlib import contextmanager

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def lay_out(figure: Figure) -> None:
    """Place the axes of ``figure`` by its layout engine, and remove the engine: they then stay where they are."""
    figure.get_layout_engine().execute(figure)
    remove_engine(figure)


def remove_engine(figure: Figure) -> None:
    """Leave ``figure`` without a layout engine: its axes stay where they are."""
    # ``set_layout_engine("none")`` would give the figure an engine that does nothing, with which ``savefig`` draws it
    # twice. None gives it the engine that the settings ask for, here none.
    with without_engine():
        figure.set_layout_engine(None)


@contextmanager
def without_engine() -> Iterator[None]:
    """Let the settings ask for no layout engine within the block; ``savefig`` gives a figure that has none theirs."""
    with mpl.rc_context({"figure.autolayout": False, "figure.constrained_layout.use": False}):
        yield


def apply_aspects(figure: Figure) -> None:
    """Give all axes of ``figure`` the frames that matplotlib gives them when it draws the figure."""
    renderer = pixel_canvas(figure).get_renderer()
    for axes in figure.get_axes():
        # Colour bars have a locator, which says where they stand next to their map.
        locator = axes.get_axes_locator()
        axes.apply_aspect(locator(axes, renderer) if locator else None)


def pixel_canvas(figure: Figure) -> FigureCanvasAgg:
    """Return the canvas of ``figure`` if it draws pixels, else a new one: a user's module may have made another."""
    canvas = figure.canvas
    if not isinstance(canvas, FigureCanvasAgg):
        canvas = FigureCanvasAgg(figure)
    return canvas
