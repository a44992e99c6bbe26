"""A strip of the plane, ``[lattice.strip]``: it is translated into a chain of wide cells before a case is read.

The cells are numbered (i, j) from 1: i along the strip, as the cells of any lattice, j from row to row. What the strip
writes are masses and springs of ``[lattice.cell]``, in which mass s of row j has the number (j - 1) d + s
(``vipetsc.lattice.plane``); a ``place`` [i, j] or [i, j, s] of a drive, a point or a struck mass becomes its ``cell``
and ``mass``, and places of contacts become ``sites`` with their pairs. So engines and studies know chains alone.
``lattice.cell.from_strip`` keeps the section: pictures need it, and a key of ``[lattice.strip]`` that a sweep gives
replaces that key.
"""

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from vipetsc.case.places import DefectTable, Finite, Pair, Placing, Positive, Vector, for_all, translated, without_strip
from vipetsc.case.reading import Table, read_section
from vipetsc.case.section import Problem, Section, described
from vipetsc.lattice.cell import Spring
from vipetsc.lattice.plane import KINDS, PlaneCell, PlaneSpring

DEFAULT_CELLS = 300
MOST_SPRINGS = 20_000  # of a wide cell: every step goes over all of them, and every result lists them
FILLED = {"masses", "springs", "from_strip"}  # keys of a cell that a strip fills in
OF_A_PRESET = ("mass", "stiffness", "stiffness_across")
OF_ONES_OWN = ("masses", "springs", "vectors", "positions")


class StripSpring(Section):
    """A spring of the plane, from mass ``start`` (0: the ground) to mass ``end`` of the cell ``offset`` further."""

    start: int = described("mass at one end; 0 is the ground", ge=0)
    end: int = described("mass at the other end", ge=1)
    offset: Pair = described("how many cells [i, j] further `end` is; i is -1, 0 or 1", [0, 0])
    stiffness: Finite = described("stiffness", unit="N/m")
    direction: Vector | None = described("direction [x, y] of the spring, for motion in the plane", None)
    damping: Finite = described("constant of a dashpot parallel to the spring", 0.0, unit="N s/m")
    quadratic: Finite = described("coefficient of the elongation squared in the force", 0.0, unit="N/m^2")
    cubic: Finite = described("coefficient of the elongation cubed in the force", 0.0, unit="N/m^3")

    def spring(self) -> PlaneSpring:
        """Return the spring, with 0-based masses and a direction of the length 1."""
        direction = np.array(self.direction or (1.0, 0.0))
        x, y = (direction / np.hypot(*direction)).tolist()
        return PlaneSpring(
            start=self.start - 1,
            end=self.end - 1,
            stiffness=self.stiffness,
            offset=(self.offset[0], self.offset[1]),
            direction=(x, y),
            damping=self.damping,
            quadratic=self.quadratic,
            cubic=self.cubic,
        )


