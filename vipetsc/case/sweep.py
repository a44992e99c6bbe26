"""Sweeps, which are many cases in one file: the section ``[sweep]`` of a case file, and its members."""

import hashlib
import itertools
import json
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tomli_w

from vipetsc.case.case import Case, StudyCase
from vipetsc.case.case_file import CaseFile
from vipetsc.case.html import html_table
from vipetsc.case.reading import Table, put, read_section
from vipetsc.case.schema import number
from vipetsc.case.section import CaseError, Problem, Section, described
from vipetsc.case.value_ranges import MOST_MEMBERS, Values, axes_of, leaves, short_names, table_with, varied_values
from vipetsc.plugins import without_folders
from vipetsc.wording import counted, shortened

# Members whose cases are resolved to check a sweep before it begins, and sites that they have together, at most. Each
# takes about a second: 0.6 ms a member, 5 us a site.
MOST_TRIED = 1_000
MOST_TRIED_SITES = 200_000
# Ramp, in periods, of a harmonic drive that goes on from the run before: the full force is there at once, as far as a
# ramp, which must be positive, allows. A sine has grown to 6e-3 of its amplitude by then.
SHORT_RAMP = 1e-3
# A key, and the beginnings of those that it fills in.
MATRICES = "lattice.cell.matrices"
OF_MATRICES = tuple(f"lattice.cell.{key}" for key in ("masses", "springs", "grounding"))


class SweepTable(Section):
    """Measures, stored fields and ranks of the members of a sweep, in addition to the keys that vary."""

    measures: list[Literal["entropy", "transfer", "motion"]] = described(
        "measures of each run: entropy over wavenumbers, transfer between bands; motion: neither of them",
        ["entropy", "transfer"],
        min_length=1,
    )
    fields: bool = described("whether fields and analysis of each run are stored", False)
    ranks: int = described("number of ranks per run", 1, ge=1)
    zip: list[list[str]] = described("groups of keys that vary together", [])
    follow: Literal["none", "up", "down"] = described(
        "whether each run begins where the one before it on the last axis ended, upwards or downwards in its values;"
        " needs `fields`",
        "none",
    )


@dataclass(frozen=True)
class SweepMember:
    """A run of a sweep: its ``index`` on every axis; its resolved ``case``, or None and the ``problems`` with it."""

    index: tuple[int, ...]
    case: Case | None
    problems: Sequence[Problem] = ()


