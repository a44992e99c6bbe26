"""The sections of a case file and their strict reading: every problem found, none twice."""

from __future__ import annotations

import copy
import difflib
import re
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from vipetsc.lattice.cell import Spring, UnitCell

METHODS = ("2a", "3bs", "5f", "5dp", "5bs", "6vr", "7vr", "8vr")


@dataclass(frozen=True)
class Problem:
    """One thing wrong with a case: the key's path, the value found there, and what to do."""

    key: str
    value: Any
    remedy: str

    def __str__(self) -> str:
        value = "" if self.value is None else f" = {self.value!r}"
        return f"{self.key}{value}: {self.remedy}"


class CaseError(ValueError):
    """A case that cannot be simulated; ``problems`` holds all reasons."""

    def __init__(self, problems: Iterable[Problem], source: str = "case") -> None:
        self.problems = list(problems)
        self.source = source
        count = "1 problem" if len(self.problems) == 1 else f"{len(self.problems)} problems"
        super().__init__(f"{source}: {count}\n" + "\n".join(f"  {p}" for p in self.problems))

    def __reduce__(self) -> tuple:
        return type(self), (self.problems, self.source)


def number(value: Any) -> Any:
    """Wavenumbers may be written as multiples of pi: "5pi/9"."""
    match = isinstance(value, str) and re.fullmatch(r"\s*(\d*\.?\d*)\s*\*?\s*pi\s*(?:/\s*(\d+))?\s*", value)
    if not match:
        return value
    return float(match[1] or 1) * np.pi / float(match[2] or 1)


def _not_zero(value: float) -> float:
    if value == 0:
        raise ValueError("must not be zero")
    return value


Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Wavenumber = Annotated[float, BeforeValidator(number), Field(gt=0, le=np.pi)]


class Section(BaseModel):
    """A table of a case file: strict types, no unknown keys, not to be changed."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class SpringTable(Section):
    """A spring from mass ``start`` to mass ``end`` (1-based), of the next cell if ``next_cell``."""

    start: int
    end: int
    stiffness: Finite
    next_cell: bool = False


class CellTable(Section):
    """A unit cell of one's own; ``contact`` names the host and the resonator (1-based masses)."""

    masses: list[Finite] = Field(min_length=2)
    springs: list[SpringTable] = Field(min_length=1)
    contact: list[int] = Field(min_length=2, max_length=2)

    def unit_cell(self) -> UnitCell:
        """The cell in the lattice's own terms; raises ValueError if it is not a sound one."""
        return UnitCell(*self.parts())

    def parts(self) -> tuple[tuple[float, ...], tuple[Spring, ...], int, int]:
        """Masses, springs, host and resonator with 0-based indices."""
        springs = tuple(Spring(s.start - 1, s.end - 1, s.stiffness, s.next_cell) for s in self.springs)
        return tuple(self.masses), springs, self.contact[0] - 1, self.contact[1] - 1


class LatticeTable(Section):
    """``preset`` or ``cell``; length in cells; ends; which reading of the paper's parameters."""

    preset: Literal["four-band", "diatomic"] | None = None
    cell: CellTable | None = None
    cells: int = Field(300, ge=2)
    ends: Literal["fixed", "free", "periodic"] = "fixed"
    reading: Literal["printed", "calibrated"] = "calibrated"
    lam: Positive | None = Field(None, alias="lambda")
    eta: Annotated[float, Field(gt=0, lt=1)] | None = None


class Span(Section):
    """``count`` sites evenly from cell ``first`` to cell ``last`` (1-based), or every ``spacing``-th from ``first``."""

    first: int
    last: int | None = None
    spacing: int | None = Field(None, ge=1)
    count: int = Field(ge=1)


class ClearanceSpan(Section):
    """Clearances in m, log-spaced from the leading to the last site."""

    first: Positive
    last: Positive


class ContactsTable(Section):
    """Contact law, stiffness (given, or from modulus in Pa, radius in m, Poisson ratio), sites, clearances."""

    law: Literal["hertz", "bilinear"] = "hertz"
    modulus: Positive | None = None
    radius: Positive | None = None
    poisson: Annotated[float, Field(gt=-1, le=0.5)] | None = None
    stiffness: Positive | None = None
    restitution: Annotated[float, Field(ge=0, le=1)] = 1.0
    sites: Annotated[int, Field(ge=0)] | list[int] | Span = 0
    clearance: Positive | list[Positive] | ClearanceSpan | None = None
    adhesion: Literal["allow", "clip"] = "allow"
    approach_floor: Annotated[float, Field(ge=0)] = 0.0


class DriveTable(Section):
    """A tone burst: ``frequency`` in rad/s, or ``wavenumber`` + ``band``, or ``band`` + ``at``."""

    amplitude: Annotated[Finite, AfterValidator(_not_zero)] = 1.0
    cycles: int = Field(30, ge=1)
    envelope: Literal["paper", "hann"] = "paper"
    frequency: Positive | None = None
    wavenumber: Wavenumber | None = None
    band: Annotated[int, Field(ge=1)] | None = None
    at: Literal["max-group-velocity"] | None = None
    cell: int = Field(1, ge=1)
    mass: int = Field(1, ge=1)


