"""The report on the paper: one page with everything in it, for any screen and for print, and a table of verdicts."""

import base64
import hashlib
import io
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image

from vipetsc.io.atomic import write_text
from vipetsc.paper.claims.criteria import FAILS, HOLDS, IN_PART, UNMEASURED
from vipetsc.paper.engines import COMPARED
from vipetsc.paper.paper_figures import READINGS, PaperFigure, describe

# The page holds about a hundred pictures. Pictures of lines keep all their pixels, in few colours. Pictures of maps
# would be large in this form: they are made narrower, and compressed with losses that only an enlargement shows.
COLOURS = 256
WIDTH = 1000  # pixels
QUALITY = 50  # of WebP
# A picture in the page: the hash of its file, and its data URI.
ENCODED = re.compile(r'<img data-of="(\w+)" src="([^"]+)"')
# The verdicts in the plural: "12 hold".
PLURALS = {HOLDS: "hold", IN_PART: "hold in part", FAILS: "do not hold", UNMEASURED: "not measured"}
VERDICTS = (HOLDS, IN_PART, FAILS, UNMEASURED)


class ReportContents(NamedTuple):
    """Contents of the page.

    ``note`` says that the grid is coarse, and is empty if it is not. ``claims`` are the rows of ``claims.json``,
    ``pictures`` the pictures (PNG) of every figure, ``statistics`` numbers about the steps by name, ``versions`` those
    of the libraries. ``cpu`` is the CPU time in s of "steps" by name, of "figures" and "claims".
    """

    note: str
    claims: Sequence[Mapping[str, Any]]
    pictures: Sequence[tuple[PaperFigure, Sequence[Path]]]
    statistics: Mapping[str, Mapping[str, Any]]
    versions: Mapping[str, Any]
    cpu: Mapping[str, Any]


def write_report(path: Path, contents: ReportContents) -> None:
    """Write the page to ``path``, whole or not at all; pictures that have not changed are taken from the page there."""
    # Imported here: no other verb needs it.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    # Data URIs of the pictures that are encoded already, by the hash of the picture's file.
    encoded: dict[str, str] = {}
    if path.exists():
        encoded = dict(ENCODED.findall(path.read_text(encoding="utf-8")))
    # StrictUndefined: a misspelt name in the template raises instead of printing nothing.
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.loader = PackageLoader("vipetsc.paper", ".")
    environment.filters |= {
        "numbers": numbers,
        "sources": sources,
        "picture": partial(picture, encoded),
        "describe": describe,
    }

    statistics = contents.statistics
    verdicts = Counter((claim["reading"], claim["verdict"]) for claim in contents.claims)
    readings = [r for r in READINGS if any(reading == r for reading, _ in verdicts)]
    # A claim links to the first figure that shows it.
    figure_of: dict[str, PaperFigure] = {}
    for figure, _ in contents.pictures:
        for claim in figure.claims:
            figure_of.setdefault(claim, figure)

    page = environment.get_template("report.html").render(
        note=contents.note,
        pictures=contents.pictures,
        versions=contents.versions,
        rows=by_reading(contents.claims),
        readings=readings,
        plurals=PLURALS,
        counts={r: [(v, verdicts[r, v]) for v in VERDICTS if verdicts[r, v]] for r in readings},
        figure_of=figure_of,
        sweeps={name: row for name, row in statistics.items() if "members" in row},
        branches={name: row for name, row in statistics.items() if "points" in row},
        checks={name.removesuffix("-ts"): row["agreement"] for name, row in statistics.items() if "agreement" in row},
        bounds=COMPARED,
        cpu=contents.cpu,
    )
    write_text(path, page)


def picture(encoded: Mapping[str, str], path: Path) -> tuple[int, int, str, str]:
    """Return the width and the height in pixels of the picture (PNG) at ``path``, the hash of its file and a data URI.

    URIs are taken from ``encoded``, by the hash, or made.
    """
    data = path.read_bytes()
    key = hashlib.sha256(data).hexdigest()
    with Image.open(io.BytesIO(data)) as image:
        uri = encoded.get(key)
        if not uri:
            uri = "data:image/webp;base64," + base64.b64encode(small(image.convert("RGB"))).decode()
        return image.width, image.height, key, uri


def small(image: Image.Image) -> bytes:
    """Return the picture as WebP: with all pixels in few colours, or, if that is larger, narrower and with losses."""
    few = image.quantize(COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    lines = _webp(few.convert("RGB"), lossless=True, quality=60, method=2)

    narrow = image
    if image.width > WIDTH:
        narrow = image.resize((WIDTH, round(image.height * WIDTH / image.width)), Image.Resampling.LANCZOS)
    # The shorter encoding shows whether a picture is one of lines or a map. The best compression with losses is slow,
    # and saves a fifth over a quick one: where lines are far shorter than the quick one, the slow one is not tried.
    if len(lines) < 0.6 * len(_webp(narrow, quality=QUALITY, method=0)):
        return lines
    return min(lines, _webp(narrow, quality=QUALITY, method=4), key=len)


def _webp(image: Image.Image, **options: Any) -> bytes:
    """Return the ``image`` as WebP, with Pillow's ``options``."""
    encoded = io.BytesIO()
    image.save(encoded, "webp", **options)
    return encoded.getvalue()


def numbers(named: Mapping[str, float | None]) -> list[str]:
    """Return the ``named`` numbers as short texts with their names; those that could not be measured are left out."""
    return [f"{name} = {value:.4g}" for name, value in named.items() if value is not None]


def sources(files: Sequence[str]) -> str:
    """Return the steps to whose folders ``files`` belong, as text, with the number of files if there are several."""
    counts = Counter(name.partition("/")[0] for name in files)
    return ", ".join(step if n == 1 else f"{step} ({n} files)" for step, n in counts.items())


def claims_table(claims: Sequence[Mapping[str, Any]]) -> str:
    """Return the verdicts as a table of text: claims in rows, readings in columns."""
    readings = list(dict.fromkeys(claim["reading"] for claim in claims))
    lines = [f"{'':<5}" + "".join(f"{reading:<18}" for reading in readings) + "claim"]
    for key, row in by_reading(claims).items():
        verdicts = [row[reading]["verdict"] if reading in row else "" for reading in readings]
        claim = next(iter(row.values()))["claim"]
        lines.append(f"{key:<5}" + "".join(f"{verdict:<18}" for verdict in verdicts) + claim)
    return "\n".join(lines)


def by_reading(claims: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Mapping[str, Any]]]:
    """Return the rows of ``claims.json`` by id and reading."""
    # ``groupby`` joins neighbours only: the rows of one claim follow each other in ``claims.json``.
    return {key: {row["reading"]: row for row in rows} for key, rows in groupby(claims, itemgetter("id"))}
