"""Sizes, type and colours of all pictures; empty figures; how figures become files, and how ranks share pictures."""

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import wrap
from typing import Any, NamedTuple

import matplotlib as mpl
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from matplotlib.transforms import Bbox

from vipetsc.figures.log_ticks import label_log_axes
from vipetsc.figures.look import Look
from vipetsc.figures.prefixed_units import prefix_units
from vipetsc.io.atomic import atomic_write

COLUMN = 3.4  # width of one journal column in inches
PAGE = 7.0  # width of two
NOTE = 0.165  # height in inches that a note of one line takes in the strip below a picture
NOTE_LINE = 0.12  # height that each further line takes: 1.2 times that of letters of 7 pt
LETTERS = 19  # letters of a note that fit into an inch of its width
HEADING_LETTERS = 15  # letters of a heading that fit into an inch
COMPRESSION = 3  # of a PNG, from 1 to 9: files are 4 % larger than with 6, with which a picture takes a sixth longer
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
DASHES_SEEN = 2.4  # length of a line in a legend, in heights of its letters, at which its dashes can be recognised

# Looks of pass bands, from the lowest one; the seventh has that of the first. The dashes are for greyscale print. The
# colours are those of all curves that have none of their own ("C0" to "C5").
BAND_COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
BAND_DASHES = ("-", (0, (6, 1)), (0, (4, 1, 1, 1)), (0, (1.5, 0.8)), (0, (6, 1, 1, 1, 1, 1)), (0, (3, 2)))

# Looks of curves by what they show, for a colour and a line by which they differ in grey. Names with a slash are those
# of variables in files. Pass bands have ``band_look``, and what only a number tells apart has ``numbered_look``.
CURVES: Mapping[str, Mapping[str, Any]] = {
    # The ledger of a run.
    "energy/work": {"color": BLACK, "ls": "-"},
    "energy/stored": {"color": BLUE, "ls": "-"},
    "energy/kinetic": {"color": SKY, "ls": "-"},
    "energy/spring": {"color": GREEN, "ls": (0, (3, 1.5))},
    "energy/contact": {"color": PURPLE, "ls": "-"},
    "energy/dissipated": {"color": VERMILION, "ls": DASHED},
    "energy/dissipated_by_damping": {"color": ORANGE, "ls": "-"},
    # Cells of a run, by their spectra.
    "dispersion_before": {"color": BLUE},
    "dispersion_after": {"color": VERMILION},
    "dispersion": {"color": BLACK},
    # What becomes of the energy of a wave at sites.
    "transmitted": {"color": BLUE, "ls": "-"},
    "reflected": {"color": SKY, "ls": DASHED},
    "upper": {"color": VERMILION, "ls": DOTTED},
    "dissipated": {"color": ORANGE, "ls": "-."},
    "dashpots": {"color": GREEN, "ls": (0, (6, 1, 1, 1, 1, 1))},
    # Energies of a prediction at the end: transferred, and lost.
    "predicted/upper": {"color": BLACK, "ls": "-"},
    "predicted/other": {"color": BLACK, "ls": "-"},
    "predicted/dissipated": {"color": BLACK, "ls": "-"},
    "predicted/dashpots": {"color": GREEN, "ls": DASHED},
    "predicted/absorbed": {"color": ORANGE, "ls": DOTTED},
    # Stability along a branch of normal modes, and its losses.
    "stable": {"color": BLUE},
    "unstable": {"color": VERMILION},
    "not computed": {"color": GREY},
    "damping_ratio": {"color": BLUE, "ls": "-"},
    "force": {"color": VERMILION, "ls": "--"},
    # Steady states under a drive: one curve, linear motion behind it, slow sweeps of its parameter.
    "response": {"color": BLACK},
    "linear": {"color": GREY},
    "sweep up": {"color": GREEN},
    "sweep down": {"color": PURPLE},
    # Members of a sweep that follow one another.
    "follows down": {"color": ORANGE},
    "follows none": {"color": BLACK},
    "follows up": {"color": BLUE},
    # Designs that a search compares.
    "case": {"color": GREY},
    "best-1": {"color": VERMILION},
    "best": {"color": BLUE},
    "best-2": {"color": GREEN},
    # Energies of all designs.
    "designs/upper_share_at_end": {"color": PURPLE},
    "designs/dissipated": {"color": ORANGE},
    # Averages of the entropy.
    "entropy/energy_weighted": {"color": BLUE},
    "entropy/masked": {"color": VERMILION},
    "entropy/joint": {"color": GREEN},
    # Records of an identification, and what its model makes of them.
    "measured": {"color": GREY},
    "model": {"color": BLUE},
    "residual": {"color": VERMILION},
}


