"""Lattices of the zoo as SciPy integrates them: matrices, stops and forces by the tables, not by the package."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from tests.independent_lattice import CurvedSpring, ScipyLattice, Stop

# What the equations below know. A case with another key is none that they describe.
KNOWN = {
    "lattice": {"cells", "cell", "ends", "damping", "profiles"},
    "contacts": {"law", "exponent", "stiffness", "sites", "clearance", "clearance_minus", "restitution", "side"}
    | {"pair", "next_cell", "each"},
    "drive": {"cell", "mass", "end", "frequency", "amplitude", "cycles", "more"},
    "initial": {"kind", "cell", "mass", "velocity"},
    "time": {"end", "samples", "rtol", "engine"},
}
EXPONENTS = {"bilinear": 1.0, "hertz": 1.5, "power": None}  # that of "power" is a key


def is_known(table: dict[str, Any]) -> bool:
    """Return whether the equations here are those of a case."""
    if not all(set(section) <= KNOWN.get(name, set()) for name, section in table.items()):
        return False
    if table.get("initial", {}).get("kind", "velocity") != "velocity":
        return False
    if "loss" in table["lattice"].get("damping", {}):
        return False
    contacts = table["contacts"]
    return contacts["law"] in EXPONENTS and set(contacts.get("each", {})) <= {"stiffness", "restitution", "pair"}


class Rows:
    """Rows (mass,) that give relative displacements of masses, numbered cell by cell."""

    def __init__(self, table: dict[str, Any]) -> None:
        self.cells = table["lattice"]["cells"]
        self.per_cell = len(table["lattice"]["cell"]["masses"])
        self.ends = table["lattice"].get("ends", "fixed")

    def number(self, cell: int, mass: int) -> int | None:
        """Return the number of a ``mass`` (from 1) of a ``cell`` (from 1), or None for the ground or a wall."""
        if mass == 0:
            return None
        if self.ends == "periodic":
            cell = (cell - 1) % self.cells + 1
        if not 1 <= cell <= self.cells:
            return None
        return (cell - 1) * self.per_cell + mass - 1

    def of_spring(self, spring: dict[str, Any], cell: int) -> np.ndarray | None:
        """Return the row of the elongation of a ``spring`` of a ``cell``, or None if the lattice ends before it."""
        ahead = int(spring.get("next_cell", False))
        start = self.number(cell, spring["start"])
        end = self.number(cell + ahead, spring["end"])
        if ahead and self.ends == "free" and (start is None or end is None):
            return None
        row = np.zeros(self.cells * self.per_cell)
        if start is not None:
            row[start] -= 1
        if end is not None:
            row[end] += 1
        return row


def values_of(profile: Any, cells: int, common: float) -> np.ndarray:
    """Return the values (cell,) of a quantity by its ``profile``, which may leave cells with the ``common`` value."""
    if isinstance(profile, list):
        return np.array(profile, float)
    if "cells" in profile:
        values = np.full(cells, common)
        values[np.array(profile["cells"]) - 1] = profile["value"]
        return values
    return np.linspace(profile["first"], profile["last"], cells)


def springs_of(table: dict[str, Any], rows: Rows) -> Iterator[tuple[np.ndarray, dict[str, float]]]:
    """Yield the row of each spring and its coefficients; a spring from the left wall is that of the reference cell."""
    profiles = table["lattice"].get("profiles", {})
    for number, spring in enumerate(table["lattice"]["cell"].get("springs", []), 1):
        reference = {name: spring.get(name, 0.0) for name in ("stiffness", "damping", "quadratic", "cubic")}
        first = 1
        if spring.get("next_cell") and rows.ends == "fixed":
            first = 0
        for cell in range(first, rows.cells + 1):
            row = rows.of_spring(spring, cell)
            if row is None:
                continue
            own = dict(reference)
            for name in reference:
                profile = profiles.get(f"springs[{number}].{name}")
                if profile is not None and cell:
                    own[name] = values_of(profile, rows.cells, reference[name])[cell - 1]
            yield row, own


def stops_of(table: dict[str, Any], rows: Rows) -> Iterator[Stop]:
    """Yield the stops of all sites, of which one may have two."""
    contacts = table["contacts"]
    each = contacts.get("each", {})

    def of_site(name: str, number: int, default: Any) -> Any:
        value = each.get(name, contacts.get(name, default))
        is_list = name in each or (name.startswith("clearance") and isinstance(value, list))
        return value[number] if is_list else value

    for number, cell in enumerate(contacts["sites"]):
        host, resonator = of_site("pair", number, table["lattice"]["cell"].get("contact"))
        clearance = of_site("clearance", number, None)
        gaps = {"plus": clearance, "minus": of_site("clearance_minus", number, clearance)}
        for name, side in (("plus", 1), ("minus", -1)):
            if of_site("side", number, "both") not in (name, "both"):
                continue
            ground = rows.number(cell, host)
            yield Stop(
                resonator=rows.number(cell + int(of_site("next_cell", number, False)), resonator),
                host=-1 if ground is None else ground,
                gap=gaps[name],
                stiffness=of_site("stiffness", number, None),
                exponent=contacts.get("exponent", EXPONENTS[of_site("law", number, None)]),
                restitution=of_site("restitution", number, 1.0),
                side=side,
            )


def weights_of(table: dict[str, Any], rows: Rows, drive: dict[str, Any]) -> np.ndarray:
    """Return forces (mass,) by a drive of the amplitude 1: 1 N on a mass, or what springs to a moved wall pull."""
    weights = np.zeros(rows.cells * rows.per_cell)
    if "end" not in drive:
        weights[rows.number(drive["cell"], drive.get("mass", 1))] = 1.0
        return weights
    for spring in table["lattice"]["cell"]["springs"]:
        if not spring.get("next_cell"):
            continue
        place = rows.number(1, spring["end"])
        if drive["end"] == "right":
            place = rows.number(rows.cells, spring["start"])
        weights[place] += spring["stiffness"]
    return weights


def force_of(table: dict[str, Any], rows: Rows) -> Callable[[float], np.ndarray]:
    """Return the forces (mass,) in N of all bursts as a function of time."""
    drives = []
    if "drive" in table:
        drives = [table["drive"], *table["drive"].get("more", [])]

    def force(t: float) -> np.ndarray:
        total = np.zeros(rows.cells * rows.per_cell)
        for drive in drives:
            phase = drive["frequency"] * t
            if phase < 2 * np.pi * drive["cycles"]:
                size = drive["amplitude"] * (1 - np.cos(phase / drive["cycles"])) * np.sin(phase)
                total += size * weights_of(table, rows, drive)
        return total

    return force


def lattice_by_scipy(table: dict[str, Any]) -> ScipyLattice:
    """Return the lattice of the case in ``table``, whose masses are numbered cell by cell."""
    rows = Rows(table)
    lattice = table["lattice"]
    masses = np.tile(np.array(lattice["cell"]["masses"], float), (rows.cells, 1))
    for mass in range(rows.per_cell):
        profile = lattice.get("profiles", {}).get(f"masses[{mass + 1}]")
        if profile is not None:
            masses[:, mass] = values_of(profile, rows.cells, masses[0, mass])
    masses = masses.ravel()

    rayleigh = lattice.get("damping", {})
    grounding = np.tile(lattice["cell"].get("grounding", np.zeros(rows.per_cell)), rows.cells)
    damping = np.diag(grounding + rayleigh.get("mass", 0.0) * masses)
    stiffness = np.zeros_like(damping)
    curved = []
    for row, spring in springs_of(table, rows):
        stiffness += spring["stiffness"] * np.outer(row, row)
        damping += (spring["damping"] + rayleigh.get("stiffness", 0.0) * spring["stiffness"]) * np.outer(row, row)
        if spring["quadratic"] or spring["cubic"]:
            curved.append(CurvedSpring(row, spring["quadratic"], spring["cubic"]))
    return ScipyLattice(masses, stiffness, damping, tuple(stops_of(table, rows)), force_of(table, rows), tuple(curved))


def motion_by_scipy(name: str, table: dict[str, Any], samples: int) -> tuple[np.ndarray, int]:
    """Return displacements (sample, cell, mass) in m of the case in ``table``, and the number of impacts in it.

    Every tenth of the case's ``samples`` is returned, from the reference of that ``name``.
    """
    rows = Rows(table)
    size = rows.cells * rows.per_cell
    velocity = np.zeros(size)
    if "initial" in table:
        initial = table["initial"]
        velocity[rows.number(initial["cell"], initial["mass"])] = initial["velocity"]
    times = np.linspace(0, table["time"]["end"], samples)[::10]
    reference = "zoo-" + name.replace(" ", "-")
    motion, impacts = lattice_by_scipy(table).recorded_motion(reference, times, np.zeros(size), velocity, start=0.0)
    return motion[0].reshape(len(times), rows.cells, rows.per_cell), impacts