class TimeTable(Section):
    """End in s or ``traverse`` (burst + cells / group velocity), engine, method, tolerances, sampling.

    ``samples`` is their number from 0 to the end, in place of an interval.

    ``engine``: ``ts`` steps with PETSc's Runge-Kutta ``method``; ``propagator`` takes exact linear steps, with
    contact forces collocated; ``auto`` is the propagator where it suits. ``atol``: ``scaled`` is .1 rtol times the
    displacement and the velocity of the drive's linear wave, ``paper`` is 1e-9 times the amplitude, a number is
    used for displacements (m) and velocities (m/s).
    """

    end: Positive | Literal["traverse"] = "traverse"
    engine: Literal["ts", "propagator", "auto"] = "ts"
    method: Literal[METHODS] = "8vr"
    rtol: Annotated[float, Field(ge=1e-14, le=1e-2)] = 1e-10
    atol: Positive | Literal["scaled", "paper"] = "scaled"
    sample_interval: Positive | Literal["auto"] = "auto"
    samples: int | None = Field(None, ge=2)


class OutputTable(Section):
    """Which part of the fields is kept: cells ``window``, every n-th cell, every n-th sample; who writes.

    ``writer``: ``gather`` sends samples to rank 0, ``parallel`` has every rank write its own cells,
    ``auto`` takes ``parallel`` when a run's fields exceed 2 GiB.
    """

    fields: list[Literal["displacement", "velocity"]] = ["displacement", "velocity"]
    window: list[int] | None = Field(None, min_length=2, max_length=2)
    every: int = Field(1, ge=1)
    stride: int = Field(1, ge=1)
    writer: Literal["auto", "gather", "parallel"] = "auto"
    figures: bool = True


def read_toml(path: str | Path) -> dict[str, Any]:
    """The table in a TOML file, named after the file if it has no name; raises CaseError or OSError."""
    path = Path(path)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CaseError([Problem(str(path), None, f"not a TOML file ({error})")]) from None
    return {"name": path.stem} | table


def unknown_key(path: str, value: Any, valid: Iterable[str]) -> Problem:
    """The problem of a key that is not one of ``valid``, with the nearest one that is."""
    *parents, key = path.split(".")
    near = difflib.get_close_matches(key, list(valid), n=1, cutoff=0.5)
    prefix = "".join(f"{p}." for p in parents)
    remedy = f"did you mean {prefix}{near[0]}?" if near else f"valid keys: {', '.join(sorted(valid))}"
    return Problem(path, value, f"unknown key; {remedy}")


def with_overrides(table: dict, overrides: Iterable[str]) -> tuple[dict, list[Problem]]:
    """``table`` with each ``section.key=value`` put in (TOML value or bare word), and what was no such text."""
    table, problems = copy.deepcopy(table), []
    for override in overrides:
        path, equals, text = (part.strip() for part in override.partition("="))
        *parents, key = path.split(".")
        if not equals or not key or not all(parents):
            problems.append(Problem("--set", override, "write section.key=value"))
            continue
        try:
            value = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            value = _bare(text)
        place = table
        for parent in parents:
            place = place.setdefault(parent, {}) if isinstance(place, dict) else place
        if isinstance(place, dict):
            place[key] = value
        else:
            problems.append(Problem(f"--set {path}", value, f"{'.'.join(parents)} is a value, not a section"))
    return table, problems


def _bare(text: str) -> float | str:
    """A value that TOML would not take: a number such as .5, or a word."""
    try:
        return float(text)
    except ValueError:
        return text


def read_section(kind: type[Section], table: Any, name: str) -> tuple[Section, list[Problem]]:
    """The section ``name`` and its problems; with problems, the section holds what is sound and defaults."""
    if not isinstance(table, dict):
        return kind(), [Problem(name, table, f"must be a section [{name}]")]
    try:
        return kind(**table), []
    except ValidationError as error:
        problems: dict[str, Problem] = {}
        broken = set()
        for item in error.errors(include_url=False):
            broken.add(item["loc"][0])
            problem = _schema_problem(kind, name, item)
            problems.setdefault(problem.key, problem)
        sound, _ = read_section(kind, {k: v for k, v in table.items() if k not in broken}, name)
        return sound, list(problems.values())


def _schema_problem(kind: type[Section], name: str, item: dict) -> Problem:
    loc = [part for part in item["loc"] if not _is_tag(part)]
    path = name
    for part in loc:
        path += f"[{part + 1}]" if isinstance(part, int) else f".{part}"
    if item["type"] == "extra_forbidden":
        owner = _owner(kind, loc[:-1])
        return unknown_key(path, item["input"], [f.alias or k for k, f in owner.model_fields.items()])
    message = item["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    value = None if item["type"] == "missing" else item["input"]
    choices = item.get("ctx", {}).get("expected")
    if isinstance(value, str) and choices:
        near = difflib.get_close_matches(value, re.findall(r"'([^']+)'", choices), n=1, cutoff=0.4)
        message += f"; did you mean {near[0]!r}?" if near else ""
    return Problem(path, value, message)


def _is_tag(part: Any) -> bool:
    """Pydantic puts the tried branch of a union into the path: "float", "list[int]", "Span"..."""
    return isinstance(part, str) and (
        part in {"int", "float", "str", "bool", "Span", "ClearanceSpan"}
        or "[" in part
        or part.startswith("constrained")
    )


def _owner(kind: type[Section], loc: list) -> type[Section]:
    """The section that a path of keys below ``kind`` leads to."""
    for part in loc:
        fields = {field.alias or name: field.annotation for name, field in kind.model_fields.items()}
        kind = next(_sections_in(fields.get(part)), kind)
    return kind


def _sections_in(annotation: Any) -> Iterator[type[Section]]:
    if isinstance(annotation, type) and issubclass(annotation, Section):
        yield annotation
    for argument in get_args(annotation):
        yield from _sections_in(argument)
