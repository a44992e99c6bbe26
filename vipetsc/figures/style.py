"""One look for all pictures: sizes, type, colours, log scales, and how a figure says that it has no data."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

COLUMN, PAGE = 3.4, 7.0  # widths of one and of two journal columns in inches
DPI = 300

# Okabe and Ito (2008): told apart with every kind of colour vision.
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
GREY, PALE = "#777777", "#DDDDDD"

_LOOK = {
    "font.family": "DejaVu Sans",
    "mathtext.fontset": "dejavusans",
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.titlelocation": "left",
    "axes.labelpad": 2.5,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "xtick.direction": "out",
    "ytick.direction": "out",
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.minor.size": 1.5,
    "ytick.minor.size": 1.5,
    "lines.linewidth": 1.0,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "legend.handlelength": 1.4,
    "legend.borderaxespad": 0.2,
    "image.cmap": "viridis",
    "figure.dpi": 100,
    "savefig.dpi": DPI,
    "pdf.fonttype": 42,
}


@contextmanager
def rc_style() -> Iterator[None]:
    """The house style, for making and for saving figures; leaves matplotlib's settings as they were."""
    with mpl.rc_context(_LOOK):
        yield


def new_figure(width: float, height: float, fitted: bool = True) -> Figure:
    """An empty figure of ``width`` x ``height`` inches that needs no display and no pyplot.

    Panels are ``fitted`` to it unless they are placed by hand.
    """
    figure = Figure(figsize=(width, height), layout="constrained" if fitted else None)
    if fitted:
        figure.get_layout_engine().set(w_pad=0.03, h_pad=0.03, wspace=0.03, hspace=0.03)
    FigureCanvasAgg(figure)
    return figure


def without_data(reason: str, width: float = COLUMN, height: float = 1.6) -> Figure:
    """A figure that says why there is nothing to see."""
    figure = new_figure(width, height)
    axes = figure.subplots()
    say(axes, reason)
    return figure


def say(axes: Axes, reason: str) -> None:
    """Fill ``axes`` with the reason why they show nothing."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, reason, ha="center", va="center", color=GREY, wrap=True, transform=axes.transAxes)


def pooled(values: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Means over blocks of ``values`` (row, column), so that at most ``rows`` x ``columns`` are left."""
    for axis, most in ((0, rows), (1, columns)):
        length = values.shape[axis]
        block = -(-length // most)
        if block > 1:
            starts = np.arange(0, length, block)
            sizes = np.diff(np.append(starts, length))
            shape = (-1, 1) if axis == 0 else (1, -1)
            values = np.add.reduceat(values, starts, axis=axis) / sizes.reshape(shape)
    return values


def log_norm(largest: float, decades: float) -> LogNorm:
    """Logarithmic colours over ``decades`` below ``largest``; a silent field gets a scale all the same."""
    top = largest if np.isfinite(largest) and largest > 0 else 1.0
    return LogNorm(top * 10.0**-decades, top, clip=True)


def draw_map(axes: Axes, x: np.ndarray, y: np.ndarray, values: np.ndarray, norm: LogNorm, cmap: str) -> AxesImage:
    """Image of ``values`` (y, x) at evenly spaced positions; no finer than a printed page can show."""
    half = [0.5 * (axis[-1] - axis[0]) / max(len(axis) - 1, 1) or 0.5 for axis in (x, y)]
    extent = x[0] - half[0], x[-1] + half[0], y[0] - half[1], y[-1] + half[1]
    return axes.imshow(
        pooled(values, 600, 600),
        norm=norm,
        cmap=cmap,
        extent=extent,
        origin="lower",
        aspect="auto",
        interpolation="nearest",
    )


def letter(axes: Axes, text: str) -> None:
    """A panel's title, such as "(a) before the first site"."""
    axes.set_title(text, pad=3)
