"""Parameters that the verb ``identify`` seeks: their sections, their values in a case, and a case with other values."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Annotated, Literal, NamedTuple

import numpy as np

from vipetsc.case.amplitude import drive_unit
from vipetsc.case.case import Case
from vipetsc.case.case_file import Section, Table
from vipetsc.case.contacts import values_of_sites
from vipetsc.case.disorder import with_cell
from vipetsc.case.schema import Range
from vipetsc.case.section import BY_SHAPE, described
from vipetsc.lattice import UnitCell, pass_bands

OF_SITES = ("clearance", "clearance_minus", "stiffness", "exponent", "restitution")
OF_SPRINGS = {"spring": "stiffness", "dashpot": "damping", "quadratic": "quadratic", "cubic": "cubic"}
"""Unknowns that each spring has, and their names in ``vipetsc.lattice.Spring``."""
OF_CELL = ("mass", "grounding", *OF_SPRINGS)
WITHOUT_CONTACT = (*OF_CELL, "amplitude")
"""Unknowns on which a motion depends also without contact."""
OF_EITHER_SIGN = ("quadratic", "cubic")
"""Unknowns that may be negative."""
ON_LINEAR_SCALE = ("restitution", "exponent", *OF_EITHER_SIGN)
"""Unknowns whose coordinate is not the logarithm unless they say so."""
UNITS = {
    "clearance": "m",
    "clearance_minus": "m",
    "stiffness": "N/m^n",
    "mass": "kg",
    "spring": "N/m",
    "quadratic": "N/m^2",
    "cubic": "N/m^3",
    "dashpot": "N s/m",
    "grounding": "N s/m",
}
"""The unit of each unknown; that of an amplitude depends on the drive, and an exponent and a restitution have none."""


class UnknownTable(Section):
    """A ``quantity`` that is sought within ``bounds`` in SI units, from ``start`` on, by default that of the case.

    ``dashpot`` is parallel to a spring, ``grounding`` a dashpot between a mass and the ground; ``quadratic`` and
    ``cubic`` are terms of a spring's force; ``amplitude`` is that of the first drive.
    """

    quantity: Literal[
        "clearance",
        "clearance_minus",
        "stiffness",
        "exponent",
        "restitution",
        "mass",
        "spring",
        "quadratic",
        "cubic",
        "dashpot",
        "grounding",
        "amplitude",
    ] = described("what is sought: of contact sites, of masses or springs of the cell, or the amplitude of the drive")
    bounds: Range = described("lower and upper bound, in SI units")
    of: Annotated[Literal["all", "each"] | list[list[int]], BY_SHAPE] = described(
        "one value for all, one for each, or one for each group of numbers, from 1", "all"
    )
    scale: Literal["logarithmic", "linear"] | None = described(
        "coordinate of the fit; default: linear for restitution, exponent, quadratic and cubic, otherwise logarithmic",
        None,
    )
    start: Annotated[float | list[float], BY_SHAPE] | None = described(
        "value at which the fit begins, or one for each value; default: that of the case", None
    )


class SoughtParameter(NamedTuple):
    """A number that is sought: a ``quantity`` at the ``members`` (sites, masses, springs or records, from 0).

    The coordinate of the fit is its logarithm, or its position between the bounds ``low`` (0) and ``high`` (1).
    """

    name: str
    quantity: str
    members: tuple[int, ...]
    low: float
    high: float
    start: float
    unit: str
    is_logarithmic: bool

    @property
    def acts_without_contact(self) -> bool:
        """Whether the motion depends on the parameter also without contact."""
        return self.quantity in WITHOUT_CONTACT

    def to_coordinate(self, value: float) -> float:
        """The fit's coordinate of a ``value``."""
        if self.is_logarithmic:
            return float(np.log(value))
        return (value - self.low) / (self.high - self.low)

    def from_coordinate(self, z: float) -> float:
        """The value at the fit's coordinate ``z``, kept between the bounds, which rounding may miss."""
        value = self.low + (self.high - self.low) * z
        if self.is_logarithmic:
            # Clipped before the exponential, which would overflow far outside.
            value = np.exp(np.clip(z, np.log(self.low), np.log(self.high)))
        return float(np.clip(value, self.low, self.high))

    def slope(self, z: float) -> float:
        """Derivative of the value by the fit's coordinate at ``z``."""
        if self.is_logarithmic:
            # The derivative of exp(z) is exp(z), the value itself.
            return self.from_coordinate(z)
        return self.high - self.low


def values_of(case: Case, quantity: str) -> list[float]:
    """The values of a ``quantity`` in a case: of its sites, of the masses or springs of its cell, of its drive."""
    # Dashpots as the case lists them: Rayleigh damping would add to them.
    cell = case.lattice.undamped_cell()
    if quantity == "mass":
        return list(cell.masses)
    if quantity in OF_SPRINGS:
        return [getattr(spring, OF_SPRINGS[quantity]) for spring in cell.springs]
    if quantity == "grounding":
        return list(cell.grounding) or [0.0] * len(cell.masses)
    if quantity == "amplitude":
        return [case.drive.amplitude]

    model = case.model()
    if quantity == "clearance":
        return list(model.chain.clearances)
    if quantity == "clearance_minus":
        # These are the numbers of the case: a site without a stop on that side has one too, without effect.
        given = values_of_sites(case.contacts, quantity, len(model.chain.sites))
        both = model.chain.clearances
        return [both[site] if value is None else value for site, value in enumerate(given)]
    return values_of_sites(case.contacts, quantity, len(model.chain.sites))


