"""The case of the verb ``nnm``: which system, which branches, how they are followed. No PETSc here."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import tomli_w
from pydantic import Field

from vipetsc.case.checks import sites_of, unit_cell_of
from vipetsc.case.schema import (
    CaseError,
    ContactsTable,
    Finite,
    LatticeTable,
    Positive,
    Problem,
    Section,
    read_section,
    read_toml,
    unknown_key,
    with_overrides,
)

BESIDE = {"drive", "time", "output", "sweep", "design"}
"""Sections of a lattice run that may stand in the same file; ``nnm`` does not read them."""


class LinearSpringTable(Section):
    """A spring between masses ``start`` and ``end`` (1-based; ``start`` 0 is the ground), N/m."""

    start: Annotated[int, Field(ge=0)]
    end: Annotated[int, Field(ge=1)]
    stiffness: Positive


class SmoothSpringTable(Section):
    """Force ``quadratic`` z^2 + ``cubic`` z^3 (N/m^2, N/m^3) between two masses, as in ``LinearSpringTable``."""

    start: Annotated[int, Field(ge=0)]
    end: Annotated[int, Field(ge=1)]
    cubic: Finite = 0.0
    quadratic: Finite = 0.0


class PairTable(Section):
    """A contact between ``host`` (0 is the ground) and ``resonator`` (1-based) with its ``clearance`` in m."""

    host: Annotated[int, Field(ge=0)]
    resonator: Annotated[int, Field(ge=1)]
    clearance: Positive


class SystemTable(Section):
    """A system of one's own: masses in kg, linear and smooth springs, contact pairs (law: ``[contacts]``)."""

    masses: list[Positive] = Field(min_length=1)
    springs: list[LinearSpringTable] = Field(min_length=1)
    smooth: list[SmoothSpringTable] = Field([])
    contacts: list[PairTable] = Field([])


class GuardsTable(Section):
    """Bounds on one step, see ``continuation.Guards``; 0 switches one off."""

    half_trace: Annotated[float, Field(ge=0)] = 0.5
    contacts: Annotated[int, Field(ge=0)] = 1
    corrector: Annotated[float, Field(ge=0)] = 0.05
    turn: Annotated[float, Field(ge=0)] = 0.2


class NnmTable(Section):
    """Nonlinear normal modes.

    ``system``: ``reduced`` (the paper's model of the cell's contact pair), ``chain`` (the lattice with its sites)
    or ``own`` (``[nnm.own]``). ``modes`` are linear modes (1-based, lowest first). ``energy`` in J and
    ``frequency`` in Hz bound the branch; ``direction`` is where energy goes first. ``orbits_at`` lists energies
    in J whose orbits are stored beside those of the regions; ``compare`` corrects every fourth point with other
    flows; ``switch`` follows the branches that cross at these kinds of special points, ``switch_points`` points each.
    """

    system: Literal["reduced", "chain", "own"] = "reduced"
    own: SystemTable | None = None
    modes: list[Annotated[int, Field(ge=1)]] = Field([1, 2], min_length=1)
    map: Literal["auto", "quarter", "half", "whole"] = "auto"
    flow: Literal["compiled", "tsrk", "newmark"] = "compiled"
    jacobian: Literal["variational", "differences"] = "variational"
    chart: Literal["auto", "relative", "logarithmic", "grazing"] = "relative"
    start_energy: Positive | Literal["auto"] = "auto"
    energy: list[Annotated[float, Field(ge=0)]] = Field([0.0, 1e9], min_length=2, max_length=2)
    frequency: list[Annotated[float, Field(ge=0)]] = Field([0.0, 1e9], min_length=2, max_length=2)
    direction: Literal["up", "down", "both"] = "up"
    points: int = Field(20000, ge=1)
    first_step: Positive = 1e-3
    smallest_step: Positive = 1e-13
    largest_step: Positive = 0.1
    tolerance: Positive = 1e-13
    max_newton: int = Field(7, ge=1)
    locate: bool = True
    locate_grazing: bool = True
    orbits_at: list[Positive] = Field([])
    compare: list[Literal["compiled", "tsrk", "newmark"]] = Field([])
    switch: list[Literal["symmetry-breaking", "period-doubling", "branch-point"]] = Field([])
    switch_points: int = Field(100, ge=1)
    switch_amplitude: Positive = 1e-3
    guards: GuardsTable = GuardsTable()


