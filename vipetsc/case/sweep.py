"""Many cases from one: the section ``[sweep]`` of a case file, and the members it stands for."""

from __future__ import annotations

import copy
import hashlib
import itertools
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tomli_w
from pydantic import Field

from vipetsc.case.case import Case
from vipetsc.case.schema import CaseError, Problem, Section, number, read_section, read_toml, with_overrides

RANGES = ("log", "linear")


class SweepTable(Section):
    """What is done with the members of a sweep, besides the keys that vary.

    ``measures``: what is measured of every run: ``entropy`` over wavenumbers (the paper's section II), ``transfer``
    between bands (section III). ``fields``: keep every run's full fields and analysis. ``ranks``: how many ranks
    share a run. ``zip``: groups of keys that vary together.
    """

    measures: list[Literal["entropy", "transfer"]] = Field(["entropy", "transfer"], min_length=1)
    fields: bool = False
    ranks: int = Field(1, ge=1)
    zip: list[list[str]] = Field([])


@dataclass(frozen=True)
class Axis:
    """Keys that vary together: ``values[i][j]`` is what key ``keys[i]`` takes at the j-th place."""

    keys: tuple[str, ...]
    values: tuple[tuple[Any, ...], ...]

    def __len__(self) -> int:
        return len(self.values[0])


@dataclass(frozen=True)
class Member:
    """One run of a sweep: its place on every axis; the resolved case, or why there is none."""

    place: tuple[int, ...]
    case: Case | None
    problem: str = ""

    @cached_property
    def id(self) -> str:
        """Hash of the resolved case, which names the run's folder; empty without a case."""
        return case_id(self.case) if self.case else ""


