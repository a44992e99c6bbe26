"""Problems with the variables of a search."""

import copy
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from vipetsc.case.case import Case
from vipetsc.case.case_file import CaseError, Problem, Table, put
from vipetsc.case.contacts import lists_of
from vipetsc.case.search_space import VariableRow, case_of, row_of, search_space
from vipetsc.case.variables import SECTIONS, VariablesTable

AT = "optimise.variables"


def variable_problems(bounds: VariablesTable, table: Table, base: Case) -> Iterator[Problem]:
    """Problems with the variables of a case ``base``, which was read from the ``table``."""
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

    # Variables with names of their own come first.
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
        # One problem a key: the later checks meet what the first one has found, too.
        yield from problems[:1]
        paths += row.paths


def _twice(key: str, given: Any, paths: Iterable[str]) -> Iterator[Problem]:
    """The problem of a ``key`` that varies already, or a part of which does, by one of the ``paths``."""
    for path in paths:
        short, long = sorted((key, path), key=len)
        if long == short or long.startswith((f"{short}.", f"{short}[")):
            yield Problem(f"{AT}.{key}", given, "varies by another variable already; omit one of them")
            return


def _of_each_site(name: str, key: str, given: Any, base: Case) -> Iterator[Problem]:
    """The problem of the ``key`` of all sites in a case in which each site has a value of its own."""
    quantity = key.removeprefix("contacts.")
    if quantity != key and quantity in lists_of(base.contacts):
        remedy = f"each site has a value of its own, contacts.each.{quantity}, which can vary instead"
        yield Problem(f"{AT}.{name}", given, remedy)


def _tried(key: str, row: VariableRow, table: Table) -> Iterator[Problem]:
    """Problems with a key itself at the bounds or with the values of its first variable, while all others stay.

    A case that is impossible because of other keys may be possible where these vary too.
    """
    path = row.paths[0]
    values = row.choices or (row.low, row.high)
    for value in values:
        tried = copy.deepcopy(table)
        problems = put(tried, path, int(value) if row.kind == "whole" else copy.deepcopy(value))
        try:
            case_of(tried)
        except CaseError as error:
            problems += error.problems
        for problem in problems:
            if _is_about(problem.key.replace('"', ""), path, is_entry=path != key):
                yield Problem(f"{AT}.{key}", value, problem.remedy)
                return


def _is_about(key: str, path: str, is_entry: bool) -> bool:
    """Whether the problem of a ``key`` is about what stands at ``path``; entries of a list may only exclude each other.

    A key that is unknown may be a part of its path.
    """
    return key == path or (not is_entry and path.startswith((f"{key}.", f"{key}[")))


def _bounds_problems(bounds: VariablesTable, base: Case) -> Iterator[Problem]:
    """Problems with the bounds of variables that have names of their own."""
    if bounds.clearance and bounds.profile:
        yield Problem(f"{AT}.profile", bounds.profile, "give clearance or profile, not both")

    cell = base.lattice.unit_cell()
    given = bounds.model_dump(exclude_none=True, exclude={*SECTIONS})
    pairs = {key: pair for key, pair in given.items() if isinstance(pair, list)}
    for kind, count in (("masses", len(cell.masses)), ("springs", len(cell.springs))):
        for name, pair in given[kind].items():
            pairs[f"{kind}.{name}"] = pair
            if not (name.isdecimal() and 1 <= int(name) <= count):
                yield Problem(f"{AT}.{kind}.{name}", pair, f"the cell's {kind} are numbered from 1 to {count}")

    for key, (low, high) in pairs.items():
        if key != "sites" and not low < high:
            yield Problem(f"{AT}.{key}", [low, high], "must be [low, high] with low below high")
    if bounds.sites:
        low, high = bounds.sites
        sites = len(base.model().chain.sites)
        if not 1 <= low < high <= base.lattice.cells or high - low + 1 < sites:
            remedy = f"must lie within cells 1 to {base.lattice.cells} and have room for all {sites} sites"
            yield Problem(f"{AT}.sites", bounds.sites, remedy)
