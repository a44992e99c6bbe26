"""Places of a strip, by which a case names cells (i, j): lists and patterns, and what the sections of a case become.

``i`` counts along the strip and ``j`` across it, both from 1. A drive, a point and a struck mass have a ``place``
[i, j] or [i, j, mass], which becomes ``cell`` and ``mass``; drives, struck masses and contacts may have ``places``.
"""

import copy
from collections.abc import Iterator
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from vipetsc.case.reading import Table, read_section
from vipetsc.case.section import BY_SHAPE, Problem, Section, described
from vipetsc.case.units import in_unit
from vipetsc.lattice.plane import PlaneCell

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Vector = Annotated[list[Finite], Field(min_length=2, max_length=2)]
Pair = Annotated[list[int], Field(min_length=2, max_length=2)]
Cell = Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=2, max_length=2)]
Place = Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=2, max_length=3)]

OF_A_STRIP = {
    "drive": ("place", "places", "beam"),
    "initial": ("place", "places"),
    "contacts": ("places", "offset"),
    "output": ("place",),
    "identify": ("place",),
}
"""Keys that only a strip has, by section."""


class PlacesTable(Section):
    """Cells of a strip: those that satisfy every key, of these every n-th, and of these a random share.

    They come in the order of i, those of one i in the order of j; those of a line from its beginning to its end.
    """

    row: int | None = described("the cells with this j", None, ge=1)
    column: int | None = described("the cells with this i", None, ge=1)
    line: Annotated[list[Cell], Field(min_length=2, max_length=2)] | None = described(
        "from one cell [i, j] straight to another", None
    )
    within: Annotated[list[Cell], Field(min_length=2, max_length=2)] | None = described(
        "the rectangle between two cells", None
    )
    centre: Vector | None = described("centre [i, j] of a disc, which may lie between cells", None)
    radius: Positive | None = described("radius of the disc", None, unit="distances of neighbouring cells along a row")
    every: int = described("every n-th of these cells", 1, ge=1)
    share: Annotated[float, Field(gt=0, le=1)] | None = described("a random share of these cells", None)
    seed: Annotated[int, Field(ge=0)] = described("seed of the random share", 0)
    mass: int = described("number of the mass in the cell; of contacts: see `pair`", 1, ge=1)

    def cells(self, shape: tuple[int, int], plane: PlaneCell) -> np.ndarray:
        """Return the cells (n, 2) from 1 of a strip of that ``shape``, its cells along and across."""
        places = np.stack(np.meshgrid(*(np.arange(1, n + 1) for n in shape), indexing="ij"), axis=-1).reshape(-1, 2)
        if self.line is not None:
            begin, end = np.array(self.line)
            steps = np.abs(end - begin).max()
            places = np.rint(begin + np.linspace(0, 1, steps + 1)[:, None] * (end - begin)).astype(int)
        if self.row is not None:
            places = places[places[:, 1] == self.row]
        if self.column is not None:
            places = places[places[:, 0] == self.column]
        if self.within is not None:
            corners = np.sort(self.within, axis=0)
            places = places[((places >= corners[0]) & (places <= corners[1])).all(axis=1)]
        if self.centre is not None and self.radius is not None:
            distance = np.linalg.norm((places - self.centre) @ np.array(plane.vectors), axis=1)
            places = places[distance <= self.radius * np.linalg.norm(plane.vectors[0])]

        places = places[:: self.every]
        if self.share is not None:
            # Philox: the same numbers with every version of NumPy.
            order = np.random.Generator(np.random.Philox(self.seed)).permutation(len(places))
            places = places[np.sort(order[: round(self.share * len(places))])]
        return np.asarray(places)


Places = Annotated[list[Cell] | PlacesTable, BY_SHAPE]


class BeamTable(Section):
    """Phases and amplitudes of the drives at several places, so that their waves add up to a beam."""

    wavevector: Vector = described(
        "phase by which the force lags from cell to cell [along i, along j]", unit="rad/cell"
    )
    width: Positive | None = described(
        "standard deviation of the amplitudes about the middle of the places; default: all are equal",
        None,
        unit="cells",
    )


class DefectTable(Section):
    """A quantity of the plane's cell that has another value, or a multiple of its value, at some places."""

    quantity: Annotated[str, Field(pattern=r"^(masses\[[1-9]\d*\]|springs\[[1-9]\d*\]\.stiffness)$")] = described(
        'as "masses[1]" or "springs[2].stiffness", numbered in the cell of the plane; a spring is at the place where it'
        " begins"
    )
    places: Places = described("the cells")
    value: Finite | None = described("value at these places", None, unit="unit of the quantity")
    factor: Finite | None = described("value at these places over the usual one, instead of `value`", None)


