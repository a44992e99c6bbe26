"""The report on the paper: one page with everything in it, for a screen of any width and for print."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image

from vipetsc.io.atomic import write_text
from vipetsc.paper.figures import READINGS, PaperFigure

WIDEST = 1500  # pixels of a picture in the page
COLOURS = 200
VERDICTS = "holds", "holds in part", "does not hold", "not measured"


@dataclass(frozen=True)
class Picture:
    """A picture of a figure: its PNG, and what tells it from the others in words."""

    path: Path
    words: str

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels as shown in the page."""
        with Image.open(self.path) as image:
            return _shown(image.size)

    @property
    def data(self) -> str:
        """The picture as a data URI, no larger than a screen needs."""
        with Image.open(self.path) as image:
            small = image.convert("RGB").resize(_shown(image.size), Image.LANCZOS)
        out = io.BytesIO()
        small.quantize(COLOURS, dither=Image.Dither.NONE).save(out, "png", optimize=True)
        return "data:image/png;base64," + base64.b64encode(out.getvalue()).decode()


@dataclass(frozen=True)
class Shown:
    """A figure of the paper and the pictures of it that were drawn."""

    plate: PaperFigure
    pictures: Sequence[Picture]


@dataclass(frozen=True)
class Report:
    """What the page tells: rows of ``claims.json``, figures, statistics by step, versions; ``note`` if coarse."""

    note: str
    claims: Sequence[Mapping[str, Any]]
    figures: Sequence[Shown]
    statistics: Mapping[str, Mapping[str, Any]]
    versions: Mapping[str, Any]


def write_report(report: Report, path: Path) -> Path:
    """Write the page to ``path``, whole or not at all; returns it."""
    environment = Environment(
        loader=PackageLoader("vipetsc.paper", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"numbers": numbers, "sources": sources}
    rows = {}
    for claim in report.claims:
        rows.setdefault(claim["id"], {})[claim["reading"]] = claim
    readings = [r for r in READINGS if any(r in row for row in rows.values())]
    counts = {r: _counted([row[r]["verdict"] for row in rows.values() if r in row]) for r in readings}
    figure_of = {claim: shown.plate for shown in reversed(report.figures) for claim in shown.plate.claims}
    sweeps = {name: found for name, found in report.statistics.items() if "members" in found}
    branches = {name: found for name, found in report.statistics.items() if "points" in found}
    page = environment.get_template("report.html").render(
        report=report,
        rows=rows,
        readings=readings,
        counts=counts,
        figure_of=figure_of,
        sweeps=sweeps,
        branches=branches,
    )
    write_text(path, page)
    return path


def numbers(found: Any) -> list[str]:
    """Named numbers, or one of them, as short texts; those that could not be had are left out."""
    named = found if isinstance(found, Mapping) else {"": found}
    return [f"{name} = {_text(value)}" if name else _text(value) for name, value in named.items() if value is not None]


def sources(files: Sequence[str]) -> str:
    """The steps that ``files`` belong to, with how many of each."""
    steps = [name.partition("/")[0] for name in files]
    counts = {step: steps.count(step) for step in dict.fromkeys(steps)}
    return ", ".join(step if n == 1 else f"{step} ({n} files)" for step, n in counts.items())


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, (int, float)) and not isinstance(value, bool) else str(value)


def _counted(verdicts: Sequence[str]) -> list[tuple[str, int]]:
    order = sorted(set(verdicts), key=lambda v: (VERDICTS.index(v) if v in VERDICTS else len(VERDICTS), v))
    return [(verdict, verdicts.count(verdict)) for verdict in order]


def _shown(size: tuple[int, int]) -> tuple[int, int]:
    width = min(size[0], WIDEST)
    return width, round(size[1] * width / size[0])
