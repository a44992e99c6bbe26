"""Sizes, type and colours of all pictures; an empty figure; how figures become files, and which rank draws which."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from vipetsc.io.atomic import atomic_write

COLUMN, PAGE = 3.4, 7.0  # widths of one and of two journal columns in inches
DPI = 300
NOTE = 0.16  # height in inches of the strip that a note takes below a picture

# Okabe and Ito (2008): told apart with every kind of colour vision.
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
GREY, PALE, RED = "#777777", "#DDDDDD", "#CC0000"
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

Drawing = tuple[str, Callable[[], Figure]]
"""A picture to come: the stem of its file's name, and what draws it, to be called before the next is asked for."""


@contextmanager
def rc_style() -> Iterator[None]:
    """The house style, for making and for saving figures; leaves matplotlib's settings as they were."""
    with mpl.rc_context(RC):
        yield


def si_prefix(value: float) -> tuple[float, str]:
    """Factor and symbol of the prefix that brings ``value`` to between 1 and 1000 units."""
    prefixes = ((1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"), (1e-12, "p"))
    return next((pair for pair in prefixes if abs(value) >= pair[0]), (1.0, ""))


def with_prefix(value: float, unit: str) -> str:
    """A value with the prefix that keeps it readable: 20 kN/m, 2.5 g."""
    factor, prefix = si_prefix(value)
    return f"{value / factor:.4g} {prefix}{unit}"


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


def save(figure: Figure, path: Path, note: str = "") -> Path:
    """Write ``figure`` to ``path`` in the format of its suffix, atomically, with a ``note`` in a strip below it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    width, height = figure.get_size_inches()
    strip = Bbox([[0, -NOTE], [width, height]]) if note else None
    text = figure.text(1 - 0.05 / width, -0.3 * NOTE / height, note, ha="right", va="top", fontsize=7, color=GREY)
    with atomic_write(path) as partial_path:
        figure.savefig(partial_path, format=path.suffix[1:], dpi=DPI, bbox_inches=strip)
    text.remove()
    return path


def draw_each(
    drawings: Iterable[Drawing],
    target: Path,
    formats: Sequence[str],
    turns: Iterator[int],
    note: str = "",
    keep: Callable[[Path], bool] = lambda path: False,
) -> list[Path]:
    """Draw those of ``drawings`` whose number is among ``turns``, into ``target/<stem>.<format>``; returns the files.

    Parameters
    ----------
    turns
        Rising numbers, the next one asked for when a picture is done: every ``size``-th from a rank on shares
        the work evenly, a counter that all ranks draw from shares it by what it costs.
    note
        A line of text below every picture.
    keep
        Whether the file at a path is to stay as it is.
    """
    written: list[Path] = []
    turn = next(turns, None)
    for number, (stem, make) in enumerate(drawings):
        if number != turn:
            continue
        paths = [target / f"{stem}.{suffix}" for suffix in formats]
        if not all(map(keep, paths)):
            figure = make()
            written += [save(figure, path, note) for path in paths]
        turn = next(turns, None)
    return written