class Named(Section):
    """What is read of the keys by which a section names places."""

    place: Place | None = None
    places: Places | None = None
    beam: BeamTable | None = None
    offset: Pair | None = None


class Placing:
    """Translates the places of a strip of ``shape`` cells (along, across), and collects the ``problems`` with them."""

    def __init__(self, plane: PlaneCell, shape: tuple[int, int], is_ring: bool) -> None:
        self.plane = plane
        self.shape = shape
        self.is_ring = is_ring
        self.problems: list[Problem] = []

    def number(self, row: int, mass: int) -> int:
        """Return number in the wide cell, from 1, of the degree of freedom ``mass`` in a ``row``; 0 is the ground."""
        if mass == 0:
            return 0
        return (row - 1) * self.plane.dofs + mass

    def read(self, table: Table, key: str) -> Named:
        """Return the keys of a ``table`` that name places, checked; those with problems are left out."""
        given = {name: table[name] for name in _keys_at(key) if name in table}
        named, problems = read_section(Named, given, key)
        self.problems += problems
        return named

    def cells(self, places: Any, key: str) -> list[tuple[int, int]]:
        """Return the cells (i, j) of ``places``, each once."""
        rows = places
        if isinstance(places, PlacesTable):
            if (places.centre is None) != (places.radius is None):
                self.problems.append(
                    Problem(f"{key}.radius", places.radius, "a disc has a centre and a radius; give both")
                )
            rows = places.cells(self.shape, self.plane).tolist()
            if not rows:
                size = " x ".join(map(str, self.shape))
                self.problems.append(Problem(key, None, f"no cell of the strip of {size} cells has this pattern"))
        cells = [(i, j) for i, j in rows]
        if rows is places and len(set(cells)) < len(cells):
            twice = next(cell for cell in cells if cells.count(cell) > 1)
            self.problems.append(Problem(key, list(twice), "given twice"))
        outside = [list(cell) for cell in cells if not self.is_inside(cell)]
        if outside:
            remedy = f"outside the strip of {self.shape[0]} x {self.shape[1]} cells, numbered [i, j] from [1, 1]"
            self.problems.append(Problem(key, outside[:3], remedy))
        return list(dict.fromkeys(cells))

    def is_inside(self, cell: tuple[int, ...]) -> bool:
        """Return whether a ``cell`` (i, j) lies in the strip."""
        return all(1 <= at <= size for at, size in zip(cell[:2], self.shape, strict=True))

    def spread(self, table: Table, key: str) -> list[Table]:
        """Return tables with ``cell`` and ``mass``, one a place, that a ``table`` with ``place`` or ``places`` is."""
        named = self.read(table, key)
        others = {name: value for name, value in table.items() if name not in _keys_at(key)}
        ways = [named.place is not None, named.places is not None, bool({"cell", "mass"} & table.keys())]
        if sum(ways) > 1:
            self.problems.append(Problem(f"{key}.place", None, "give a place, or places, or cell and mass"))
            return [others]
        if named.beam is not None and named.places is None:
            self.problems.append(Problem(f"{key}.beam", None, "joins the drives at several places; give places"))

        if named.place is not None:
            cells = self.cells([named.place[:2]], f"{key}.place")
            mass = (*named.place, 1)[2]
        elif named.places is not None:
            cells = self.cells(named.places, f"{key}.places")
            mass = named.places.mass if isinstance(named.places, PlacesTable) else 1
        else:
            return [others]
        if mass > self.plane.dofs:
            remedy = f"the cell of the plane has the masses 1 to {self.plane.dofs}"
            self.problems.append(Problem(f"{key}.place", mass, remedy))
        if self.problems:
            return [others]
        tables = [others | {"cell": i, "mass": self.number(j, mass)} for i, j in cells]
        if named.beam is not None:
            self._join(tables, cells, named.beam)
        return tables

    @staticmethod
    def _join(tables: list[Table], cells: list[tuple[int, int]], beam: BeamTable) -> None:
        """Give the drives in ``tables`` at the ``cells`` the phases and amplitudes of a ``beam``."""
        places = np.array(cells, float)
        phases = -(places - places[0]) @ np.array(beam.wavevector)
        weights = np.ones(len(cells))
        if beam.width is not None:
            distance = np.linalg.norm(places - places.mean(axis=0), axis=1)
            weights = np.exp(-0.5 * (distance / beam.width) ** 2)
        for table, phase, weight in zip(tables, phases.tolist(), weights.tolist(), strict=True):
            # Values with a unit are texts; others are refused where the section is read.
            usual = in_unit(table.get("phase", 0.0), "rad"), in_unit(table.get("amplitude", 1.0), "N")
            if all(isinstance(value, int | float) for value in usual):
                table["phase"] = usual[0] + phase
                table["amplitude"] = usual[1] * weight

    def of_drives(self, table: Table, key: str) -> Table:
        """Return a section whose ``more`` has further tables of its kind, with a table for each place."""
        more = table.get("more") or []
        if not isinstance(more, list) or not all(isinstance(one, dict) for one in more):
            return table
        first, *others = self.spread({name: value for name, value in table.items() if name != "more"}, key)
        if key == "initial":
            # Of a struck mass only the velocity, of which ``more`` has further ones.
            others = [{name: one[name] for name in ("cell", "mass", "velocity") if name in one} for one in others]
        for number, one in enumerate(more, 1):
            others += self.spread(one, f"{key}.more[{number}]")
        return first | ({"more": others} if others else {})

    def of_contacts(self, table: Table) -> Table:
        """Return the section ``[contacts]`` with sites and pairs in the wide cell instead of places."""
        named = self.read(table, "contacts")
        if named.places is None:
            if "offset" in table:
                self.problems.append(Problem("contacts.offset", None, "give it with contacts.places"))
            return table
        if "sites" in table:
            self.problems.append(Problem("contacts.places", None, "give places or sites, not both"))
        each = table.get("each") or {}
        pairs = each.get("pair", table.get("pair", [0, 1])) if isinstance(each, dict) else None
        cells = self.cells(named.places, "contacts.places")
        if not isinstance(pairs, list) or self.problems:
            return table
        if not pairs or not isinstance(pairs[0], list):
            pairs = [pairs] * len(cells)
        if len(pairs) != len(cells):
            self.problems.append(Problem("contacts.each.pair", None, f"give one for each of the {len(cells)} places"))
            return table

        offset = named.offset or [0, 0]
        joined = []
        for (i, j), pair in zip(cells, pairs, strict=True):
            joined.append(self._pair((i, j), pair, offset))
        if self.problems:
            return table
        each = {name: value for name, value in each.items() if name != "next_cell"} | {"pair": joined}
        if offset[0]:
            each["next_cell"] = [True] * len(cells)
        gone = {*OF_A_STRIP["contacts"], "pair", "next_cell", "sites"}
        others = {name: value for name, value in table.items() if name not in gone}
        return others | {"sites": [i for i, _ in cells], "each": each}

    def _pair(self, cell: tuple[int, int], pair: Any, offset: list[int]) -> list[int]:
        """Return host and resonator in the wide cell of a contact at ``cell``; ``pair`` counts in the plane's."""
        dofs = self.plane.dofs
        if not (isinstance(pair, list) and len(pair) == 2 and all(type(n) is int and 0 <= n <= dofs for n in pair)):
            remedy = f"give [host, resonator] in the cell of the plane, 1 to {dofs}; host 0 is the ground"
            self.problems.append(Problem("contacts.pair", pair, remedy))
            return [0, 1]
        if offset[0] not in (0, 1) or (pair[0] == 0 and any(offset)):
            remedy = "i is 0 or 1 (name the other mass as the host), and a contact with the ground has none"
            self.problems.append(Problem("contacts.offset", offset, remedy))
        row = cell[1] + offset[1]
        if self.is_ring:
            row = (row - 1) % self.shape[1] + 1
        if not 1 <= row <= self.shape[1]:
            remedy = f"the resonator of the contact at {list(cell)} lies beyond the edge"
            self.problems.append(Problem("contacts.offset", offset, remedy))
        return [self.number(cell[1], pair[0]), self.number(row, pair[1])]

    def of_defects(self, defects: list[DefectTable], edges: Any) -> dict[str, list[float]]:
        """Return the profiles along the strip, by the name of the quantity in the wide cell."""
        profiles: dict[str, list[float]] = {}
        for number, defect in enumerate(defects, 1):
            at = f"lattice.strip.defects[{number}]"
            if (defect.value is None) == (defect.factor is None):
                self.problems.append(Problem(at, None, "give either value or factor"))
                continue
            cells = self.cells(defect.places, f"{at}.places")
            names = list(self._names(defect, cells, edges))
            if not names:
                remedy = (
                    f"the cell of the plane has {len(self.plane.masses)} masses and {len(self.plane.springs)} springs"
                )
                remedy += ", of which those across a free edge are cut; motion in the plane: masses only"
                self.problems.append(Problem(f"{at}.quantity", defect.quantity, remedy))
            for name, i, usual in names:
                values = profiles.setdefault(name, [usual] * self.shape[0])
                values[i - 1] = defect.value if defect.value is not None else values[i - 1] * (defect.factor or 0.0)
        return profiles

    def _names(self, defect: DefectTable, cells: list[tuple[int, int]], edges: Any) -> Iterator[tuple[str, int, float]]:
        """Yield each quantity of a ``defect``: its name in the wide cell, its cell along the strip, its value."""
        number = int(defect.quantity.partition("[")[2].partition("]")[0])
        if defect.quantity.startswith("masses") and number <= len(self.plane.masses):
            for i, j in cells:
                for component in range(self.plane.components):
                    degree = self.plane.components * (number - 1) + component + 1
                    yield f"masses[{self.number(j, degree)}]", i, self.plane.masses[number - 1]
        elif defect.quantity.startswith("springs") and number <= len(self.plane.springs) and not self.plane.in_plane:
            spring = self.plane.springs[number - 1]
            owners = self.plane.owners(self.shape[1], edges)
            for i, j in cells:
                # A spring to the cell before belongs to that cell in the chain.
                cell = i + min(spring.offset[0], 0)
                for wide, owner in enumerate(owners, 1):
                    if owner == (number - 1, j - 1) and cell >= 1:
                        yield f"springs[{wide}].stiffness", cell, spring.stiffness


