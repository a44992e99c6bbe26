"""Scatter of a case's numbers: the section ``[disorder]``, from which values are drawn that the resolved case holds.

A resolved case has these values in place of the section: whatever is made of it does not know that they were drawn, and
a run tells what was simulated. Each quantity has a generator of its own (Philox), keyed by the seed and its name: the
same numbers on any number of ranks, in any order, beside any other quantity.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from vipetsc.case.case_file import Problem, Section, Table
from vipetsc.case.contacts import lists_of, values_of_sites
from vipetsc.case.inhomogeneity_sections import Deviation
from vipetsc.case.schema import CONTACTS, LatticeTable
from vipetsc.case.sites import ContactsTable
from vipetsc.lattice import UnitCell

SEED = "disorder.seed"


class DisorderTable(Section):
    """What scatters about the values of the case, and the ``seed`` of what is drawn.

    Of every site: ``clearance`` (m), ``restitution``, ``sites`` (the cell, rounded), ``stiffness`` (N/m^n) if it is a
    list, which else is that of all sites, as ``modulus`` (Pa) is. Of the cell, the same in all cells: ``masses`` (kg),
    ``springs`` (N/m).
    Of every cell by itself: ``cells``, by quantity; the resolved case keeps these as they are said.
    """

    seed: Annotated[int, Field(ge=0)] = 0
    clearance: Deviation | None = None
    sites: Deviation | None = None
    restitution: Deviation | None = None
    stiffness: Deviation | None = None
    modulus: Deviation | None = None
    masses: Deviation | None = None
    springs: Deviation | None = None
    cells: dict[str, Deviation] | None = None

    def quantities(self) -> dict[str, Deviation]:
        """What scatters, by name."""
        names = type(self).model_fields.keys() - {"seed", "cells"}
        return {name: getattr(self, name) for name in type(self).model_fields if name in names and getattr(self, name)}


def values_of(lattice: LatticeTable, contacts: ContactsTable) -> dict[str, Sequence[float]]:
    """The quantities of a resolved case by name, those it has not empty; ``modulus`` is what is proportional to it."""
    cell, sites, clearance = lattice.unit_cell(), contacts.sites, contacts.clearance
    assert isinstance(sites, list) and isinstance(clearance, list)
    each = lists_of(contacts)
    stiffness = each.get("stiffness") or ([contacts.stiffness] if contacts.stiffness else [])
    of_sites: dict[str, Sequence[float]] = {"clearance": clearance, "sites": sites}
    of_law = {"restitution": values_of_sites(contacts, "restitution", len(sites)), "stiffness": stiffness}
    of_law["modulus"] = [contacts.stiffness] if contacts.stiffness else []
    return of_sites | of_law | {"masses": cell.masses, "springs": [spring.stiffness for spring in cell.springs]}


def scatter(
    tables: dict[str, Table], disorder: DisorderTable, lattice: LatticeTable, contacts: ContactsTable
) -> tuple[dict[str, Table], list[Problem]]:
    """The resolved ``tables`` of a run with what ``disorder`` draws, and the problems of that.

    ``lattice`` and ``contacts`` are the sections before they were resolved. A drive and times that follow from the
    cell are those of the case without scatter.
    """
    law, problems, drawn = dict(tables["contacts"]), list[Problem](), dict[str, list[float]]()
    known = values_of(lattice, ContactsTable(**law))
    known["modulus"] = [contacts.modulus] if contacts.modulus and known["stiffness"] else []
    for name, deviation in disorder.quantities().items():
        key, values = f"disorder.{name}", np.asarray(known[name], float)
        if name == "sites" and deviation.relative:
            problems.append(Problem(key, deviation.model_dump(exclude_none=True), "give absolute, in cells"))
        elif not values.size:
            problems.append(Problem(key, None, "the case has none that could scatter"))
        elif deviation.relative or deviation.absolute:  # none leaves the case as it is, to the last bit
            new = deviation.draw(values, disorder.seed, name)
            if (wrong := ~(new * values > 0) & (new != values)).any():
                numbers = [float(f"{x:.4g}") for x in new[wrong]]
                remedy = (
                    f"drawn with seed {disorder.seed}, but a sign cannot change: take a smaller deviation, or lognormal"
                )
                problems.append(Problem(key, numbers, remedy))
            drawn[name] = new.tolist()
    if disorder.cells and not problems:
        scattered = {key: deviation.model_dump(exclude_none=True) for key, deviation in disorder.cells.items()}
        tables = tables | {"lattice": tables["lattice"] | {"scatter": {"seed": disorder.seed, "quantities": scattered}}}
    if problems or not drawn:
        empty = Problem(
            "disorder", disorder.seed, "names nothing that scatters, as in: clearance = { relative = 0.01 }"
        )
        return tables, problems if disorder.quantities() or disorder.cells else [empty]
    law |= {name: drawn[name] for name in ("clearance",) if name in drawn}
    of_each = law.get("each", {})
    for name in [name for name in ("restitution", "stiffness") if name in drawn]:
        if name in of_each or len(drawn[name]) > 1:
            of_each = law["each"] = of_each | {name: drawn[name]}
        else:
            law[name] = drawn[name][0]
    if "sites" in drawn:
        law["sites"] = np.rint(drawn["sites"]).astype(int).tolist()
    if "modulus" in drawn and contacts.modulus:
        law["stiffness"] *= drawn["modulus"][0] / contacts.modulus
    tables = tables | {"contacts": law}
    if drawn.keys() & {"masses", "springs"}:
        tables["lattice"] = with_cell(tables["lattice"], lattice.undamped_cell(), drawn)
        if lattice.preset and "stiffness" in law:
            law.setdefault("radius", CONTACTS["radius"])
    return tables, []


def with_cell(lattice: Table, cell: UnitCell, drawn: Mapping[str, list[float]]) -> Table:
    """The table ``lattice`` with a cell of its own: ``cell`` with the masses (kg) and springs (N/m) ``drawn``."""
    stiffness: list[float] = drawn.get("springs", [spring.stiffness for spring in cell.springs])
    springs: list[dict[str, Any]] = [
        {"start": s.start + 1, "end": s.end + 1, "stiffness": k, "next_cell": s.next_cell}
        | {key: getattr(s, key) for key in ("damping", "quadratic", "cubic") if getattr(s, key)}
        for s, k in zip(cell.springs, stiffness, strict=True)
    ]
    table = {"masses": drawn.get("masses", list(cell.masses)), "springs": springs}
    rest = {key: value for key, value in lattice.items() if key not in ("preset", "lambda", "eta")}
    table |= {"grounding": list(cell.grounding)} if cell.grounding else {}
    return rest | {"cell": table | {"contact": [cell.host + 1, cell.resonator + 1]}}