class StripTable(Section):
    """A strip of ``rows`` cells side by side, by the name of its lattice or by the springs of a cell of one's own."""

    rows: int = described("number of cells across the strip", 1, ge=1)
    kind: Literal["square", "triangular", "honeycomb", "cell"] = described(
        "lattice of the plane; cell: masses and springs of one's own", "square"
    )
    edges: Literal["free", "fixed", "periodic"] = described(
        "the two edges along the strip: springs across them are cut, are held, or join the last row to the first",
        "free",
    )
    motion: Literal["out-of-plane", "in-plane"] = described(
        "motion of a mass: one component, or x and y, which are two degrees of freedom", "out-of-plane"
    )
    mass: Positive | None = described("every mass of a lattice by name", None, unit="kg")
    stiffness: Positive | None = described("springs of a lattice by name", None, unit="N/m")
    stiffness_across: Positive | None = described(
        "springs that lead to another row; default: `stiffness`", None, unit="N/m"
    )
    masses: list[Positive] | None = described("cell: masses of a cell of the plane", None, unit="kg", min_length=1)
    springs: list[StripSpring] | None = described("cell: springs of a cell of the plane", None, min_length=1)
    vectors: Annotated[list[Vector], Field(min_length=2, max_length=2)] | None = described(
        "cell: vectors from a cell to the next one along and across, for pictures; default: [[1, 0], [0, 1]]", None
    )
    positions: list[Vector] | None = described("cell: positions of the masses in the cell, for pictures", None)
    defects: list[DefectTable] | None = described(
        "quantities that differ at some places; written to `lattice.profiles`", None
    )

    def plane_cell(self) -> PlaneCell:
        """Return the cell of the plane of a valid section."""
        in_plane = self.motion == "in-plane"
        if self.kind == "cell":
            masses = tuple(self.masses or ())
            vectors = tuple((x, y) for x, y in self.vectors or ([1.0, 0.0], [0.0, 1.0]))
            # Masses without a position lie side by side.
            even = [[s / len(masses), s / len(masses)] for s in range(len(masses))]
            return PlaneCell(
                masses=masses,
                springs=tuple(spring.spring() for spring in self.springs or ()),
                vectors=(vectors[0], vectors[1]),
                positions=tuple((x, y) for x, y in self.positions or even),
                in_plane=in_plane,
            )
        stiffness = self.stiffness or 0.0
        named = KINDS[self.kind](self.mass or 0.0, stiffness, self.stiffness_across or stiffness)
        return PlaneCell(named.masses, named.springs, named.vectors, named.positions, in_plane)

    def place(self, cell: int, mass: int) -> list[int]:
        """Return the place [i, j] of a ``mass`` of a wide ``cell``, both from 1; with the mass if there are several."""
        row, number = divmod(mass - 1, self.plane_cell().dofs)
        place = [cell, row + 1, number + 1]
        return place if self.plane_cell().dofs > 1 else place[:2]

    def problems(self, ends: Any) -> Iterator[Problem]:
        """Yield problems between the keys of the section, in a lattice with these ``ends``."""
        is_given = self.kind == "cell"
        for key in OF_A_PRESET if is_given else OF_ONES_OWN:
            if getattr(self, key) is not None:
                yield Problem(f"lattice.strip.{key}", None, f"does not apply to kind = {self.kind!r}; remove it")
        for key in ("masses", "springs") if is_given else ("mass", "stiffness"):
            if getattr(self, key) is None:
                yield Problem(f"lattice.strip.{key}", None, f"missing; kind = {self.kind!r} needs it")
        if self.motion == "in-plane":
            yield from self._in_plane_problems(ends)
        if not is_given:
            return

        count = len(self.masses or ())
        if self.positions is not None and len(self.positions) != count:
            yield Problem("lattice.strip.positions", None, f"give one position for each of the {count} masses")
        for number, spring in enumerate(self.springs or (), 1):
            at = f"lattice.strip.springs[{number}]"
            if max(spring.start, spring.end) > count:
                yield Problem(at, None, f"the cell has the masses 1 to {count}, and start = 0 is the ground")
            if abs(spring.offset[0]) > 1 or (spring.start == 0 and any(spring.offset)):
                yield Problem(f"{at}.offset", spring.offset, "i is -1, 0 or 1, and a spring to the ground has none")
            if spring.start == spring.end and not any(spring.offset):
                yield Problem(at, None, "joins a mass to itself; give an offset")

    def _in_plane_problems(self, ends: Any) -> Iterator[Problem]:
        """Yield problems with motion in the plane."""
        if self.kind == "square":
            remedy = 'the square lattice does not resist shear; use "triangular", or a cell with diagonals'
            yield Problem("lattice.strip.motion", self.motion, remedy)
        if ends == "free":
            # The matrix of a spring to the next cell has parts within both cells, which a cut would leave.
            remedy = 'ends that are cut would leave parts of the springs; use "fixed" or "periodic"'
            yield Problem("lattice.ends", ends, remedy)
        for number, spring in enumerate(self.springs or (), 1):
            if spring.direction is None or not any(spring.direction):
                yield Problem(f"lattice.strip.springs[{number}].direction", spring.direction, "give [x, y], not both 0")
            if spring.quadratic or spring.cubic:
                remedy = "motion in the plane has linear springs only; remove quadratic and cubic"
                yield Problem(f"lattice.strip.springs[{number}]", None, remedy)