def _keys_at(key: str) -> tuple[str, ...]:
    """Return the keys that name places in the table with the path ``key``."""
    return OF_A_STRIP[key.partition(".")[0]]


def without_strip(table: Table) -> Iterator[Problem]:
    """Yield problems of keys that name places in a case that has no strip: their types, or that they are there."""
    remedy = "names places of a strip; give [lattice.strip], or cells"
    for at, one in _placed_tables(table):
        for key in _keys_at(at):
            # A key of a resolved case that is not given is None.
            if one.get(key) is not None:
                _, mistyped = read_section(Named, {key: one[key]}, at)
                yield from mistyped or [Problem(f"{at}.{key}", None, remedy)]


def _placed_tables(table: Table) -> Iterator[tuple[str, Table]]:
    """Yield the tables of a case that may name places, by the paths of their keys."""
    for key in ("drive", "initial"):
        section = table.get(key)
        if isinstance(section, dict):
            yield key, section
            more = section.get("more")
            for number, one in enumerate(more if isinstance(more, list) else [], 1):
                if isinstance(one, dict):
                    yield f"{key}.more[{number}]", one
    contacts = table.get("contacts")
    if isinstance(contacts, dict):
        yield "contacts", contacts
    for path, _, one in _in_lists(table):
        yield path, one


