"""The figures of the paper and its supplement (``figures.toml``), and how they are drawn."""

import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from matplotlib.figure import Figure
from pydantic import TypeAdapter

from vipetsc.case import Case
from vipetsc.case.schema import PRESETS
from vipetsc.figures import transfer, transfer_curves
from vipetsc.figures.registry import FIGURES, FigureSpec, drawings, specified_drawings, with_ensemble
from vipetsc.figures.schematics import lattice_page, reduced_model
from vipetsc.figures.style import Drawing
from vipetsc.figures.sweep_members import Files
from vipetsc.io.kinds import SWEEP
from vipetsc.io.read import open_ensemble
from vipetsc.paper import entropy_pages

READINGS = ("calibrated", "printed")
# The sweep whose transfer is related to branches, and the steps of these.
TRANSFER = "interband"
RELATED = ("nnm-hertz", "nnm-bilinear", "nnm-hertz-calibrated", "nnm-bilinear-calibrated")


class Picture(NamedTuple):
    """A picture that can be drawn: the ``stem`` of its files' names, the function that draws it, the ``cost`` in s."""

    stem: str
    make: Callable[[], Figure]
    cost: float


@dataclass(frozen=True)
class Part:
    """Pictures of a figure: those of the registry's ``figure`` from ``steps``, or of a ``schematic``.

    Of the registry's pictures those are taken whose names contain all words of ``only``. ``stem`` names their files,
    with ``{stem}`` for the registry's name. A schematic is a function in ``SCHEMATICS``, called with a reading and the
    ``arguments``. ``cost`` is the CPU time in s that one picture takes.
    """

    figure: str = ""
    steps: Sequence[str] = ()
    only: Sequence[str] = ()
    stem: str = "{stem}"
    schematic: str = ""
    arguments: Sequence[Any] = ()
    cost: float = 0.7


@dataclass(frozen=True)
class PaperFigure:
    """A figure of the paper, reproduced by one or more pictures: for every reading, and perhaps law and average.

    ``id`` begins the names of their files, ``label`` is the paper's number, ``title`` and ``caption`` say in our words
    what is seen, ``claims`` are the ids of the claims that it shows.
    """

    id: str
    label: str
    title: str
    caption: str
    claims: tuple[str, ...]
    parts: tuple[Part, ...]

    @property
    def steps(self) -> tuple[str, ...]:
        """The steps whose results the figure shows."""
        return tuple(dict.fromkeys(step for part in self.parts for step in part.steps))

    def offers(self, folders: Mapping[str, Path], files: Files) -> Iterator[Picture]:
        """Yield the pictures that ``folders`` of finished steps allow, by name, while ``files`` are open."""
        for part in self.parts:
            if part.schematic:
                for reading in READINGS:
                    # Bound now, since the picture is drawn when this loop has gone on to the next reading.
                    schematic = partial(SCHEMATICS[part.schematic], reading, *part.arguments)
                    yield Picture(f"{self.id}-{part.stem}-{reading}", schematic, part.cost)

            finished = [folders[step] for step in part.steps if step in folders]
            # A figure has no pictures without its steps; with some of them it shows what there is.
            if finished:
                for drawing in _drawings(part.figure, finished, files):
                    stem = drawing.stem
                    if drawing.reason:
                        continue
                    # A word stands between dashes or at an end: a part of a longer word does not match.
                    if all(f"-{word}-" in f"{stem}-" for word in part.only):
                        yield Picture(f"{self.id}-{part.stem.format(stem=stem)}", drawing.draw, part.cost)


def _drawings(name: str, folders: Sequence[Path], files: Files) -> Iterator[Drawing]:
    """Return the drawings of the page called ``name``, one of the paper's or of the registry."""
    if name not in PAGES:
        return drawings(FIGURES[name].kind.source, folders, files, [name])
    ensembles = [files.get(folder, open_ensemble) for folder in with_ensemble(folders)]
    return specified_drawings(PAGES[name], ensembles, files)


def lattice(reading: str, preset: str, sites: Sequence[int]) -> Figure:
    """Return the cell, the bands and the lattice of a preset with each of these numbers of contact sites."""
    return lattice_page(_case(preset, reading), tuple(sites))


def two_masses(reading: str) -> Figure:
    """Return reduced model of the four-band cell, of host and resonator, as `modes.system.System.reduced` has it."""
    cell = _case("four-band", reading).lattice.unit_cell()
    pair = {cell.host, cell.resonator}
    masses = (cell.masses[cell.host], cell.masses[cell.resonator])
    inner = [s.stiffness for s in cell.springs if {s.start, s.end} == pair]
    # A spring that is held at its middle has twice its stiffness, and the paper takes half of the total of the host's.
    outer = [s.stiffness for s in cell.springs if cell.host in (s.start, s.end) and {s.start, s.end} != pair]
    return reduced_model(masses, (sum(outer), sum(inner)), PRESETS["four-band"].clearance_span(1)[0])


def _case(preset: str, reading: str) -> Case:
    return Case.from_table({"name": preset, "lattice": {"preset": preset, "reading": reading}})


SCHEMATICS: dict[str, Callable[..., Figure]] = {"lattice": lattice, "two_masses": two_masses}
_TABLES = tomllib.loads((files("vipetsc.paper") / "figures.toml").read_text(encoding="utf-8"))
_ROWS = [{"id": key} | table for key, table in _TABLES.items()]
PAPER_FIGURES = TypeAdapter(tuple[PaperFigure, ...]).validate_python(_ROWS)

# Patterns in the names of pictures' files, and what they mean in words.
NAMES = (
    (r"neighbours", "neighbouring sites"),
    (r"-hertz(?=-|$)", "Hertz"),
    (r"-bilinear(?=-|$)", "bilinear"),
    (r"out-of-phase", "out of phase"),
    (r"-in-phase", "in phase"),
    (r"calibrated", "calibrated reading"),
    (r"printed", "printed reading"),
    (r"(\d+)pi-(\d+)", r"\1π/\2"),
    (r"(?<!\d)1-site(?=-|$)", "1 site"),
    (r"(\d+)-sites", r"\1 sites"),
    (r"([\d.]+)-cycles", r"\1 cycles"),
    (r"-([\d.e+]+)N(?=-|$)", r"\1 N"),
    (r"energy_weighted$", "energy-weighted average"),
    (r"masked$", "masked average"),
    (r"joint$", "joint average"),
)


def describe(stem: str) -> str:
    """Return name ``stem`` of a picture's file in words, as in "calibrated reading, 5π/9, energy-weighted average"."""
    return ", ".join(match.expand(text) for pattern, text in NAMES for match in re.finditer(pattern, stem))


_SPECS = (
    FigureSpec("entropy", SWEEP, entropy_pages.entropy, measure="entropy"),
    FigureSpec("entropy_all", SWEEP, entropy_pages.entropy_all, measure="entropy"),
    FigureSpec("entropy_history", SWEEP, entropy_pages.entropy_history, measure="entropy"),
    FigureSpec("band_energies-shares", SWEEP, transfer.band_shares, measure="transfer"),
    FigureSpec("ibtet", SWEEP, transfer_curves.ibtet, measure="transfer"),
)
PAGES = MappingProxyType({spec.name: spec for spec in _SPECS})
