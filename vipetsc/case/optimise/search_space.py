"""The space that a search explores: the values of its variables, and the tables of the cases that have them."""

import copy
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vipetsc.case.case import Case
from vipetsc.case.contacts import values_of_sites
from vipetsc.case.optimise.variables import Kind, Variable, VariablesTable
from vipetsc.case.quantities import OF_PRESET, table_of
from vipetsc.case.reading import LARGEST, Table, put, value_at
from vipetsc.case.resolve import with_preset
from vipetsc.case.schema import number
from vipetsc.case.section import unit_at
from vipetsc.case.units import in_unit
from vipetsc.case.value_ranges import RANGES

IN_ROWS = ("contacts.", "lattice.profiles.")  # keys with lists over the sites or the cells
FORMS = "give { log = [low, high] }, { linear = [low, high] }, { whole = [low, high] } or a list of values"


@dataclass(frozen=True)
class SearchSpace:
    """The ``variables`` of a search, and the ``table`` of the case in which their paths lead to values."""

    table: Table
    variables: list[Variable]

    def begin(self, clearance: Sequence[float] = ()) -> np.ndarray:
        """Return the values (variable) of the case to begin with, or with other clearances in m, within the bounds."""
        values = [variable.start for variable in self.variables]
        if clearance:
            # Clearances vary one by one, or as the two ends of a profile: their paths differ.
            at = {f"contacts.clearance[{i}]": gap for i, gap in enumerate(clearance, 1)}
            at |= {"contacts.clearance.first": clearance[0], "contacts.clearance.last": clearance[-1]}
            values = [at.get(variable.path, variable.start) for variable in self.variables]
        # The values of the case may be outside the bounds; the search begins within them.
        return np.clip(values, [v.low for v in self.variables], [v.high for v in self.variables])

    def to_unit(self, values: np.ndarray) -> np.ndarray:
        """Return the point (variable,) in the unit cube that stands for ``values`` (variable,)."""
        return np.array([variable.to_unit(x) for x, variable in zip(values, self.variables, strict=True)])

    def from_unit(self, point: np.ndarray) -> np.ndarray:
        """Return the values (variable,) at a ``point`` (variable,) of the unit cube; sites rise, no two in one cell."""
        inside = np.clip(point, 0.0, 1.0)
        values = np.array([variable.from_unit(x) for x, variable in zip(inside, self.variables, strict=True)])

        sites = [i for i, variable in enumerate(self.variables) if variable.kind == "site"]
        if sites:
            # Each cell, less the number of sites before it, must not be below that of the site before: with that number
            # added back, sites are one cell apart or more. The upper bound leaves room for the sites behind.
            order = np.arange(len(sites))
            last = self.variables[sites[0]].high
            cells = np.maximum.accumulate(np.sort(np.round(values[sites])) - order)
            values[sites] = np.minimum(cells, last - order[-1]) + order
        return values

    def table_at(self, values: Iterable[float]) -> Table:
        """Return the table of the case with ``values`` (variable)."""
        # A copy, since all designs are built from the table of the case to begin with.
        table = copy.deepcopy(self.table)
        for variable, value in zip(self.variables, values, strict=True):
            put(table, variable.path, variable.in_case(value))
        return table


class VariableRow(NamedTuple):
    """Variables of one kind and with the same bounds: a name and a path for each."""

    names: list[str]
    paths: list[str]
    low: float
    high: float
    kind: Kind
    choices: tuple[Any, ...] = ()


def search_space(bounds: VariablesTable, table: Table, base: Case) -> SearchSpace:
    """Return the search space of a case ``base``, read from the ``table``; keys with an invalid range are left out.

    A variable of which the case has no number begins with NaN.
    """
    # Variables with names come first: the order of a design's values in files does not depend on the keys that vary.
    rows = _named_rows(bounds, len(base.model().chain.sites))
    given = bounds.keys_of_case()
    table = _with_entries(table, base, [*(path for row in rows for path in row.paths), *given])
    gaps = base.model().chain.sites.clearances.tolist()
    # Without sites there are no clearances, which ``variable_problems`` reports.
    if bounds.profile and gaps:
        # The clearances of a profile follow from the first and the last one, whatever those of the case are.
        table["contacts"] = table["contacts"] | {"clearance": {"first": gaps[0], "last": gaps[-1]}}

    for key, value in given.items():
        try:
            rows.append(row_of(key, value, table))
        except ValueError:
            # ``variable_problems`` reports it.
            continue

    resolved = base.model_dump(by_alias=True, exclude_none=True)
    variables: list[Variable] = []
    for row in rows:
        is_row = len(row.paths) > 1 and row.kind in ("log", "linear")
        for name, path in zip(row.names, row.paths, strict=True):
            in_row = ""
            if is_row and path.startswith(IN_ROWS) and path.endswith("]"):
                in_row = row.paths[0]
            variables.append(
                Variable(
                    name=name,
                    path=path,
                    low=row.low,
                    high=row.high,
                    kind=row.kind,
                    start=_start(row, path, (table, resolved)),
                    row=in_row,
                    choices=row.choices,
                )
            )
    return SearchSpace(table=table, variables=variables)


