"""Families of frequency-response curves: keys of a case that vary from curve to curve (``[nfrc.family]``)."""

import copy
import itertools
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

from vipetsc.case.case import Case
from vipetsc.case.reading import Table
from vipetsc.case.section import Problem
from vipetsc.case.value_ranges import Values, leaves, short_names, table_with, varied_values
from vipetsc.wording import distinct

# To read a member takes half a millisecond, but to follow its curve takes seconds to minutes: a thousand are a day.
MOST_MEMBERS = 1000
SECTIONS = ("lattice", "contacts", "disorder", "drive")  # whose keys may vary
PLAIN = re.compile(r"\w[\w.+-]*")  # a text that may be part of a file's name


class FamilyMember(NamedTuple):
    """One case of a family: the ``name`` of its files, the ``values`` of the keys that vary, and its ``table``."""

    name: str
    values: dict[str, Any]
    table: Table

    def __str__(self) -> str:
        return ", ".join(f"{key} = {value}" for key, value in self.values.items())


class Family(NamedTuple):
    """The ``members`` of a family, and the ``table`` of its case with every range of ``[nfrc.family]`` written out."""

    members: list[FamilyMember]
    table: Table


def family_of(table: Table) -> tuple[Family, list[Problem]]:
    """Return the family of a ``table`` with ``[nfrc.family]``, and what is wrong with that section.

    There is a member for each combination of the values of all keys; the last key varies fastest. Values are lists or
    ranges, as in ``[sweep]``.
    """
    section = table["nfrc"]["family"]
    given: dict[str, Any] = {}
    if isinstance(section, dict):
        given = dict(leaves(section))
    if not given:
        remedy = "give keys of the case with their values, as in: [nfrc.family] contacts.clearance = [1e-4, 2e-4]"
        return Family([], table), [Problem("nfrc.family", section, remedy)]

    values, problems = varied_values(given, "nfrc.family", table, Case.sections())
    for key in [key for key in given if key.partition(".")[0] not in SECTIONS]:
        problems.append(Problem(f"nfrc.family.{key}", given[key], f"only keys of {', '.join(SECTIONS)} can vary"))

    # One more than is allowed, rather than all: the product of a few ranges may exceed the memory.
    combinations = list(itertools.islice(itertools.product(*values.values()), MOST_MEMBERS + 1))
    if len(combinations) > MOST_MEMBERS:
        problems.append(Problem("nfrc.family", None, f"has more than {MOST_MEMBERS} members; give fewer values"))
    if problems:
        return Family([], table), problems

    # Ranges are written out, so that a resumed family has the same values if a later version computes them otherwise.
    expanded = copy.deepcopy(table)
    expanded["nfrc"]["family"] = {key: list(of_key) for key, of_key in values.items()}
    names = [_texts(of_key) for of_key in values.values()]
    members = []
    alone = table | {"nfrc": {key: value for key, value in table["nfrc"].items() if key != "family"}}
    for texts, combination in zip(itertools.product(*names), combinations, strict=True):
        chosen = dict(zip(values, combination, strict=True))
        member, wrong = table_with(alone, chosen)
        problems += wrong
        members.append(FamilyMember(name="-".join(_named(values, texts)), values=chosen, table=member))
    return Family(members=members, table=expanded), problems


def _named(values: Values, texts: Sequence[str]) -> list[str]:
    """Return the parts of a file's name: the short name of each key without brackets, and the text of its value."""
    short = short_names(list(values))
    return [f"{re.sub(r'[][]', '', name)}-{text}" for name, text in zip(short.values(), texts, strict=True)]


def _texts(values: Sequence[Any]) -> list[str]:
    """Return a text for each of the ``values``, for names of files; no two are equal.

    Numbers are written with the digits that distinguish them, and plain words as they are; if there is any other value,
    or one that comes twice, all are numbered: "no-1", "no-2", ...
    """
    if all(type(value) in (int, float) for value in values) and len(set(values)) == len(values):
        return distinct(values)
    are_plain = all(isinstance(value, str) and PLAIN.fullmatch(value) for value in values)
    if are_plain and len(set(values)) == len(values):
        return list(values)
    return [f"no-{number}" for number in range(1, len(values) + 1)]
