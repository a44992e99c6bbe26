"""Units of linear axes with an SI prefix, where numbers of their label's unit would need a power of ten."""

import re
from functools import partial

import numpy as np
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, ScalarFormatter

PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 3: "k", 6: "M", 9: "G"}
UNITS = ("J", "N", "m", "s", "m/s", "m/s²", "m/s^2", "W", "Hz", "N s")  # that take a prefix
LABEL = re.compile(r"(.*)\((" + "|".join(map(re.escape, UNITS)) + r")\)", re.DOTALL)
PLAIN = 1e-3, 1e4  # largest numbers of an axis from the first up to the second are written without a prefix


def prefix_units(figure: Figure) -> None:
    """Give one SI prefix to the unit of each linear axis of ``figure`` whose numbers are very small or large.

    Matplotlib writes their common power of ten at the end of the axis, where it covers the label of a narrow panel.
    """
    for axes in figure.get_axes():
        for axis in (axes.xaxis, axes.yaxis):
            if axes.axison and axis.get_scale() == "linear" and type(axis.get_major_formatter()) is ScalarFormatter:
                _prefix_unit(axis)


def _prefix_unit(axis: Axis) -> None:
    """Put a prefix before the unit of an ``axis``, if its label ends with one and its numbers ask for it."""
    label = LABEL.fullmatch(axis.get_label_text())
    largest = float(np.abs(axis.get_view_interval()).max())
    low, high = PLAIN
    if not label or low <= largest < high or not np.isfinite(largest) or largest == 0:
        return
    exponent = int(np.clip(3 * np.floor(np.log10(largest) / 3), min(PREFIXES), max(PREFIXES)))
    axis.set_major_formatter(FuncFormatter(partial(_scaled, exponent=exponent)))
    axis.set_label_text(f"{label[1]}({PREFIXES[exponent]}{label[2]})")


def _scaled(value: float, place: int | None, exponent: int) -> str:
    """Return ``value`` over a power of ten as the label of a tick."""
    return f"{value / 10.0**exponent:.4g}".replace("-", "\N{MINUS SIGN}")