class Shown(NamedTuple):
    """A member that a picture shows: its ``results``, opened files, and the ``name`` that tells it from the others."""

    name: str
    results: Sequence[xr.Dataset]


class NoPicture(Exception):
    """Raised by a figure that has nothing to show; the text is the reason."""


class Drawing(NamedTuple):
    """A picture that can be drawn: ``draw`` returns the figure, ``stem`` is the name of its file without the suffix.

    ``draw`` has to be called before the next drawing is asked for; it raises NoPicture if there is nothing to show.
    ``shown`` are the members that the picture shows, or empty if it shows all results that the figure was given.
    ``figure`` is the name by which the picture is asked for, by default the ``stem``. ``reason`` says why there is no
    picture, where that is known before it is drawn.
    """

    stem: str
    draw: Callable[[], Figure]
    shown: Sequence[Shown] = ()
    figure: str = ""
    reason: str = ""

    @classmethod
    def without_picture(cls, stem: str, reason: str) -> "Drawing":
        """Return a drawing of which nothing can be shown, for the ``reason``."""

        def draw() -> Figure:
            raise NoPicture(reason)

        return cls(stem, draw, reason=reason)


@dataclass
class LeftOut:
    """Pictures that have nothing to show: the ``reasons`` by the names of their figures, and of these by their stems.

    ``drawn`` are the names of the figures of which a picture was drawn, or stays; ``labelled`` are the texts that have
    been replaced by the labels of a ``Look``.
    """

    reasons: dict[str, dict[str, str]] = field(default_factory=dict)
    drawn: set[str] = field(default_factory=set)
    labelled: set[str] = field(default_factory=set)

    def add(self, other: "LeftOut") -> None:
        """Add what another rank has left out and drawn."""
        for name, reasons in other.reasons.items():
            self.reasons.setdefault(name, {}).update(reasons)
        self.drawn |= other.drawn
        self.labelled |= other.labelled


def band_colour(number: int) -> str:
    """Return the colour of pass band ``number`` (from 1) in every picture."""
    return BAND_COLOURS[(number - 1) % len(BAND_COLOURS)]


def band_look(number: int) -> dict[str, Any]:
    """Return colour and dashes of pass band ``number`` (from 1), for curves that grey print must tell apart."""
    return {"color": band_colour(number), "ls": BAND_DASHES[(number - 1) % len(BAND_DASHES)]}