def translated(table: Table, placing: Placing) -> Table:
    """Return ``table`` with the places of drives, struck masses, contacts and points in terms of the chain."""
    table = dict(table)
    for key in ("drive", "initial"):
        if isinstance(table.get(key), dict):
            table[key] = placing.of_drives(table[key], key)
    if isinstance(table.get("contacts"), dict):
        table["contacts"] = placing.of_contacts(table["contacts"])
    placed = {path: placing.spread(one, path)[0] for path, _, one in _in_lists(table)}
    if placed:
        # Entries of lists deep in the table, which stays as it is.
        table = copy.deepcopy(table)
        for path, keys, _ in _in_lists(table):
            keys[int(path.rpartition("[")[2][:-1]) - 1] = placed[path]
    return table


def _in_lists(table: Table) -> Iterator[tuple[str, list[Any], Table]]:
    """Yield the path of each point and sensor of a case, the list that it is in, and its table."""

    def tables(owner: Any, key: str, path: str) -> Iterator[tuple[str, list[Any], Table]]:
        entries = owner.get(key) if isinstance(owner, dict) else None
        if not isinstance(entries, list):
            return
        for number, one in enumerate(entries, 1):
            if isinstance(one, dict):
                yield f"{path}.{key}[{number}]", entries, one

    yield from tables(table.get("output"), "points", "output")
    for path, _, record in tables(table.get("identify"), "records", "identify"):
        yield from tables(record, "sensors", path)


def for_all(table: Table, masses: int, springs: int) -> Table:
    """Return a ``table`` by quantity in which a key with ``[*]`` stands for every mass, or every spring, of a cell."""
    spread: Table = {}
    for key, value in table.items():
        if isinstance(key, str) and "[*]" in key:
            count = springs if key.startswith("springs") else masses
            spread |= {key.replace("[*]", f"[{number}]"): value for number in range(1, count + 1)}
        else:
            spread[key] = value
    return spread