def _named_rows(bounds: VariablesTable, count: int) -> list[VariableRow]:
    """Return the variables that have names of their own, of a case with ``count`` sites."""
    numbers = range(1, count + 1)
    rows: list[VariableRow] = []

    def add(pair: Sequence[float] | None, names: list[str], paths: list[str], kind: Kind) -> None:
        """Add the row of a quantity with the bounds ``pair``, if it varies."""
        if pair:
            rows.append(VariableRow(names=names, paths=paths, low=float(pair[0]), high=float(pair[1]), kind=kind))

    add(bounds.clearance, [f"clearance {i}" for i in numbers], [f"contacts.clearance[{i}]" for i in numbers], "log")
    ends = ["first", "last"]
    add(bounds.profile, [f"{end} clearance" for end in ends], [f"contacts.clearance.{end}" for end in ends], "log")
    add(bounds.sites, [f"site {i}" for i in numbers], [f"contacts.sites[{i}]" for i in numbers], "site")
    add(bounds.restitution, ["restitution"], ["contacts.restitution"], "linear")
    for mass, pair in bounds.masses.items():
        add(pair, [f"mass {mass}"], [f"lattice.cell.masses[{mass}]"], "log")
    for spring, pair in bounds.springs.items():
        add(pair, [f"spring {spring}"], [f"lattice.cell.springs[{spring}].stiffness"], "log")
    return rows


def _with_entries(table: Table, base: Case, paths: Sequence[str]) -> Table:
    """Return the ``table`` with the cell, and with the lists over sites, to whose entries the ``paths`` lead."""
    table = copy.deepcopy(table)
    if any(path.startswith("lattice.cell.") for path in paths) and "cell" not in table.get("lattice", {}):
        table = with_preset(table)
        cell = table_of(base.lattice.undamped_cell())
        others = {key: value for key, value in table["lattice"].items() if key not in OF_PRESET}
        table["lattice"] = others | {"cell": cell.model_dump(exclude_none=True)}

    chain = base.model().chain
    contacts = dict(table.get("contacts", {}))
    for path in paths:
        if path.startswith("contacts.clearance["):
            contacts["clearance"] = chain.sites.clearances.tolist()
        if path.startswith("contacts.sites["):
            contacts["sites"] = (chain.sites.cells + 1).tolist()
        of_each_site = re.match(r"contacts\.each\.(\w+)", path)
        if of_each_site and hasattr(base.contacts, of_each_site[1]):
            values = values_of_sites(base.contacts, of_each_site[1], len(chain.sites))
            if None not in values:
                contacts["each"] = {of_each_site[1]: values} | contacts.get("each", {})
    return table | {"contacts": contacts}


def row_of(key: str, given: Any, table: Table) -> VariableRow:
    """Return the variables of the ``key`` of a case, from its range or list; raises ValueError with the remedy."""
    given = in_unit(given, unit_at(Case.sections(), key, table))
    if isinstance(given, list):
        if len(given) < 2:
            raise ValueError("give two values or more")
        return VariableRow(
            names=[key], paths=[key], low=1.0, high=float(len(given)), kind="choice", choices=tuple(given)
        )

    kind, low, high = _range_of(given)
    value = value_at(table, key)
    paths = [key]
    if value == []:
        raise ValueError("the case has an empty list there, in which no entry can vary")
    if isinstance(value, list):
        paths = [f"{key}[{i}]" for i in range(1, len(value) + 1)]
    return VariableRow(names=paths, paths=paths, low=low, high=high, kind=kind)


def _range_of(given: Any) -> tuple[Kind, float, float]:
    """Return the kind and the bounds of a range; raises ValueError with the remedy."""
    if not isinstance(given, dict) or len(given) != 1:
        raise ValueError(FORMS)
    ((kind, pair),) = given.items()
    if kind not in RANGES or not isinstance(pair, list) or len(pair) != 2:
        raise ValueError(FORMS)
    types: tuple[type, ...] = (int, float)
    numbers = "numbers"
    if kind == "whole":
        types = (int,)
        numbers = "whole numbers"
    # ``type`` rather than ``isinstance``: a boolean is an ``int`` for the latter.
    if not all(type(end) in types and abs(end) <= LARGEST for end in pair):
        raise ValueError(f"the bounds must be {numbers} up to {LARGEST:g}")

    low, high = map(float, pair)
    if not low < high:
        raise ValueError("must be [low, high] with low below high")
    if kind == "log" and low <= 0:
        raise ValueError("bounds of a logarithm must be positive; linear bounds may be 0")
    return kind, low, high


def _start(row: VariableRow, path: str, tables: Iterable[Table]) -> float:
    """Return value of the variable at ``path`` in the first of the ``tables`` that has one; NaN without a number."""
    values = [value_at(table, path) for table in tables]
    if row.kind == "choice":
        for value in values:
            if value is not None and value in row.choices:
                return float(row.choices.index(value) + 1)
        return 1.0

    for value in values:
        # Wavenumbers may be texts with pi.
        read = number(value)
        if type(read) in (int, float):
            return float(read)
    return np.nan


def case_of(table: Table, disorder: Any = None) -> Case:
    """Return the run in a ``table``, under one name, with ``disorder`` if that is given; raises CaseError."""
    run = {key: value for key, value in table.items() if key in Case.model_fields} | {"name": "design"}
    if disorder is not None:
        run["disorder"] = disorder
    return Case.from_table(run)