class NnmCase(Section):
    """A case of the verb ``nnm``: sections ``[lattice]``, ``[contacts]`` and ``[nnm]``."""

    name: str
    lattice: LatticeTable
    contacts: ContactsTable
    nnm: NnmTable

    @classmethod
    def load(cls, path: str | Path, overrides: Iterable[str] = ()) -> NnmCase:
        """The case in file ``path`` with ``a.b=value`` overrides; raises CaseError or OSError."""
        return cls.from_table(read_toml(path), overrides, str(path))

    @classmethod
    def from_table(cls, table: dict[str, Any], overrides: Iterable[str] = (), source: str = "case") -> NnmCase:
        """The case of a parsed table; raises CaseError with everything that is wrong."""
        table, problems = with_overrides(table, overrides)
        kinds = {"lattice": LatticeTable, "contacts": ContactsTable, "nnm": NnmTable}
        known = {"name", *kinds, *BESIDE}
        problems += [unknown_key(key, table[key], known) for key in table if key not in known]
        lattice = table.get("lattice", {})
        if isinstance(lattice, dict) and "cell" not in lattice:
            table["lattice"] = {"preset": "four-band"} | lattice
        sections = {}
        for key, kind in kinds.items():
            sections[key], wrong = read_section(kind, table.get(key, {}), key)
            problems += wrong
        name = table.get("name", "case")
        if not isinstance(name, str) or not name:
            problems.append(Problem("name", name, "must be a non-empty string"))
        if not problems:
            problems += _cross_problems(sections["lattice"], sections["contacts"], sections["nnm"])
        if not problems:
            case = cls(name=name, **sections)
            try:
                dofs = _count_dofs(case.lattice, case.nnm)
            except ValueError as error:
                problems.append(Problem("lattice.cell", None, str(error)))
            else:
                beyond = [m for m in case.nnm.modes if m > dofs]
                if not beyond:
                    return case
                problems.append(Problem("nnm.modes", beyond, f"the system has {dofs} modes"))
        raise CaseError(problems, source)

    def to_toml(self) -> str:
        """The resolved case as TOML; reading it back gives the same case."""
        return tomli_w.dumps(self.model_dump(by_alias=True, exclude_none=True))

    def physics(self) -> tuple:
        """What a branch that is resumed must keep: the system, the shooting map and the flow."""
        nnm = self.nnm
        return self.lattice, self.contacts, nnm.system, nnm.own, nnm.map, nnm.flow, nnm.jacobian


def _cross_problems(lattice: LatticeTable, contacts: ContactsTable, nnm: NnmTable) -> list[Problem]:
    problems = []
    if (nnm.system == "own") != (nnm.own is not None):
        problems.append(Problem("nnm.system", nnm.system, 'a system of one\'s own needs "own" and [nnm.own]'))
    elif nnm.own is not None:
        problems += _pair_problems(nnm.own)
    if nnm.own is None and lattice.preset is None and contacts.clearance is None:
        problems.append(Problem("contacts.clearance", None, "is needed (m): the lattice is no preset"))
    for key in ("energy", "frequency"):
        low, high = getattr(nnm, key)
        if not low < high:
            problems.append(Problem(f"nnm.{key}", [low, high], "must be [low, high]"))
    if nnm.direction != "up" and nnm.energy[0] == 0:
        problems.append(Problem("nnm.energy", nnm.energy, "going down needs a lowest energy above 0 (J)"))
    if nnm.smallest_step >= nnm.largest_step:
        problems.append(Problem("nnm.smallest_step", nnm.smallest_step, "must be below nnm.largest_step"))
    if nnm.system == "chain":
        sites = sites_of(lattice, contacts)
        if not sites or any(not 1 <= c <= lattice.cells for c in sites):
            problems.append(Problem("contacts.sites", sites, f"name cells from 1 to {lattice.cells}"))
        if isinstance(contacts.clearance, list) and len(contacts.clearance) != len(sites):
            remedy = f"one clearance for each of the {len(sites)} sites is needed"
            problems.append(Problem("contacts.clearance", contacts.clearance, remedy))
    if nnm.system == "reduced" and isinstance(contacts.clearance, list) and len(contacts.clearance) != 1:
        problems.append(Problem("contacts.clearance", contacts.clearance, "the reduced model has one contact"))
    return problems


def _pair_problems(system: SystemTable) -> list[Problem]:
    """Springs and contacts that do not join two of the system's masses, or one of them and the ground."""
    count = len(system.masses)
    ends = {
        "springs": [(s.start, s.end) for s in system.springs],
        "smooth": [(s.start, s.end) for s in system.smooth],
        "contacts": [(p.host, p.resonator) for p in system.contacts],
    }
    return [
        Problem(f"nnm.own.{key}", list(pair), f"is not a pair of the system's {count} masses (0 is the ground)")
        for key, pairs in ends.items()
        for pair in pairs
        if pair[0] == pair[1] or max(pair) > count
    ]


def _count_dofs(lattice: LatticeTable, nnm: NnmTable) -> int:
    """Degrees of freedom of the system; raises ValueError if the lattice's cell is impossible."""
    if nnm.own is not None:
        return len(nnm.own.masses)
    cell = unit_cell_of(lattice)
    return 2 if nnm.system == "reduced" else lattice.cells * cell.dofs
