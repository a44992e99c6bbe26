"""How a user wants pictures to look: width, units, decibels, labels, titles, a style; applied to finished figures."""

import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axis import Axis
from matplotlib.figure import Figure, FigureBase
from matplotlib.text import Text
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from vipetsc.figures.log_ticks import log_ticks
from vipetsc.wording import key_name, key_words, nearest

LETTER_OF_PANEL = re.compile(r"\([a-z](\.[ivx]+)?\)")
AMPLITUDES = ("m", "m/s", "m/s²", "m/s^2", "N")  # units of which a level is 20 log10 of the value
POWERS = ("J", "W")  # units of which it is 10 log10
ANGULAR = re.compile(r"([-+]?\d[\d.]*(?:e[-+]?\d+)?)([ \u00a0])(k?)rad/s\b")
MOST_TICKS = 5
# A line of a file of settings; comments begin with #, which colours in quotes may have too.
SETTING = re.compile(r'\s*(?:(?P<key>[\w.]+)\s*:\s*(?:"(?P<quoted>[^"]*)"|(?P<value>[^#"]*?))\s*)?(?:#.*)?')


class Unit(NamedTuple):
    """A unit in place of another: what fits ``pattern`` in labels becomes ``label``, numbers are times ``factor``."""

    pattern: re.Pattern[str]
    label: str
    factor: float


# By the names that a user may ask for; the first row that fits a label is taken. A further unit is a row.
UNITS: Mapping[str, tuple[Unit, ...]] = {
    "Hz": (
        Unit(re.compile(r"ω \(krad/s\)"), "f (Hz)", 1e3 / (2 * np.pi)),
        Unit(re.compile(r"ω \(rad/s\)"), "f (Hz)", 1 / (2 * np.pi)),
        Unit(re.compile(r"\(krad/s\)"), "(Hz)", 1e3 / (2 * np.pi)),
        Unit(re.compile(r"\(rad/s\)"), "(Hz)", 1 / (2 * np.pi)),
    ),
    "rad/s": (Unit(re.compile(r"\(krad/s\)"), "(rad/s)", 1e3), Unit(re.compile(r"\(Hz\)"), "(rad/s)", 2 * np.pi)),
}


@dataclass(frozen=True)
class Look:
    """What a user asks of all pictures.

    Attributes
    ----------
    style
        A file of matplotlib's settings (``.mplstyle``), which have precedence over the house style.
    width
        Width in inches; the height follows with the root of the ratio, so that narrow panels keep room for their type.
    unit
        One of ``UNITS``, for all frequencies.
    decibels
        Whether logarithmic axes of amplitudes and energies are levels in dB, relative to one of their unit.
    labels
        Texts in place of others, which may be keys of cases.
    titles
        Whether headings and titles of panels are written; without them panels keep their letters.
    """

    style: str | None = None
    width: float | None = None
    unit: str = ""
    decibels: bool = False
    labels: Mapping[str, str] = field(default_factory=dict)
    titles: bool = True

    def apply(self, figure: Figure) -> set[str]:
        """Change a ``figure`` that is drawn, but not laid out; return those of the ``labels`` that it has."""
        if self.width:
            width, height = figure.get_size_inches()
            figure.set_size_inches(self.width, height * np.sqrt(self.width / width))
        if not self.titles:
            _remove_titles(figure)
        for axes in figure.get_axes():
            for axis in (axes.xaxis, axes.yaxis):
                self._convert(axis)
        if self.unit == "Hz":
            _replace_texts(figure, lambda text: ANGULAR.sub(_in_hertz, text))
        replaced = set()
        for text, label in self.labels.items():
            # A picture shows a key of a case by its name.
            for sought in (text, key_name(text), key_words(text)):
                if _replace_texts(figure, partial(_replaced, sought=sought, label=label)):
                    replaced.add(text)
        return replaced

    def _convert(self, axis: Axis) -> None:
        """Give an ``axis`` the unit that is asked for, if its label has another of that kind."""
        label = axis.get_label_text()
        for unit in UNITS.get(self.unit, ()):
            if unit.pattern.search(label):
                axis.set_label_text(unit.pattern.sub(unit.label, label))
                _scale(axis, unit.factor)
                return

        of_level = re.fullmatch(r"(.*)\((.+)\)", label, re.DOTALL)
        if not (self.decibels and of_level and axis.get_scale() == "log"):
            return
        for units, factor in ((AMPLITUDES, 20), (POWERS, 10)):
            if of_level[2] in units:
                text = of_level[1]
                # Along a vertical axis there is less room.
                if axis.axis_name == "y" and "\n" not in text:
                    text = text.rstrip() + "\n"
                axis.set_label_text(f"{text}(dB re 1 {of_level[2]})")
                _show_levels(axis, factor)