def numbered_look(number: int) -> dict[str, Any]:
    """Return colour and dashes of curve ``number`` (from 0) of those that only a number tells apart."""
    count = len(BAND_COLOURS)
    return {"color": BAND_COLOURS[number % count], "ls": BAND_DASHES[number // count % len(BAND_DASHES)]}


def band_number(part: str) -> int | None:
    """Return the number of the pass band that a ``part`` of the frequency axis is, 2 for "band 2"; None for a gap.

    Of bands that overlap, as in "band 2+3", it is the lowest.
    """
    kind, _, numbers = part.partition(" ")
    if kind != "band":
        return None
    return int(numbers.split("+")[0])


def part_label(part: str) -> str:
    """Return the name of a ``part`` of the frequency axis in a picture; of many bands, the first and last."""
    kind, _, numbers = part.partition(" ")
    bands = numbers.split("+")
    if kind != "band" or len(bands) < 4:
        return part
    return f"bands {bands[0]} to {bands[-1]}"


@contextmanager
def rc_style(style: str | None = None) -> Iterator[None]:
    """Make and save figures in the house style within the block; then matplotlib's settings are as before.

    What a user's ``matplotlibrc`` says has precedence over the house, and the file ``style`` over both.
    """
    house = Path(__file__).with_name("house.mplstyle")
    with mpl.rc_context({"axes.prop_cycle": mpl.cycler(color=BAND_COLOURS)}, fname=house):
        # Where a user has no such file it is that of matplotlib, whose settings are the defaults.
        settings = _settings(mpl.matplotlib_fname())
        mpl.rcParams.update({key: value for key, value in settings.items() if value != mpl.rcParamsDefault[key]})
        if style:
            mpl.rcParams.update(_settings(style))
        yield


def _settings(file: str) -> dict[str, Any]:
    """Return matplotlib's settings in a ``file``, without the backend: pictures in files need no windows."""
    settings = mpl.rc_params_from_file(file, use_default_template=False)
    return {key: value for key, value in settings.items() if key != "backend"}


def with_prefix(value: float, unit: str) -> str:
    """Return a value in four digits with its unit and an SI prefix: 20 kN/m, 2.5 g."""
    return EngFormatter(unit)(float(f"{value:.4g}"))


def new_figure(width: float, height: float, heading: str = "") -> Figure:
    """Return an empty figure of ``width`` x ``height`` inches under a ``heading``, without display or pyplot."""
    figure = Figure(figsize=(width, height))
    # The canvas that measures text for the layout prints it too, and remembers what it has measured.
    FigureCanvasAgg(figure)
    if heading:
        figure.suptitle(wrapped_heading(heading, width))
    return figure


def wrapped_heading(heading: str, width: float) -> str:
    """Return a ``heading`` in lines of ``width`` inches."""
    return "\n".join(wrap(heading, int(HEADING_LETTERS * width)))


def add_note(figure: Figure, sentence: str) -> None:
    """Put a ``sentence`` below a ``figure``, as on what it leaves out; `save` prints it."""
    figure.set_label("\n".join(filter(None, [figure.get_label(), sentence])))


def save(figure: Figure, path: Path, note: str = "") -> Path:
    """Write ``figure`` to ``path`` in the format of its suffix, whole or not at all, and return the path.

    In a strip below the picture are the ``note`` and the figure's label, in lines of its width. A figure is laid out
    once, for the first of its formats. Raises OSError, which names the file, if it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if figure.get_layout_engine():
        _lay_out(figure)

    letters = int(LETTERS * figure.get_figwidth())
    sentences = [*note.splitlines(), *figure.get_label().splitlines()]
    lines = [line for sentence in sentences for line in wrap(sentence, letters)]

    _print(figure, path, lines)
    return path


def _print(figure: Figure, path: Path, lines: Sequence[str]) -> None:
    """Write the picture of a laid-out ``figure`` with ``lines`` of text in a strip below it."""
    width, height = figure.get_size_inches()
    look = {"ha": "left", "va": "top", "fontsize": 7, "color": GREY}
    text = figure.text(0.05 / width, -0.3 * NOTE / height, "\n".join(lines), **look)

    options: dict[str, Any] = {}
    if lines:
        options["bbox_inches"] = Bbox([[0, -NOTE - NOTE_LINE * (len(lines) - 1)], [width, height]])
        # With such a box ``savefig`` keeps all axes in the frames that they have now.
        apply_aspects(figure)
    if path.suffix == ".png":
        options |= {"dpi": SCREEN, "pil_kwargs": {"compress_level": COMPRESSION}}
    with without_engine(), atomic_write(path) as partial_path:
        figure.savefig(partial_path, format=path.suffix[1:], **options)

    # The next format of the figure gets a text of its own.
    text.remove()


def _lay_out(figure: Figure) -> None:
    """Label the axes of ``figure``, and lay it out, once for all formats."""
    label_log_axes(figure)
    prefix_units(figure)
    figure.set_dpi(SCREEN)
    lay_out(figure)
    # Legends are placed in fractions of the figure, not of the box that is printed, which is higher by the strip of a
    # note.
    for legend in figure.legends:
        legend.set_bbox_to_anchor((0, 0, 1, 1), figure.transFigure)


def draw_each(
    drawings: Iterable[Drawing],
    target: Path,
    formats: Sequence[str],
    turns: Iterator[int],
    note: str = "",
    keep: Callable[[Path], bool] = lambda path: False,
    left_out: LeftOut | None = None,
    look: Look | None = None,
) -> list[Path]:
    """Draw those of ``drawings`` whose number is among ``turns``, into ``target/<stem>.<format>``; return the files.

    Parameters
    ----------
    turns
        Rising numbers of the pictures to draw, from 0; the next one is asked for when a picture is done. Every n-th
        number for each of n ranks divides the pictures evenly. A counter that all ranks share (`CommonTurns`) divides
        their cost: a rank with cheap pictures gets more of them.
    note
        A line of text below every picture, above the figure's label.
    keep
        Whether the file at a path is to stay as it is.
    left_out
        Gets the reasons of pictures that have nothing to show.
    look
        What a user asks of all pictures.
    """
    if left_out is None:
        left_out = LeftOut()
    written: list[Path] = []
    turn = next(turns, None)
    for number, drawing in enumerate(drawings):
        if number != turn:
            continue

        paths = [target / f"{drawing.stem}.{suffix}" for suffix in formats]
        name = drawing.figure or drawing.stem
        try:
            if not all(keep(path) for path in paths):
                sys.audit("vipetsc.draw", drawing.stem)
                figure = drawing.draw()
                if look:
                    left_out.labelled |= look.apply(figure)
                written += [save(figure, path, note) for path in paths]
            left_out.drawn.add(name)
        except NoPicture as none:
            left_out.reasons.setdefault(name, {})[drawing.stem] = str(none)

        # Asked for only now: a counter of all ranks must not give a number to a rank that is still drawing.
        turn = next(turns, None)
    return written


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
