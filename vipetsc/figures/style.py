"""Sizes, type and colours of all pictures; an empty figure; how figures become files, and which rank draws which."""

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from textwrap import wrap
from typing import Any, NamedTuple

import matplotlib as mpl
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from matplotlib.transforms import Bbox
from PIL import Image

from vipetsc.figures.figure_data import figure_data
from vipetsc.figures.kept_formulas import kept_formulas
from vipetsc.figures.kept_ticks import kept_ticks
from vipetsc.figures.layout import apply_aspects, lay_out, pixel_canvas
from vipetsc.figures.log_ticks import label_log_axes
from vipetsc.figures.pdf_fonts import plain_fonts
from vipetsc.io.atomic import atomic_write, write_text

COLUMN = 3.4  # width of one journal column in inches
PAGE = 7.0  # width of two
NOTE = 0.165  # height in inches of the strip that a line of a note takes below a picture
LETTERS = 19  # of a note on an inch
HEADING_LETTERS = 15  # of a heading
COMPRESSION = 3  # of a PNG, of 1 to 9: files are 4 % larger than at 6, with which a picture takes a sixth longer
# Dots per inch of a PNG. The maps of a run take 379 kB and 0.21 s; at 100 they take 145 kB, and small type is blurred;
# at 400 they take 644 kB and 0.33 s, and a report of many pages loads slowly.
SCREEN = 200

# Okabe and Ito (2008): distinguishable with every kind of colour vision.
BLACK = "#000000"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
YELLOW = "#F0E442"
BLUE = "#0072B2"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"

GREY = "#777777"
PALE = "#DDDDDD"
RED = "#CC0000"
DASHED = (0, (4, 2))
DOTTED = (0, (1, 2))
DASHES_SEEN = 2.4  # length of a line in a legend, in letters' heights, that shows which dashes it has

# Pass bands, from the lowest; beyond the sixth they come round. The dashes are for greyscale print.
BAND_COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
BAND_DASHES = ("-", (0, (6, 1)), (0, (4, 1, 1, 1)), (0, (1.5, 0.8)), (0, (6, 1, 1, 1, 1, 1)), (0, (3, 2)))


class Shown(NamedTuple):
    """A member that a picture shows: the files of its ``results``, and the ``name`` that tells it from the others."""

    name: str
    results: Sequence[xr.Dataset]


class Drawing(NamedTuple):
    """A picture to come: the ``stem`` of its file's name; ``draw`` is called before the next drawing is asked for.

    ``shown`` are the members that the picture shows, where these are not all of what the figure was offered from.
    """

    stem: str
    draw: Callable[[], Figure]
    shown: Sequence[Shown] = ()


def band_colour(number: int) -> str:
    """The colour of pass band ``number`` (from 1) in every picture."""
    return BAND_COLOURS[(number - 1) % len(BAND_COLOURS)]


def band_look(number: int) -> dict[str, Any]:
    """The colour and the dashes of pass band ``number`` (from 1), for curves that greyscale print must tell apart."""
    return {"color": band_colour(number), "ls": BAND_DASHES[(number - 1) % len(BAND_DASHES)]}


def band_number(part: str) -> int | None:
    """The pass band that a ``part`` of the frequency axis is ("band 2"), the lowest of several; else None."""
    kind, _, numbers = part.partition(" ")
    return int(numbers.split("+")[0]) if kind == "band" else None


@contextmanager
def rc_style() -> Iterator[None]:
    """The house style, for making and for saving figures; leaves matplotlib's settings as they were."""
    with mpl.rc_context(fname=Path(__file__).with_name("house.mplstyle")), kept_formulas():
        yield


def with_prefix(value: float, unit: str) -> str:
    """A value in four digits with the prefix that keeps it readable: 20 kN/m, 2.5 g."""
    return EngFormatter(unit)(float(f"{value:.4g}"))


def new_figure(width: float, height: float, heading: str = "") -> Figure:
    """An empty figure of ``width`` x ``height`` inches under a ``heading``, which needs no display and no pyplot."""
    figure = Figure(figsize=(width, height))
    # The canvas that measures text for the layout prints it too, and remembers what it has measured.
    FigureCanvasAgg(figure)
    if heading:
        figure.suptitle("\n".join(wrap(heading, int(HEADING_LETTERS * width))))
    return figure