def differs_by_side(base: Case) -> bool:
    """Whether the clearance on the side w < 0 is another one than on the side w > 0."""
    each = base.contacts.each
    return base.contacts.clearance_minus is not None or bool(each and each.clearance_minus)


def _with_values(cell: UnitCell, quantity: str, numbers: list[float]) -> UnitCell:
    """The ``cell`` with other ``numbers`` of a ``quantity`` of its masses or its springs."""
    if quantity == "mass":
        return replace(cell, masses=tuple(numbers))
    if quantity == "grounding":
        return replace(cell, grounding=tuple(numbers))
    springs = []
    for spring, number in zip(cell.springs, numbers, strict=True):
        change: Table = {OF_SPRINGS[quantity]: number}
        springs.append(replace(spring, **change))
    return replace(cell, springs=tuple(springs))


def groups_of(unknown: UnknownTable, count: int) -> list[tuple[int, ...]]:
    """The members (0-based) of each value of an unknown of ``count`` members."""
    if unknown.of == "all":
        return [tuple(range(count))]
    if unknown.of == "each":
        return [(member,) for member in range(count)]
    return [tuple(number - 1 for number in group) for group in unknown.of]


def _parameter(unknown: UnknownTable, members: tuple[int, ...], start: float, unit: str) -> SoughtParameter:
    """The parameter of an ``unknown``, in its ``unit``, with one value at the ``members``; it begins at ``start``."""
    low, high = unknown.bounds
    name: str = unknown.quantity
    if unknown.of != "all":
        name += f" {'+'.join(str(member + 1) for member in members)}"
    is_logarithmic = unknown.quantity not in ON_LINEAR_SCALE
    if unknown.scale:
        is_logarithmic = unknown.scale == "logarithmic"
    return SoughtParameter(
        name=name,
        quantity=unknown.quantity,
        members=members,
        low=low,
        high=high,
        # The value of the case may be outside the bounds; the search begins within them.
        start=min(max(start, low), high),
        unit=unit,
        is_logarithmic=is_logarithmic,
    )


def parameters_of(unknown: UnknownTable, base: Case) -> list[SoughtParameter]:
    """The parameters of an ``unknown`` of the case ``base``, which begin at its values unless a start is given."""
    values = values_of(base, unknown.quantity)
    unit = UNITS.get(unknown.quantity, "1")
    if unknown.quantity == "amplitude":
        unit = drive_unit(base.drive)
    parameters = []
    for number, members in enumerate(groups_of(unknown, len(values))):
        if isinstance(unknown.start, list):
            start = unknown.start[number]
        elif unknown.start is not None:
            start = unknown.start
        else:
            # Members that have one value may differ in the case: their mean has the least squares from them.
            start = float(np.mean([values[member] for member in members]))
        parameters.append(_parameter(unknown, members, start, unit))
    return parameters


def numbers_of(base: Case, parameters: Sequence[SoughtParameter], values: Iterable[float]) -> dict[str, list[float]]:
    """The numbers (member,) of each quantity that is sought, by its name.

    Members that a parameter has are given its value, out of ``values`` (parameter,); others keep that of ``base``.
    """
    of_quantity: dict[str, list[float]] = {}
    for parameter, value in zip(parameters, values, strict=True):
        # The offset of a record's clock is no number of the case.
        if parameter.quantity == "offset":
            continue
        numbers = of_quantity.setdefault(parameter.quantity, list(values_of(base, parameter.quantity)))
        for member in parameter.members:
            numbers[member] = float(value)
    return of_quantity


def changed_case(base: Case, parameters: Sequence[SoughtParameter], values: Iterable[float], name: str) -> Case:
    """The case ``base`` with the ``values`` (parameter,) of its ``parameters``; raises CaseError."""
    contacts: Table = {}
    drive: Table = {}
    cell = base.lattice.undamped_cell()
    changed_cell = cell

    # All numbers of a quantity are changed at once: a section lists every member, also those that are not sought.
    for quantity, numbers in numbers_of(base, parameters, values).items():
        if quantity == "amplitude":
            drive["amplitude"] = numbers[0]
        elif quantity in OF_CELL:
            changed_cell = _with_values(changed_cell, quantity, numbers)
        elif quantity == "clearance":
            contacts["clearance"] = numbers
        elif len(set(numbers)) == 1 and not (base.contacts.each and getattr(base.contacts.each, quantity)):
            contacts[quantity] = numbers[0]
        else:
            each = contacts.get("each") or (base.contacts.each or Section()).model_dump(exclude_none=True)
            contacts["each"] = each | {quantity: numbers}
            # The list has a value for each site: one for all sites would contradict it.
            contacts[quantity] = None

    changes = {key: section for key, section in (("contacts", contacts), ("drive", drive)) if section}
    # Only if the cell changes: the case of a preset would have another hash if its cell were written out.
    if changed_cell is not cell:
        lattice = base.lattice.model_dump(by_alias=True, exclude_none=True)
        changes["lattice"] = dict.fromkeys(lattice) | with_cell(lattice, changed_cell, {})
        # The samples that count are those of the record. A run's interval may be too coarse for the bands of the new
        # cell, for which the case would be refused.
        assert base.time.sample_interval != "auto"  # the case is resolved
        if base.time.sample_interval * pass_bands(changed_cell)[-1].high >= np.pi:
            changes["time"] = {"sample_interval": None}
    return base.varied(name=name, **changes)