class Sweep(StudyCase):
    """A sweep: the ``table`` of its case file without ``[sweep]``, the ``options``, and the ``axes``.

    Axes are in the file's order. Each has the values of a key, or of several keys that vary together.
    """

    options: SweepTable
    axes: tuple[Values, ...]

    verb = section = "sweep"
    has_members = True

    @classmethod
    def read(cls, table: Table) -> tuple[dict[str, Any], list[Problem]]:
        """Return fields, and everything that is wrong with ``[sweep]``; the members' cases are built by ``member``."""
        remedy = "give the keys that vary, as in: [sweep.drive] amplitude = { log = [1.0, 100.0], count = 9 }"
        table, section, missing = cls.divide(table, remedy)
        if missing:
            return {}, missing

        # The section [analysis] does not vary: all members are measured alike, and ``analyse`` measures them again.
        sections = Case.model_fields.keys() - {"name", "plugins", "analysis"} | {"disorder"}
        varying = {key: section[key] for key in section if key.partition(".")[0] in sections}
        options, problems = read_section(SweepTable, {k: v for k, v in section.items() if k not in varying}, "sweep")

        given = dict(leaves(varying))
        values, wrong_values = varied_values(given, "sweep", table, Case.sections())
        problems += wrong_values
        if not given:
            remedy = "contains no key that varies; give one, as in [sweep.drive] amplitude = [1.0, 2.0]"
            problems.append(Problem("sweep", None, remedy))

        if MATRICES in values and (filled_in := [key for key in values if key.startswith(OF_MATRICES)]):
            remedy = f"cannot vary with {MATRICES}, which makes it; vary one of the two"
            problems.append(Problem(f"sweep.{filled_in[0]}", given[filled_in[0]], remedy))
        axes, wrong = axes_of(values, options.zip)
        if options.follow != "none" and not options.fields:
            remedy = "needs the fields of each run, with which the next one begins: set sweep.fields = true"
            problems.append(Problem("sweep.follow", options.follow, remedy))
        if options.follow != "none" and axes and not _are_numbers(next(iter(axes[-1].values()))):
            remedy = "needs numbers on the last axis, in whose order runs follow one another; move that key to the end"
            problems.append(Problem("sweep.follow", options.follow, remedy))
        count = math.prod(len(next(iter(axis.values()))) for axis in axes)
        if count > MOST_MEMBERS:
            wrong.append(
                Problem("sweep", None, f"has {count:,} members; the limit is {MOST_MEMBERS:,}: split the sweep")
            )
        return {"table": table, "options": options, "axes": axes}, problems + wrong

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values on every axis."""
        return tuple(len(next(iter(axis.values()))) for axis in self.axes)

    def to_toml(self) -> str:
        """Return the sweep as TOML, every range written out; reading it back gives the same sweep."""
        section = self.options.model_dump()
        for axis in self.axes:
            for key, values in axis.items():
                put(section, key, list(values))
        return tomli_w.dumps(self.table | {"sweep": section})

    @property
    def count(self) -> int:
        """Number of members."""
        return math.prod(self.shape)

    def _repr_html_(self) -> str:
        """Return the keys that vary and their values, as a notebook shows them."""
        rows = [
            (key, shortened([f"{value}" for value in values])) for axis in self.axes for key, values in axis.items()
        ]
        return html_table(f"{self.name}: {self.count} members", rows)

    def ids(self) -> list[str]:
        """Return a name for every member: a hash of the table and of its keys' values; equal members have one name."""
        table = without_folders(self.table)
        whole = hashlib.sha256(json.dumps(table, sort_keys=True, default=str).encode())

        def name(texts: Iterable[str]) -> str:
            digest = whole.copy()
            # Sorted: the order of the axes in the file does not change the names of members.
            digest.update("".join(sorted(texts)).encode())
            return digest.hexdigest()[:16]

        # The values of an axis are written once, by one encoder: a sweep may have a million members.
        encode = json.JSONEncoder(sort_keys=True, default=str).encode
        texts: list[list[str]] = []
        for axis in self.axes:
            rows = [dict(zip(axis, values, strict=True)) for values in zip(*axis.values(), strict=True)]
            texts.append([encode(row) for row in rows])
        return [name(chosen) for chosen in itertools.product(*texts)]

    def member_table(self, index: Sequence[int]) -> tuple[Table, list[Problem]]:
        """Return table of the member with that ``index`` on every axis, and the problems of keys that cannot be set."""
        pairs = zip(self.axes, index, strict=True)
        return table_with(self.table, {key: values[i] for axis, i in pairs for key, values in axis.items()})

    def member(self, number: int) -> SweepMember:
        """Return the member ``number`` (from 0) in the order of the axes, the last varying fastest."""
        if number in self._resolved_members:
            return self._resolved_members[number]
        member = self._resolve_member(number)
        # Members that are tried before a sweep begins are asked for again. Not all are kept: there may be a million.
        if len(self._resolved_members) < MOST_TRIED:
            self._resolved_members[number] = member
        return member

    @cached_property
    def _resolved_members(self) -> dict[int, SweepMember]:
        """Members that were resolved before, by number."""
        return {}

    def _resolve_member(self, number: int) -> SweepMember:
        """Return the member ``number``, resolved."""
        index = tuple(map(int, np.unravel_index(number, self.shape)))
        table, problems = self.member_table(index)
        if problems:
            return SweepMember(index=index, case=None, problems=problems)
        try:
            return SweepMember(index=index, case=Case.from_table(table))
        except CaseError as error:
            return SweepMember(index=index, case=None, problems=error.problems)

    def chains(self) -> list[list[int]]:
        """Return the numbers of members that follow one another: along the last axis, in the order of its values.

        Without ``follow`` each member is a chain of its own.
        """
        numbers = np.arange(self.count).reshape(*self.shape)
        if self.options.follow == "none":
            return numbers.reshape(-1, 1).tolist()
        values = next(iter(self.axes[-1].values()))
        order = sorted(range(len(values)), key=lambda i: values[i], reverse=self.options.follow == "down")
        return numbers[..., order].reshape(-1, len(order)).tolist()

    def case_in(self, folder: Path, number: int, overrides: Sequence[str] = ()) -> Case:
        """Return the case of the member ``number`` of the sweep in a ``folder``, where members may follow one another.

        Such a member begins with the last state of the run before it, which ``folder`` has. Its harmonic drive is on
        from the beginning, since that of the run before was. ``overrides`` are as for ``case``. Raises CaseError.
        """
        case = self.case(number, overrides)
        chain = next(chain for chain in self.chains() if number in chain)
        if number == chain[0]:
            return case
        before = folder / self.ids()[chain[chain.index(number) - 1]] / "run.h5"
        changes: dict[str, Any] = {"initial": {"kind": "file", "path": str(before.resolve())}}
        if case.drive.ramp is not None and case.drive.frequency:
            changes["drive"] = {"ramp": SHORT_RAMP * 2 * np.pi / case.drive.frequency}
        return case.varied(without=["initial"], **changes)

    def number(self, name: str) -> int:
        """Return the number of the member ``name``, or of that number; raises CaseError if there is none."""
        ids = self.ids()
        if name in ids:
            return ids.index(name)
        if name.isdecimal() and int(name) < self.count:
            return int(name)
        remedy = f"is not a member; ensemble.h5 lists the names (member), and the numbers go from 0 to {self.count - 1}"
        raise CaseError([Problem("--member", name, remedy)], self.name)

    def case(self, number: int, overrides: Sequence[str] = ()) -> Case:
        """Return the case of the member ``number``, with ``overrides`` as of ``Case.load``; raises CaseError."""
        member = self.member(number)
        if member.case is None:
            raise CaseError(member.problems, f"{self.name}, member {number}")
        if not overrides:
            return member.case
        # The table as it is written: a resolved one has lost how its samples were counted.
        table, _ = self.member_table(member.index)
        return Case.from_table(table, overrides)

    def members(self, most: int = MOST_MEMBERS) -> list[SweepMember]:
        """Return members in their order, all of them or ``most`` drawn at random.

        Raises CaseError if none of these is a valid case, if any is not where members follow one another, and if any is
        invalid because of what its disorder draws: the remaining samples would have another distribution.
        """
        # Drawn with a seed of its own, so that every rank and every call tries the same ones.
        numbers = np.arange(self.count)
        if most < self.count:
            numbers = np.sort(np.random.default_rng(0).choice(self.count, most, replace=False))
        members = [self.member(int(number)) for number in numbers]
        # Each text once, since members with the same seed have the same problem.
        if refused := {str(p): p for member in members for p in member.problems if p.key.startswith("disorder")}:
            raise CaseError(refused.values(), self.name)
        # Where members follow one another, those behind an invalid one would have no beginning.
        invalid = [member for member in members if member.case is None]
        if len(invalid) == len(members) or (invalid and self.options.follow != "none"):
            raise CaseError(invalid[0].problems, self.name)
        return members

    def tried(self) -> list[SweepMember]:
        """Return the members by which a sweep is checked before it begins; raises CaseError as ``members`` does.

        Each member resolves all of its sites: where these are many, fewer members are tried, and the others are checked
        when they begin.
        """
        # The sites of the first member are counted for all: to count those of each would take the time to be saved.
        table, _ = self.member_table([0] * len(self.axes))
        return self.members(max(1, min(MOST_TRIED, MOST_TRIED_SITES // max(1, _site_count(table)))))

    def warnings(self) -> list[str]:
        """Return the problems of members that will fail, as far as they are tried: their cases are invalid."""
        counts = Counter(str(problem) for member in self.tried() for problem in member.problems)
        if not counts:
            return []
        problems = [f"{problem} ({counted(number, 'member')})" for problem, number in counts.items()]
        return [f"members that will fail: {shortened(problems)}"]

    def runs(self) -> list[CaseFile]:
        """Return the valid cases among the members that are tried."""
        return [member.case for member in self.tried() if member.case]

    @property
    def wants_pictures(self) -> bool:
        """Whether the results are drawn, ``output.figures`` of the members."""
        output = self.table.get("output", {})
        return isinstance(output, dict) and bool(output.get("figures", True))

    def names(self) -> dict[str, str]:
        """Return a short name for every key that varies: its last part, or all of it where that is not unique."""
        return short_names([key for axis in self.axes for key in axis])


def _site_count(table: Table) -> int:
    """Return number of sites that a ``table`` asks for, whose types are not checked yet; 0 where it does not say."""
    contacts = table.get("contacts", {})
    if not isinstance(contacts, dict):
        return 0
    sites = contacts.get("sites", 0)
    if isinstance(sites, dict):
        sites = sites.get("count", 0)
    if isinstance(sites, list):
        return len(sites)
    if isinstance(sites, int):
        return sites
    return 0


def coordinate(values: Iterable[Any]) -> np.ndarray:
    """Return the values of a key as an array (value,): numbers where they all are ("5pi/9" too), else their text."""
    read = [number(value) for value in values]
    if all(type(value) in (int, float) for value in read):
        return np.array(read)

    texts = []
    for value in read:
        if not isinstance(value, str):
            value = json.dumps(value)
        texts.append(value)
    return np.array(texts, dtype=object)


def _are_numbers(values: Iterable[Any]) -> bool:
    """Return whether all ``values`` are numbers, which have an order."""
    return all(isinstance(value, int | float) for value in values)
