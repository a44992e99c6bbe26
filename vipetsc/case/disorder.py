"""Random scatter of a case: the section ``[disorder]``, whose drawn values the resolved case contains.

A resolved case has these values in place of the section, so it states what was simulated, and no later step needs the
draw. Each quantity has its own generator (Philox), keyed by the seed and its name: the numbers do not depend on the
number of ranks, on the order of the draws or on the other quantities.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from vipetsc.case.case_file import Problem, Section, Table
from vipetsc.case.contacts import lists_of, values_of_sites
from vipetsc.case.inhomogeneity_sections import Deviation
from vipetsc.case.schema import CONTACTS, LatticeTable
from vipetsc.case.section import described
from vipetsc.case.sites import ContactsTable
from vipetsc.lattice import Spring, UnitCell

SEED = "disorder.seed"
# The numbers of a spring besides its stiffness: its dashpot and the terms of its nonlinear force.
SPRING_PARAMETERS = tuple(field.name for field in fields(Spring) if isinstance(field.default, float))


class DisorderTable(Section):
    """Quantities that scatter about the values of the case, and the ``seed`` of the random numbers.

    For each site: ``clearance`` (m), that of each side by itself if there is a ``clearance_minus``, ``restitution``,
    ``sites`` (the cell, rounded), ``stiffness`` (N/m^n) if it is a list; otherwise it is common to all sites, as
    ``modulus`` (Pa) is. The same in all cells: ``masses`` (kg), ``springs`` (N/m).
    For each cell: ``cells``, by quantity; the resolved case contains the request instead of the values.
    """

    seed: Annotated[int, Field(ge=0)] = described("seed of the random numbers", 0)
    clearance: Deviation | None = described("scatter of each site's clearance", None)
    sites: Deviation | None = described("scatter of each site's cell, rounded to a cell", None)
    restitution: Deviation | None = described("scatter of each site's restitution", None)
    stiffness: Deviation | None = described("scatter of the contact stiffness of all sites", None)
    modulus: Deviation | None = described("scatter of Young's modulus of all contacts", None)
    masses: Deviation | None = described("scatter of the cell's masses, the same in all cells", None)
    springs: Deviation | None = described("scatter of the cell's springs, the same in all cells", None)
    cells: dict[str, Deviation] | None = described(
        'scatter that differs from cell to cell, by quantity, as "masses[2]" = { relative = 0.01 }', None
    )

    def quantities(self) -> dict[str, Deviation]:
        """Deviations of the scattered quantities except those of ``cells``, by name."""
        deviations = {}
        for name in type(self).model_fields:
            given = getattr(self, name)
            if isinstance(given, Deviation):
                deviations[name] = given
        return deviations


def values_of(lattice: LatticeTable, contacts: ContactsTable) -> dict[str, Sequence[float]]:
    """The values of each quantity of a resolved case, by its name; empty if the case has none.

    Those of ``modulus`` are the stiffnesses of the contacts, which are proportional to it.
    """
    cell = lattice.unit_cell()
    sites = contacts.sites
    clearance = contacts.clearance
    assert isinstance(sites, list) and isinstance(clearance, list)
    stiffness = lists_of(contacts).get("stiffness", [])
    if not stiffness and contacts.stiffness:
        stiffness = [contacts.stiffness]

    clearance_minus = lists_of(contacts).get("clearance_minus", [])
    if not clearance_minus and contacts.clearance_minus is not None:
        clearance_minus = [contacts.clearance_minus] * len(sites)

    return {
        "clearance": clearance,
        "clearance_minus": clearance_minus,
        "sites": sites,
        "restitution": values_of_sites(contacts, "restitution", len(sites)),
        "stiffness": stiffness,
        "modulus": stiffness,
        "masses": cell.masses,
        "springs": [spring.stiffness for spring in cell.springs],
    }


def scatter(
    sections: Mapping[str, Any], disorder: DisorderTable, given: ContactsTable
) -> tuple[dict[str, Table], list[Problem]]:
    """The tables of the resolved ``sections`` of a run that change by what ``disorder`` draws, and its problems.

    ``given`` are the contacts before they were resolved. A drive and times that follow from the cell are those of the
    case without scatter.
    """
    lattice = sections["lattice"]
    contacts = sections["contacts"]
    if not (disorder.quantities() or disorder.cells):
        remedy = "contains no quantity that scatters; give one, as in: clearance = { relative = 0.01 }"
        return {}, [Problem("disorder", disorder.seed, remedy)]

    # A resolved case has no modulus: one that is drawn scales the stiffnesses, which are proportional to it. Where each
    # site has a modulus of its own, none holds for all sites.
    values = values_of(lattice, contacts)
    values["modulus"] = []
    if given.modulus and values["stiffness"] and "modulus" not in lists_of(given):
        values["modulus"] = [given.modulus]
    drawn, problems = _draw(disorder, values)
    if problems:
        return {}, problems

    changed: dict[str, Table] = {}
    table: Table = lattice.model_dump(by_alias=True, exclude_none=True)
    # Cells are drawn when the lattice is built, so that the text of a case need not have a million numbers.
    if disorder.cells:
        quantities = {key: deviation.model_dump(exclude_none=True) for key, deviation in disorder.cells.items()}
        table["scatter"] = {"seed": disorder.seed, "quantities": quantities}
        changed["lattice"] = table
    if drawn:
        changed["contacts"] = _drawn_contacts(contacts, drawn, given.modulus)
    if drawn.keys() & {"masses", "springs"}:
        # The undamped cell: [lattice.damping] stays in the table and is added to the drawn cell.
        changed["lattice"] = with_cell(table, lattice.undamped_cell(), drawn)
        # A cell that is written out has no preset, from which the radius would follow.
        if lattice.preset and "stiffness" in changed["contacts"]:
            changed["contacts"].setdefault("radius", CONTACTS["radius"])
    return changed, []


def with_drawn(
    read: Callable[[Table], tuple[dict[str, Any], list[Problem]]],
    resolved: dict[str, Any],
    disorder: DisorderTable,
    given: ContactsTable,
) -> tuple[dict[str, Any], list[Problem]]:
    """The ``resolved`` sections with the values that ``disorder`` draws, checked as ``read`` reads a case's table.

    ``given`` are the contacts before they were resolved.
    """
    drawn, problems = scatter(resolved, disorder, given)
    if problems or not drawn:
        return resolved, problems

    # Drawn values may be out of bounds: they are checked as those of a file are.
    tables = {name: section.model_dump(by_alias=True, exclude_none=True) for name, section in resolved.items()}
    sections, problems = read(tables | drawn)
    # The file does not have these values: the message names the seed that drew them.
    return sections, [replace(p, key=f"{SEED} = {disorder.seed} draws {p.key}") for p in problems]


def _draw(
    disorder: DisorderTable, values: Mapping[str, Sequence[float]]
) -> tuple[dict[str, list[float]], list[Problem]]:
    """Numbers drawn of each quantity about its ``values``, and the problems with them."""
    drawn: dict[str, list[float]] = {}
    problems: list[Problem] = []
    quantities = disorder.quantities()
    if "clearance" in quantities and values["clearance_minus"]:
        # The stops on the two sides are machined one by one, so that their clearances scatter independently.
        quantities["clearance_minus"] = quantities["clearance"]
    for name, deviation in quantities.items():
        key = f"disorder.{name.removesuffix('_minus')}"
        about = np.asarray(values[name], float)
        if name == "sites" and deviation.relative:
            problems.append(Problem(key, deviation.model_dump(exclude_none=True), "give `absolute`, in cells"))
        elif not about.size:
            problems.append(Problem(key, None, "the case has none that could scatter"))
        # A deviation of 0 draws nothing and leaves the case as it is, to the last bit.
        elif deviation.relative or deviation.absolute:
            new = deviation.draw(about, disorder.seed, name)
            # The condition is negated, so that it is true of NaN, the lognormal scatter of a 0.
            changes_sign = ~(new * about > 0) & (new != about)
            if changes_sign.any():
                numbers = [float(f"{x:.4g}") for x in new[changes_sign]]
                remedy = "but its sign must not change: use a smaller deviation, or lognormal"
                problems.append(Problem(key, numbers, f"drawn with seed {disorder.seed}, {remedy}"))
            drawn[name] = new.tolist()
    return drawn, problems


def _drawn_contacts(contacts: ContactsTable, drawn: Mapping[str, list[float]], modulus: float | None) -> Table:
    """The table of resolved ``contacts`` with the ``drawn`` numbers; a modulus in Pa is drawn about ``modulus``."""
    table: Table = contacts.model_dump(by_alias=True, exclude_none=True)
    if "clearance" in drawn:
        table["clearance"] = drawn["clearance"]

    # Numbers that differ from site to site are lists; one number stays that of all.
    for name in ("clearance_minus", "restitution", "stiffness"):
        if name not in drawn:
            continue
        if name in table.get("each", {}) or len(drawn[name]) > 1:
            table["each"] = table.get("each", {}) | {name: drawn[name]}
        else:
            table[name] = drawn[name][0]

    if "sites" in drawn:
        table["sites"] = np.rint(drawn["sites"]).astype(int).tolist()
    if "modulus" in drawn and modulus:
        ratio = drawn["modulus"][0] / modulus
        # Sites with radii or Poisson ratios of their own have a list of stiffnesses, beside the one of all.
        if "stiffness" in table:
            table["stiffness"] *= ratio
        if "stiffness" in table.get("each", {}):
            table["each"]["stiffness"] = [ratio * stiffness for stiffness in table["each"]["stiffness"]]
    return table


def with_cell(lattice: Table, cell: UnitCell, drawn: Mapping[str, list[float]]) -> Table:
    """The table ``lattice`` with a cell of its own: ``cell`` with the masses (kg) and springs (N/m) ``drawn``."""
    stiffness = drawn.get("springs", [spring.stiffness for spring in cell.springs])
    springs: list[Table] = []
    for spring, value in zip(cell.springs, stiffness, strict=True):
        table = {"start": spring.start + 1, "end": spring.end + 1, "stiffness": value, "next_cell": spring.offset > 0}
        # All other parameters of the spring too: a spring without one of them would be another.
        for key in SPRING_PARAMETERS:
            if parameter := getattr(spring, key):
                table[key] = parameter
        springs.append(table)

    cell_table: Table = {"masses": drawn.get("masses", list(cell.masses)), "springs": springs}
    if cell.grounding:
        cell_table["grounding"] = list(cell.grounding)
    cell_table["contact"] = [cell.host + 1, cell.resonator + 1]
    # Without the preset and its parameters, which would contradict the cell.
    kept_keys = {key: value for key, value in lattice.items() if key not in ("preset", "lambda", "eta")}
    return kept_keys | {"cell": cell_table}