def with_strip(table: Table) -> tuple[Table, list[Problem]]:
    """Return ``table`` with the wide cell of its strip and without places, and the problems with these.

    Without a strip it is the table itself, which must not name places.
    """
    lattice = table.get("lattice")
    # Types are not checked yet.
    cell = lattice.get("cell", {}) if isinstance(lattice, dict) else {}
    given = lattice.get("strip") if isinstance(lattice, dict) else None
    earlier = cell.get("from_strip") if isinstance(cell, dict) else None
    if not isinstance(lattice, dict) or not isinstance(cell, dict) or (given is None and earlier is None):
        return table, list(without_strip(table))
    if not isinstance(given, dict | None) or not isinstance(earlier, dict | None):
        return table, []
    if given is not None and earlier is None and cell.keys() & FILLED:
        return table, [Problem("lattice.strip", None, "give it or the masses and springs of lattice.cell, not both")]

    key = "lattice.cell.from_strip" if given is None else "lattice.strip"
    strip, problems = read_section(StripTable, (earlier or {}) | (given or {}), key)
    problems = problems or list(strip.problems(lattice.get("ends")))
    if problems:
        return table, problems
    cells = lattice.get("cells", DEFAULT_CELLS)
    if type(cells) is not int:
        return table, []  # the type is refused where sections are read
    placing = Placing(strip.plane_cell(), (cells, strip.rows), strip.edges == "periodic")
    # A cell that was written before is kept: scatter, sweeps and fits may have changed its numbers.
    if given is not None:
        lattice, problems = _written(lattice, cell, strip, placing)
    if not problems:
        table = _with_all(table | {"lattice": lattice}, strip, placing)
        problems = placing.problems
    return table, problems


def _written(lattice: Table, cell: Table, strip: StripTable, placing: Placing) -> tuple[Table, list[Problem]]:
    """Return the section ``lattice`` with its ``cell`` and its profiles written by a valid ``strip``."""
    springs = placing.plane.wide_springs(strip.rows, strip.edges)
    if len(springs) > MOST_SPRINGS:
        remedy = f"makes {len(springs)} springs in a wide cell, of at most {MOST_SPRINGS}; use fewer rows"
        return lattice, [Problem("lattice.strip.rows", strip.rows, remedy)]
    filled = {
        "masses": placing.plane.wide_masses(strip.rows),
        "springs": [_spring_table(spring) for spring in springs],
        "from_strip": strip.model_dump(exclude_none=True),
    }
    others = {key: value for key, value in cell.items() if key not in FILLED}
    lattice = {key: value for key, value in lattice.items() if key != "strip"} | {"cell": others | filled}
    profiles = placing.of_defects(strip.defects or [], strip.edges)
    if profiles:
        lattice["profiles"] = (lattice.get("profiles") or {}) | profiles
    return lattice, []


def _with_all(table: Table, strip: StripTable, placing: Placing) -> Table:
    """Return the ``table`` with places translated, and quantities of ``[*]`` given to all masses or springs."""
    cell = table["lattice"]["cell"]
    counts = len(cell.get("masses", ())), len(cell.get("springs", ()))
    table = translated(table, placing)
    profiles = table["lattice"].get("profiles")
    if isinstance(profiles, dict):
        profiles = for_all(profiles, *counts)
        table["lattice"] = table["lattice"] | {"profiles": profiles}
    if strip.motion == "in-plane":
        placing.problems += _unlike_components(cell.get("masses", ()), profiles)
    disorder = table.get("disorder")
    if isinstance(disorder, dict) and isinstance(disorder.get("cells"), dict):
        table["disorder"] = disorder | {"cells": for_all(disorder["cells"], *counts)}
    return table


def _unlike_components(masses: Any, profiles: Any) -> Iterator[Problem]:
    """Yield problems of a mass of the plane that would differ along x and along y, and of single springs."""
    values = masses if isinstance(masses, list) else []
    for number, (x, y) in enumerate(zip(values[::2], values[1::2], strict=False)):
        if x != y:
            remedy = f"masses {2 * number + 1} and {2 * number + 2} are one mass, along x and along y; give both values"
            yield Problem("lattice.cell.masses", [x, y], remedy)
    for key, value in profiles.items() if isinstance(profiles, dict) else ():
        kind, _, index = str(key).rstrip("]").partition("[")
        if kind != "masses" or not index.isdecimal():
            remedy = "a spring of the plane is several of the wide cell; remove it"
            yield Problem(f'lattice.profiles."{key}"', None, remedy)
            continue
        # The other component: 2 of 1, 1 of 2.
        other = f"masses[{((int(index) - 1) ^ 1) + 1}]"
        if profiles.get(other) != value:
            remedy = f"is one mass with {other}, along x and along y: give both, or lattice.strip.defects"
            yield Problem(f'lattice.profiles."{key}"', None, remedy)


def _spring_table(spring: Spring) -> dict[str, Any]:
    """Return the table of a ``spring`` in ``lattice.cell.springs``."""
    table: dict[str, Any] = {
        "start": spring.start + 1,
        "end": spring.end + 1,
        "stiffness": spring.stiffness,
        "next_cell": bool(spring.offset),
    }
    for key in ("damping", "quadratic", "cubic"):
        value = getattr(spring, key)
        if value:
            table[key] = value
    return table
