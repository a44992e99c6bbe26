"""Labels of logarithmic axes: three or more on each, at round numbers that have room."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogFormatter, LogLocator, MaxNLocator, NullFormatter

LEAST_TICKS = 3  # of an axis: two labels do not tell a logarithmic scale from a linear one
MOST_TICKS = 8
LETTER = 0.062  # width in inches of a letter of a tick's label, in the type of the house style
LINE = 0.14  # height in inches of a tick's label
PLAIN = 1e-3, 1e4  # numbers from the first up to the second are written without a power of ten
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
# About the fraction of an axis' length that is left when the layout has made room for labels. Ticks are chosen before
# the layout, which depends on them.
PART = 0.8


def log_ticks(low: float, high: float) -> list[float]:
    """Return three numbers or more between ``low`` and ``high``, 0 < ``low`` < ``high``, for a logarithmic scale."""
    exponents = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    # The roundest numbers first, finer ones only where these are too few.
    for steps in ((1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 5, 7)):
        ticks = [step * 10.0**exponent for exponent in exponents for step in steps]
        inside = [tick for tick in ticks if low * (1 - 1e-9) <= tick <= high * (1 + 1e-9)]
        if len(inside) >= LEAST_TICKS:
            return inside[:: -(-len(inside) // MOST_TICKS)]

    # Over so short a range the scale is nearly linear. The locator's outermost ticks may lie beyond the ends, so that
    # fewer than three are inside: it is asked for more.
    inside = []
    intervals = LEAST_TICKS + 1
    while len(inside) < LEAST_TICKS:
        values = MaxNLocator(intervals).tick_values(low, high)
        inside = [float(tick) for tick in values if low <= tick <= high]
        intervals += 1
    return inside


def tick_text(value: float) -> str:
    """Return a number as a label: plain, or with a power of ten where it has many zeros."""
    low, high = PLAIN
    if low <= abs(value) < high:
        return f"{value:.4g}"
    return power_text(value)


def power_text(value: float) -> str:
    """Return a number that is not 0 with a power of ten: 10⁻³, 2·10⁵.

    Exponents are letters of the font: to typeset formulas takes longer than all else in the layout of a picture.
    """
    # The logarithm of a power of ten may come out below its exponent by a rounding.
    exponent = int(np.floor(np.log10(abs(value)) + 1e-9))
    factor = f"{value / 10.0**exponent:.3g}"
    power = f"10{str(exponent).translate(RAISED)}"
    return power if factor == "1" else f"{factor}·{power}"


def has_room(positions: np.ndarray, texts: Sequence[str], length: float, is_horizontal: bool) -> bool:
    """Return whether labels ``texts`` at ``positions`` (label,), which span ``length`` inches of an axis, stand apart.

    ``positions`` are on the scale of the axis, for a logarithmic one logarithms.
    """
    if len(positions) < 2:
        return True
    order = np.argsort(positions)
    gaps = np.diff(positions[order]) / np.ptp(positions) * length
    sizes = np.array([LETTER * (len(texts[i]) + 1) if is_horizontal else LINE for i in order])
    return bool((gaps >= 0.5 * (sizes[1:] + sizes[:-1])).all())


def label_log_axis(axis: Axis, low: float, high: float, length: float) -> None:
    """Label round numbers between ``low`` and ``high`` on a logarithmic ``axis`` on which they span ``length`` inches.

    Where there is no room for all, some lose their labels, as long as three are left: they stay as minor ticks, which
    show a reader where the numbers are that have none.
    """
    ticks = log_ticks(low, high)
    without_label = set(ticks)
    is_horizontal = axis.axis_name == "x"
    while len(ticks) > LEAST_TICKS:
        texts = [tick_text(tick) for tick in ticks]
        if has_room(np.log(ticks), texts, length * np.log(ticks[-1] / ticks[0]) / np.log(high / low), is_horizontal):
            break
        ticks = ticks[::2] if len(ticks) >= 2 * LEAST_TICKS - 1 else [ticks[0], ticks[len(ticks) // 2], ticks[-1]]
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter(FuncFormatter(lambda value, _: tick_text(value)))
    without_label -= set(ticks)
    axis.set_minor_locator(FixedLocator(sorted(without_label)))
    axis.set_minor_formatter(NullFormatter())


def label_log_axes(figure: Figure) -> None:
    """Label the logarithmic axes of ``figure``, with powers of ten where three or more of these lie on an axis.

    Of the minor ticks of a decade those at 2 and 5 stay: to draw eight would take most of the time of a page of panels.
    """
    for axes in figure.get_axes():
        if not axes.axison:
            continue
        for axis, span in ((axes.xaxis, axes.bbox.width), (axes.yaxis, axes.bbox.height)):
            minor = axis.get_minor_locator()
            if isinstance(minor, LogLocator):
                minor.set_params(subs=(2.0, 5.0))
            if axis.get_scale() != "log" or isinstance(axis.get_major_formatter(), NullFormatter):
                continue
            if isinstance(axis.get_major_formatter(), LogFormatter):
                axis.set_major_formatter(FuncFormatter(lambda value, _: power_text(value)))

            low, high = sorted(axis.get_view_interval())
            ticks = np.asarray(axis.get_majorticklocs())
            # Ticks that the figure has set stay.
            is_set = isinstance(axis.get_major_locator(), FixedLocator)
            inside = ((ticks >= low * (1 - 1e-9)) & (ticks <= high * (1 + 1e-9))).sum()
            if inside < LEAST_TICKS and not is_set and 0 < low < high:
                label_log_axis(axis, low, high, PART * span / figure.dpi)
