"""Problems with the variables of a search, and warnings about them."""

import copy
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from vipetsc.case.case import Case
from vipetsc.case.contacts import lists_of, values_of_sites
from vipetsc.case.optimise.search_space import VariableRow, case_of, row_of, search_space
from vipetsc.case.optimise.variables import VariablesTable
from vipetsc.case.reading import Table, put
from vipetsc.case.section import CaseError, Problem, is_within

AT = "optimise.variables"
# Keys of the case that are clearances; each path stands for the keys within it, too.
CLEARANCES = ("contacts.clearance", "contacts.clearance_minus", "contacts.each.clearance_minus")


def variable_problems(bounds: VariablesTable, table: Table, base: Case) -> Iterator[Problem]:
    """Yield problems with the variables of a case ``base``, which was read from the ``table``."""
    if bounds.is_empty:
        valid = ", ".join(VariablesTable.model_fields)
        yield Problem(AT, None, f"contains no quantity that varies; give [low, high] for any of {valid}")
    yield from _bounds_problems(bounds, base)

    space = search_space(bounds, table, base)
    starts = {variable.path: variable.start for variable in space.variables}
    given = bounds.keys_of_case()
    rows: dict[str, VariableRow] = {}
    for key, value in given.items():
        try:
            rows[key] = row_of(key, value, space.table)
        except ValueError as error:
            yield Problem(f"{AT}.{key}", value, str(error))

    # Variables with names of their own come first in the space; those of keys follow.
    count = len(space.variables) - sum(len(row.paths) for row in rows.values())
    paths = [variable.path for variable in space.variables[:count]]
    if bounds.restitution:
        yield from _of_each_site("restitution", "contacts.restitution", bounds.restitution, base)
    for key, row in rows.items():
        problems = [
            *_twice(key, given[key], paths),
            *_of_each_site(key, key, given[key], base),
            *_tried(key, row, space.table),
        ]
        missing = [path for path in row.paths if np.isnan(starts[path])]
        if missing and not problems:
            remedy = "has no number in the case, at which the search would begin; give one there"
            problems.append(Problem(f"{AT}.{key}", given[key], remedy))
        # One problem for each key, since later checks find the cause of the first one again.
        yield from problems[:1]
        paths += row.paths


def variable_warnings(bounds: VariablesTable, base: Case) -> Iterator[str]:
    """Yield the warning of clearances that vary at sites of the case ``base`` with a precompression."""
    varying = [name for name in ("clearance", "profile") if getattr(bounds, name)]
    varying += [key for key in bounds.keys_of_case() if is_within(key, CLEARANCES)]
    pressed = values_of_sites(base.contacts, "precompression", len(base.model().chain.sites))
    deepest = max((depth or 0.0 for depth in pressed), default=0.0)
    if not (varying and deepest):
        return

    path = "contacts.precompression"
    if "precompression" in lists_of(base.contacts):
        path = "contacts.each.precompression"
    yield (
        f"{AT}.{varying[0]}: a clearance reduces the precompression ({path}, up to {deepest:.3g} m), so that a contact"
        " is pressed at rest by the difference of the two, and open from a clearance above the precompression on; to"
        f" search for the indentation at rest let {path} vary instead"
    )


def _twice(key: str, given: Any, paths: Iterable[str]) -> Iterator[Problem]:
    """Yield the problem of a ``key`` that varies, whole or in part, by one of the ``paths`` already."""
    for path in paths:
        if is_within(path, [key]) or is_within(key, [path]):
            yield Problem(f"{AT}.{key}", given, "varies by another variable already; remove one of them")
            return


def _of_each_site(name: str, key: str, given: Any, base: Case) -> Iterator[Problem]:
    """Yield the problem of the ``key`` of all sites in a case in which each site has a value of its own."""
    quantity = key.removeprefix("contacts.")
    if quantity != key and quantity in lists_of(base.contacts):
        remedy = f"each site has a value of its own, contacts.each.{quantity}, which can vary instead"
        yield Problem(f"{AT}.{name}", given, remedy)


def _tried(key: str, row: VariableRow, table: Table) -> Iterator[Problem]:
    """Yield the problem of a ``key`` that is invalid at a bound, or with one of the choices, of its first variable.

    All other keys stay as they are. Only problems with the key itself count: others may vanish where other keys vary.
    """
    path = row.paths[0]
    values = row.choices or (row.low, row.high)
    for value in values:
        tried = copy.deepcopy(table)
        if row.kind == "whole":
            value = int(value)
        problems = put(tried, path, copy.deepcopy(value))
        try:
            case_of(tried)
        except CaseError as error:
            problems += error.problems

        for problem in problems:
            if _is_about(problem.key.replace('"', ""), path, is_entry=path != key):
                yield Problem(f"{AT}.{key}", value, problem.remedy)
                return


def _is_about(key: str, path: str, is_entry: bool) -> bool:
    """Return whether the problem of a ``key`` is one of the value at ``path``.

    It is if it names a key around that one, as for an unknown key. For an entry of a list (``is_entry``) it is not: a
    problem of the whole list is that entries exclude each other, which may vanish where they all vary.
    """
    if is_entry:
        return key == path
    return is_within(path, [key])


def _bounds_problems(bounds: VariablesTable, base: Case) -> Iterator[Problem]:
    """Yield problems with the bounds of variables that have names of their own."""
    if bounds.clearance and bounds.profile:
        yield Problem(f"{AT}.profile", bounds.profile, "give clearance or profile, not both")

    cell = base.lattice.unit_cell()
    for kind, given, count in (
        ("masses", bounds.masses, len(cell.masses)),
        ("springs", bounds.springs, len(cell.springs)),
    ):
        # Numbers are compared as texts: paths have them as they are given, and that of "01" leads to no mass or spring.
        numbers = [str(number) for number in range(1, count + 1)]
        for name, pair in given.items():
            if name not in numbers:
                yield Problem(f"{AT}.{kind}.{name}", pair, f"the cell's {kind} are numbered from 1 to {count}")

    if bounds.sites:
        low, high = bounds.sites
        sites = len(base.model().chain.sites)
        if not 1 <= low < high <= base.lattice.cells or high - low + 1 < sites:
            remedy = f"must lie within cells 1 to {base.lattice.cells} and have room for all {sites} sites"
            yield Problem(f"{AT}.sites", bounds.sites, remedy)