def save(figure: Figure, path: Path, note: str = "") -> Path:
    """Write ``figure`` to ``path`` in the format of its suffix, atomically, with a ``note`` in a strip below it.

    The figure's label stands there as well, in lines of the figure's width. What has been laid out for one format stays
    so for the next. A JSON file holds what the picture shows as numbers: ``vipetsc.figures.figure_data``.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if figure.get_layout_engine():
        _lay_out(figure)

    letters = int(LETTERS * figure.get_figwidth())
    sentences = [*note.splitlines(), *figure.get_label().splitlines()]
    lines = [line for sentence in sentences for line in wrap(sentence, letters)]

    if path.suffix == ".json":
        panels = figure_data(figure, strip=NOTE * len(lines))
        write_text(path, json.dumps(panels, separators=(",", ":"), allow_nan=False))
    else:
        _print(figure, path, lines)
    return path


def _print(figure: Figure, path: Path, lines: Sequence[str]) -> None:
    """Write the picture of a laid-out ``figure`` with ``lines`` of text in a strip below it."""
    width, height = figure.get_size_inches()
    look = {"ha": "left", "va": "top", "fontsize": 7, "color": GREY}
    text = figure.text(0.05 / width, -0.3 * NOTE / height, "\n".join(lines), **look)

    with kept_ticks(figure), atomic_write(path) as partial_path:
        # The figure's own canvas suffices where nothing is added to its box, and takes less time than ``savefig``.
        if path.suffix == ".pdf" and not lines:
            # Imported here: the tools for fonts take a quarter of the time that matplotlib itself takes.
            from matplotlib.backends.backend_pdf import FigureCanvasPdf

            with plain_fonts():
                FigureCanvasPdf(figure).print_pdf(partial_path)
        elif path.suffix == ".png" and not lines:
            figure.set_dpi(SCREEN)
            canvas = pixel_canvas(figure)
            canvas.draw()
            # A page is opaque: without the channel for transparency it takes half the time, and less room.
            pixels = Image.frombuffer("RGBA", canvas.get_width_height(), canvas.buffer_rgba())
            pixels.convert("RGB").save(partial_path, "png", dpi=(SCREEN, SCREEN), compress_level=COMPRESSION)
        else:
            # A box of its own keeps axes where they are now, colour bars without their aspect too.
            apply_aspects(figure)
            box = Bbox([[0, -NOTE * len(lines)], [width, height]]) if lines else None
            dpi = SCREEN if path.suffix == ".png" else None
            options = {"pil_kwargs": {"compress_level": COMPRESSION}} if path.suffix == ".png" else {}
            figure.savefig(partial_path, format=path.suffix[1:], dpi=dpi, bbox_inches=box, **options)

    # The next format of the figure has a strip of its own.
    text.remove()


def _lay_out(figure: Figure) -> None:
    """Label the logarithmic axes of the figure, and lay it out, once for all formats."""
    label_log_axes(figure)
    figure.set_dpi(SCREEN)
    lay_out(figure)
    # In fractions of the figure, not of its box: that grows by the strip of a note.
    for legend in figure.legends:
        legend.set_bbox_to_anchor((0, 0, 1, 1), figure.transFigure)


def draw_each(
    drawings: Iterable[Drawing],
    target: Path,
    formats: Sequence[str],
    turns: Iterator[int],
    note: str = "",
    keep: Callable[[Path], bool] = lambda path: False,
) -> list[Path]:
    """Draw those of ``drawings`` whose number is among ``turns``, into ``target/<stem>.<format>``; return the files.

    Parameters
    ----------
    turns
        Rising numbers, the next one asked for when a picture is done: every ``size``-th from a rank on divides
        the work evenly, a counter that all ranks draw from divides it by cost.
    note
        A line of text below every picture, above the figure's label.
    keep
        Whether the file at a path is to stay as it is.
    """
    written: list[Path] = []
    turn = next(turns, None)
    for number, drawing in enumerate(drawings):
        if number != turn:
            continue

        paths = [target / f"{drawing.stem}.{suffix}" for suffix in formats]
        if not all(keep(path) for path in paths):
            sys.audit("vipetsc.draw", drawing.stem)
            figure = drawing.draw()
            for path in paths:
                written.append(save(figure, path, note))

        # Asked for only now: a counter of all ranks must not give a number to a rank that is still drawing.
        turn = next(turns, None)
    return written