def style_problem(file: str) -> str:
    """Return why a ``file`` of matplotlib's settings cannot be used, with the line; "" if it can."""
    try:
        lines = Path(file).read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        return str(error)

    settings = mpl.RcParams()
    for number, line in enumerate(lines, 1):
        match = SETTING.fullmatch(line)
        if match is None:
            return f"line {number} is not of the form KEY: VALUE"
        key, value = match["key"], match["quoted"] or match["value"]
        if not key:
            continue
        if key not in mpl.rcParams:
            near = nearest(key, mpl.rcParams)
            return f"line {number}: matplotlib has no setting {key}" + (f"; did you mean {near}?" if near else "")
        try:
            settings[key] = value
        except ValueError as error:
            return f"line {number}: {error}"
    if settings.get("text.usetex") and shutil.which("latex") is None:
        return "text.usetex needs LaTeX, which is not installed; install it, or remove that line"
    return ""


def _replaced(text: str, sought: str, label: str) -> str:
    """Return a ``text`` with ``label`` in place of what is ``sought``."""
    return text.replace(sought, label)


def _in_hertz(match: re.Match[str]) -> str:
    """Return a number of rad/s or krad/s as one of Hz."""
    value = float(match[1]) * (1e3 if match[3] else 1.0)
    return f"{value / (2 * np.pi):.4g}{match[2]}Hz"


def _scale(axis: Axis, factor: float) -> None:
    """Put ticks on an ``axis`` at round numbers of its values times ``factor``, which are their labels."""
    low, high = sorted(axis.get_view_interval())
    if axis.get_scale() == "log":
        ticks = np.array(log_ticks(low * factor, high * factor))
    else:
        # Labels of a horizontal axis need half an inch each.
        length = axis.axes.bbox.width / axis.axes.figure.dpi
        most = MOST_TICKS if axis.axis_name == "y" else int(np.clip(2 * length, 2, MOST_TICKS))
        ticks = MaxNLocator(most).tick_values(low * factor, high * factor)
    _set_ticks(axis, ticks / factor, [f"{tick:.6g}" for tick in ticks])


def _show_levels(axis: Axis, factor: int) -> None:
    """Put ticks on a logarithmic ``axis`` at round levels, ``factor`` times the logarithm of its values."""
    low, high = sorted(axis.get_view_interval())
    levels = MaxNLocator(MOST_TICKS, steps=[1, 2, 5, 10]).tick_values(factor * np.log10(low), factor * np.log10(high))
    _set_ticks(axis, 10 ** (levels / factor), [f"{level:g}" for level in levels])


def _set_ticks(axis: Axis, ticks: np.ndarray, texts: list[str]) -> None:
    """Put ``ticks`` that lie on an ``axis`` there, with ``texts``."""
    low, high = sorted(axis.get_view_interval())
    margin = 1e-9 * (high - low)
    shown = {
        float(tick): text.replace("-", "\N{MINUS SIGN}")
        for tick, text in zip(ticks, texts, strict=True)
        if low - margin <= tick <= high + margin
    }
    axis.set_major_locator(FixedLocator(list(shown)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: shown.get(value, "")))
    axis.set_minor_locator(NullLocator())


def _remove_titles(figure: Figure) -> None:
    """Remove all headings, and of panels' titles what stands behind their letter."""
    parts: list[FigureBase] = [figure]
    while parts:
        part = parts.pop()
        parts += part.subfigs
        part.suptitle("")
    for axes in figure.get_axes():
        for place in ("left", "center", "right"):
            tag = LETTER_OF_PANEL.match(axes.get_title(place))
            axes.set_title(tag[0] if tag else "", loc=place)


def _replace_texts(figure: Figure, change: Callable[[str], str]) -> bool:
    """Change all texts of a ``figure`` but the labels of ticks; return whether any is another one."""
    has_changed = False
    for text in figure.findobj(Text):
        changed = change(text.get_text())
        if changed != text.get_text():
            text.set_text(changed)
            has_changed = True
    return has_changed