@dataclass(frozen=True)
class Sweep:
    """A sweep: the table of its case file without ``[sweep]``, the options, and the axes in the file's order."""

    name: str
    table: dict[str, Any]
    options: SweepTable
    axes: tuple[Axis, ...]

    @classmethod
    def load(cls, path: str | Path, overrides: Iterable[str] = ()) -> Sweep:
        """The sweep in file ``path`` with ``a.b=value`` overrides; raises CaseError or OSError."""
        return cls.from_table(read_toml(path), overrides, str(path))

    @classmethod
    def from_table(cls, table: dict[str, Any], overrides: Iterable[str] = (), source: str = "case") -> Sweep:
        """The sweep of a parsed TOML table; raises CaseError with everything that is wrong with ``[sweep]``."""
        table, problems = with_overrides(table, overrides)
        section = table.pop("sweep", None)
        if not isinstance(section, dict):
            remedy = "missing; list what varies, as in: [sweep.drive] amplitude = { log = [1.0, 100.0], count = 9 }"
            raise CaseError([*problems, Problem("sweep", section, remedy)], source)
        # Many runs want the fastest engine that a case allows.
        if isinstance(table.get("time", {}), dict):
            table["time"] = {"engine": "auto"} | table.get("time", {})
        sections = Case.model_fields.keys() - {"name"}
        varying = {key: section[key] for key in section if key.partition(".")[0] in sections}
        options, wrong = read_section(SweepTable, {k: v for k, v in section.items() if k not in varying}, "sweep")
        problems += wrong
        found: dict[str, tuple[Any, ...]] = {}
        for key, value in _leaves("", varying):
            try:
                found[key] = _values(value)
            except ValueError as error:
                problems.append(Problem(f"sweep.{key}", value, str(error)))
        if not varying:
            problems.append(
                Problem("sweep", None, "names no key that varies, as in [sweep.drive] amplitude = [1.0, 2.0]")
            )
        axes, wrong = _axes(found, options.zip)
        problems += wrong
        if problems:
            raise CaseError(problems, source)
        return cls(str(table.get("name", "sweep")), table, options, axes)

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values on every axis."""
        return tuple(len(axis) for axis in self.axes)

    def to_toml(self) -> str:
        """The sweep as TOML, every range written out; reading it back gives the same sweep."""
        section = self.options.model_dump()
        for axis in self.axes:
            for key, values in zip(axis.keys, axis.values, strict=True):
                _put(section, key, list(values))
        return tomli_w.dumps(self.table | {"sweep": section})

    def members(self) -> list[Member]:
        """All members in the order of the axes, the last varying fastest; raises CaseError if none is sound."""
        members, first = [], None
        for place in itertools.product(*(range(n) for n in self.shape)):
            table = copy.deepcopy(self.table)
            for axis, i in zip(self.axes, place, strict=True):
                for key, values in zip(axis.keys, axis.values, strict=True):
                    _put(table, key, values[i])
            try:
                members.append(Member(place, Case.from_table(table)))
            except CaseError as error:
                first = first or error
                members.append(Member(place, None, "; ".join(map(str, error.problems))))
        if first and not any(m.case for m in members):
            raise CaseError(first.problems, self.name)
        return members

    @property
    def figures(self) -> bool:
        """Whether the case asks for pictures, ``[output] figures``."""
        return bool(self.table.get("output", {}).get("figures", True))

    def names(self) -> dict[str, str]:
        """A short name for every key that varies: its last part, or all of it where that is not unique."""
        keys = [key for axis in self.axes for key in axis.keys]
        short = {key: key.removesuffix(".count").rpartition(".")[2] for key in keys}
        common = {name for name in short.values() if list(short.values()).count(name) > 1}
        return {key: key.replace(".", "_") if name in common else name for key, name in short.items()}


def case_id(case: Case) -> str:
    """The first 16 digits of the SHA-256 of the resolved case."""
    return hashlib.sha256(case.to_toml().encode()).hexdigest()[:16]


def _leaves(path: str, tree: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        here = f"{path}.{key}" if path else key
        if isinstance(value, dict) and not any(kind in value for kind in RANGES):
            yield from _leaves(here, value)
        else:
            yield here, value


def _values(value: Any) -> tuple[Any, ...]:
    """The values of a list or a range; raises ValueError with the remedy."""
    if isinstance(value, list) and value:
        return tuple(value)
    remedy = "give a list of values, { log = [first, last], count = n } or { linear = [first, last], count = n }"
    if not isinstance(value, dict) or len(value) != 2 or "count" not in value:
        raise ValueError(remedy)
    (kind,) = value.keys() - {"count"}
    ends, count = value[kind], value["count"]
    numbers = isinstance(ends, list) and len(ends) == 2 and all(type(e) in (int, float) for e in ends)
    if not numbers or type(count) is not int or count < 1:
        raise ValueError(remedy)
    if kind == "log" and min(ends) <= 0:
        raise ValueError("the ends of a log range must be positive")
    spaced = np.geomspace if kind == "log" else np.linspace
    return tuple(spaced(*map(float, ends), count).tolist())


def _axes(found: dict[str, tuple[Any, ...]], groups: list[list[str]]) -> tuple[tuple[Axis, ...], list[Problem]]:
    """One axis a key, or a group of keys that vary together."""
    problems, group_of = [], {}
    for group in groups:
        missing = [key for key in group if key not in found]
        lengths = {key: len(found[key]) for key in group if key in found}
        if missing:
            problems.append(Problem("sweep.zip", missing, f"not among the keys that vary: {', '.join(found)}"))
        elif len(set(lengths.values())) > 1:
            problems.append(Problem("sweep.zip", lengths, "keys that vary together need as many values each"))
        elif any(key in group_of for key in group):
            problems.append(Problem("sweep.zip", group, "a key can be in one group only"))
        group_of |= dict.fromkeys(group, tuple(group))
    axes: dict[tuple[str, ...], Axis] = {}
    for key in found:
        keys = group_of.get(key, (key,))
        if keys not in axes and not problems:
            axes[keys] = Axis(keys, tuple(found[k] for k in keys))
    return tuple(axes.values()), problems


def _put(table: dict[str, Any], key: str, value: Any) -> None:
    *parents, last = key.split(".")
    for parent in parents:
        inner = table.get(parent)
        table[parent] = table = dict(inner) if isinstance(inner, dict) else {}
    table[last] = value


def coordinate(values: Iterable[Any]) -> np.ndarray:
    """The values of a key as an array: numbers where they all are ("5pi/9" too), else their text."""
    read = [number(value) for value in values]
    if all(type(value) in (int, float) for value in read):
        return np.array(read)
    return np.array([value if isinstance(value, str) else json.dumps(value) for value in read], dtype=object)
