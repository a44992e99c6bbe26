"""Random scatter of a case: the section ``[disorder]``, whose drawn values the resolved case contains.

A resolved case has these values in place of the section, so it states what was simulated, and no later step needs the
draw. Each quantity has its own generator (Philox), keyed by the seed and its name: the numbers do not depend on the
number of ranks, on the order of the draws or on the other quantities.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field, create_model

from vipetsc.case.contacts import lists_of
from vipetsc.case.inhomogeneity_sections import Deviation, ScatterTable
from vipetsc.case.quantities import QUANTITIES, Quantity, Sections, differs_by_side
from vipetsc.case.reading import Table
from vipetsc.case.schema import LatticeTable
from vipetsc.case.section import Problem, Section, described
from vipetsc.case.sites import ContactsTable

SEED = "disorder.seed"
# The amplitude is that of one experiment, and the clearance of each side scatters with ``clearance``.
SCATTERED: Mapping[str, Quantity] = {
    quantity.scattered_as or name: quantity
    for name, quantity in QUANTITIES.items()
    if name not in ("amplitude", "clearance_minus")
}
"""Quantities of ``QUANTITIES`` that scatter, by their keys."""
OF_SITES = {
    "sites": "scatter of each site's cell, rounded to a cell",
    "modulus": "scatter of Young's modulus of all contacts",
}
"""What scatters besides: choices from which the numbers of a resolved case follow."""

if TYPE_CHECKING:
    # For the type checker, which does not see keys that are created at run time.
    class ScatteredQuantities(Section):
        """The deviation of each quantity that scatters."""

else:
    ScatteredQuantities = create_model(
        "ScatteredQuantities",
        __base__=Section,
        **{
            key: (Deviation | None, described(text, None))
            for key, text in {
                **{key: f"scatter of {quantity.text}" for key, quantity in SCATTERED.items()},
                **OF_SITES,
            }.items()
        },
    )


class DisorderTable(ScatteredQuantities):
    """Quantities that scatter about the values of the case, and the ``seed`` of the random numbers.

    A clearance scatters on each side by itself if there is a ``clearance_minus``; a ``stiffness`` that all sites have
    in common scatters as one number, as the ``modulus`` does. Masses and springs are the same in all cells; those that
    differ from cell to cell are in ``cells``, of which the resolved case contains the request instead of the values.
    """

    seed: Annotated[int, Field(ge=0)] = described("seed of the random numbers", 0)
    cells: dict[str, Deviation] | None = described(
        'scatter that differs from cell to cell, by quantity, as "masses[2]" = { relative = 0.01 }', None
    )

    def quantities(self) -> dict[str, Deviation]:
        """Return deviations of the scattered quantities except those of ``cells``, by name."""
        deviations = {}
        for name in type(self).model_fields:
            given = getattr(self, name)
            if isinstance(given, Deviation):
                deviations[name] = given
        return deviations


def values_of(sections: Sections) -> dict[str, Sequence[float]]:
    """Return the values of each quantity of a resolved case, by its key in ``[disorder]``; none where it has none.

    Those of ``modulus`` are the stiffnesses of the contacts, which are proportional to it.
    """
    contacts = sections["contacts"]
    values: dict[str, Sequence[float]] = {"sites": contacts.sites, "clearance_minus": []}
    for key, quantity in SCATTERED.items():
        values[key] = [number for number in quantity.numbers(sections) if number is not None]
    if differs_by_side(contacts):
        values["clearance_minus"] = QUANTITIES["clearance_minus"].numbers(sections)
    # One material for all sites scatters as one number.
    if "stiffness" not in lists_of(contacts):
        values["stiffness"] = [contacts.stiffness] if contacts.stiffness else []
    return values | {"modulus": values["stiffness"]}


def scatter(sections: Sections, disorder: DisorderTable, given: ContactsTable) -> tuple[dict[str, Any], list[Problem]]:
    """Return the resolved ``sections`` of a run with what ``disorder`` draws, and its problems.

    ``given`` are the contacts before they were resolved. A drive and times that follow from the cell are those of the
    case without scatter.
    """
    if not (disorder.quantities() or disorder.cells):
        remedy = "contains no quantity that scatters; give one, as in: clearance = { relative = 0.01 }"
        return {}, [Problem("disorder", disorder.seed, remedy)]
    problems = list(_in_plane_problems(sections["lattice"], disorder))
    if problems:
        return {}, problems

    # A resolved case has no modulus: one that is drawn scales the stiffnesses, which are proportional to it. Where each
    # site has a modulus of its own, none holds for all sites.
    values = values_of(sections)
    values["modulus"] = []
    if given.modulus and values["stiffness"] and "modulus" not in lists_of(given):
        values["modulus"] = [given.modulus]
    drawn, problems = _draw(disorder, values)
    if problems:
        return {}, problems

    changed = dict(sections)
    # Cells are drawn when the lattice is built, so that the text of a case need not have a million numbers.
    if disorder.cells:
        request = ScatterTable(seed=disorder.seed, quantities=disorder.cells)
        changed["lattice"] = changed["lattice"].model_copy(update={"scatter": request})
    for key, numbers in drawn.items():
        changed = _put(changed, key, numbers, values[key])
    return changed, []


def _in_plane_problems(lattice: LatticeTable, disorder: DisorderTable) -> Iterator[Problem]:
    """Yield problems with masses and springs that scatter in a strip that moves in the plane."""
    if lattice.cell is None or not lattice.cell.moves_in_plane:
        return
    # A mass of the plane is two of the wide cell, and a spring several.
    remedy = "scatters both components of a mass, and the parts of a spring, one by one in the plane; remove it"
    scattered = [key for key in disorder.quantities() if key in SCATTERED and SCATTERED[key].of != "site"]
    for key in (*scattered, *(["cells"] if disorder.cells else [])):
        yield Problem(f"disorder.{key}", None, remedy)


def _put(sections: dict[str, Any], key: str, drawn: list[float], values: Sequence[float]) -> dict[str, Any]:
    """Return ``sections`` with the numbers ``drawn`` about the ``values`` of the quantity with that ``key``."""
    contacts: ContactsTable = sections["contacts"]
    if key == "sites":
        cells = np.rint(drawn).astype(int).tolist()
        return sections | {"contacts": contacts.model_copy(update={"sites": cells})}
    if key == "clearance_minus":
        return QUANTITIES[key].put(sections, drawn)
    if key != "modulus":
        return SCATTERED[key].put(sections, drawn)

    # Sites with radii or Poisson ratios of their own have a list of stiffnesses, beside the one of all.
    ratio = drawn[0] / values[0]
    update: dict[str, Any] = {}
    if contacts.stiffness is not None:
        update["stiffness"] = contacts.stiffness * ratio
    if contacts.each is not None and contacts.each.stiffness:
        stiffness = [ratio * number for number in contacts.each.stiffness]
        update["each"] = contacts.each.model_copy(update={"stiffness": stiffness})
    return sections | {"contacts": contacts.model_copy(update=update)}


def with_drawn(
    read: Callable[[Table], tuple[dict[str, Any], list[Problem]]],
    resolved: dict[str, Any],
    disorder: DisorderTable,
    given: ContactsTable,
) -> tuple[dict[str, Any], list[Problem]]:
    """Return ``resolved`` sections with the values that ``disorder`` draws, checked as ``read`` reads a case's table.

    ``given`` are the contacts before they were resolved.
    """
    drawn, problems = scatter(resolved, disorder, given)
    if problems or drawn == resolved:
        return resolved, problems

    # Drawn values may be out of bounds: they are checked as those of a file are.
    tables = {name: section.model_dump(by_alias=True, exclude_none=True) for name, section in drawn.items()}
    sections, problems = read(tables)
    # The file does not have these values: the message names the seed that drew them.
    return sections, [replace(p, key=f"{SEED} = {disorder.seed} draws {p.key}") for p in problems]


def _draw(
    disorder: DisorderTable, values: Mapping[str, Sequence[float]]
) -> tuple[dict[str, list[float]], list[Problem]]:
    """Return numbers drawn of each quantity about its ``values``, and the problems with them."""
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
