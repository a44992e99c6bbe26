"""Sizes, type and colours of all pictures; an empty figure."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

COLUMN, PAGE = 3.4, 7.0  # widths of one and of two journal columns in inches
DPI = 300

# Okabe and Ito (2008): told apart with every kind of colour vision.
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
GREY, PALE = "#777777", "#DDDDDD"
SERIES = BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY  # of bands, masses, curves in their order
DASHED, DOTTED = (0, (4, 2)), (0, (1, 2))

_TICKS = {
    "labelsize": 7, "direction": "out", "major.width": 0.6, "minor.width": 0.4, "major.size": 2.5, "minor.size": 1.5,
}  # fmt: skip
_GROUPS: dict[str, dict[str, Any]] = {
    "font": {"family": "DejaVu Sans", "size": 8},
    "mathtext": {"fontset": "dejavusans"},
    "axes": {"titlesize": 8, "labelsize": 8, "linewidth": 0.6, "titlelocation": "left", "labelpad": 2.5},
    "xtick": _TICKS,
    "ytick": _TICKS,
    "lines": {"linewidth": 1.0},
    "legend": {"fontsize": 7, "frameon": False, "handlelength": 1.4, "borderaxespad": 0.2},
    "image": {"cmap": "viridis"},
    "figure": {"dpi": 100},
    "savefig": {"dpi": DPI},
    "pdf": {"fonttype": 42},
}
RC = {f"{group}.{key}": value for group, settings in _GROUPS.items() for key, value in settings.items()}


@contextmanager
def rc_style() -> Iterator[None]:
    """The house style, for making and for saving figures; leaves matplotlib's settings as they were."""
    with mpl.rc_context(RC):
        yield


def si_prefix(value: float) -> tuple[float, str]:
    """Factor and symbol of the prefix that brings ``value`` to between 1 and 1000 units."""
    prefixes = ((1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"), (1e-12, "p"))
    return next((pair for pair in prefixes if abs(value) >= pair[0]), (1.0, ""))


def new_figure(width: float, height: float, heading: str = "", *, fitted: bool = True, left: bool = False) -> Figure:
    """An empty figure of ``width`` x ``height`` inches that needs no display and no pyplot.

    Panels are ``fitted`` to it unless they are placed by hand. The ``heading`` is centred, or begins at the ``left``.
    """
    figure = Figure(figsize=(width, height), layout="constrained" if fitted else None)
    FigureCanvasAgg(figure)
    if fitted:
        figure.get_layout_engine().set(w_pad=0.03, h_pad=0.03, wspace=0.03, hspace=0.03)
    if heading:
        figure.suptitle(heading, fontsize=8, **({"x": 0.01, "ha": "left"} if left else {}))
    return figure
