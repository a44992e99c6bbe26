"""Parameters that the verb ``identify`` seeks: their sections, their values in a case, and a case with other values."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np

from vipetsc.case.amplitude import drive_unit
from vipetsc.case.case import Case
from vipetsc.case.quantities import QUANTITIES
from vipetsc.case.schema import Range
from vipetsc.case.section import BY_SHAPE, Section, described
from vipetsc.lattice import pass_bands

if TYPE_CHECKING:
    # For the type checker, which takes no names from a table.
    QuantityName = str
else:
    QuantityName = Literal[tuple(QUANTITIES)]


class UnknownTable(Section):
    """A ``quantity`` that is sought within ``bounds`` in SI units, from ``start`` on, by default that of the case.

    ``dashpot`` is parallel to a spring, ``grounding`` a dashpot between a mass and the ground; ``quadratic`` and
    ``cubic`` are terms of a spring's force; ``amplitude`` is that of the first drive.
    """

    quantity: QuantityName = described(
        "what is sought: of contact sites, of masses or springs of the cell, or the amplitude of the drive"
    )
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
        # The clock of a record does not change the motion, but what was measured of it.
        return self.quantity in QUANTITIES and QUANTITIES[self.quantity].of != "site"

    def to_coordinate(self, value: float) -> float:
        """Return the fit's coordinate of a ``value``."""
        if self.is_logarithmic:
            return float(np.log(value))
        return (value - self.low) / (self.high - self.low)

    def from_coordinate(self, z: float) -> float:
        """Return the value at the fit's coordinate ``z``, kept between the bounds, which rounding may miss."""
        value = self.low + (self.high - self.low) * z
        if self.is_logarithmic:
            # Clipped before the exponential, which would overflow far outside.
            value = np.exp(np.clip(z, np.log(self.low), np.log(self.high)))
        return float(np.clip(value, self.low, self.high))

    def slope(self, z: float) -> float:
        """Return the derivative of the value by the fit's coordinate at ``z``."""
        if self.is_logarithmic:
            # The derivative of exp(z) is exp(z), the value itself.
            return self.from_coordinate(z)
        return self.high - self.low


def values_of(case: Case, quantity: str) -> list[float]:
    """Return the values of a ``quantity`` in a case: of its sites, the masses or springs of its cell, or its drive."""
    return QUANTITIES[quantity].numbers(dict(case))


def groups_of(unknown: UnknownTable, count: int) -> list[tuple[int, ...]]:
    """Return the members (0-based) of each value of an unknown of ``count`` members."""
    if unknown.of == "all":
        return [tuple(range(count))]
    if unknown.of == "each":
        return [(member,) for member in range(count)]
    return [tuple(number - 1 for number in group) for group in unknown.of]


def _parameter(unknown: UnknownTable, members: tuple[int, ...], start: float, unit: str) -> SoughtParameter:
    """Return the parameter of an ``unknown``, in its ``unit``, with one value at the ``members``, and its ``start``."""
    low, high = unknown.bounds
    name: str = unknown.quantity
    if unknown.of != "all":
        name += f" {'+'.join(str(member + 1) for member in members)}"
    scale = unknown.scale or QUANTITIES[unknown.quantity].scale
    return SoughtParameter(
        name=name,
        quantity=unknown.quantity,
        members=members,
        low=low,
        high=high,
        # The value of the case may be outside the bounds; the search begins within them.
        start=min(max(start, low), high),
        unit=unit,
        is_logarithmic=scale == "logarithmic",
    )


def parameters_of(unknown: UnknownTable, base: Case) -> list[SoughtParameter]:
    """Return parameters of an ``unknown`` of the case ``base``, which begin at its values unless a start is given."""
    values = values_of(base, unknown.quantity)
    unit = QUANTITIES[unknown.quantity].unit or drive_unit(base.drive)
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
    """Return the numbers (member,) of each quantity that is sought, by its name.

    Members that a parameter has are given its value, out of ``values`` (parameter,); others keep that of ``base``.
    """
    of_quantity: dict[str, list[float]] = {}
    for parameter, value in zip(parameters, values, strict=True):
        # The offset of a record's clock is not a number of the case.
        if parameter.quantity not in QUANTITIES:
            continue
        numbers = of_quantity.setdefault(parameter.quantity, list(values_of(base, parameter.quantity)))
        for member in parameter.members:
            numbers[member] = float(value)
    return of_quantity


def changed_case(base: Case, parameters: Sequence[SoughtParameter], values: Iterable[float], name: str) -> Case:
    """Return the case ``base`` with the ``values`` (parameter,) of its ``parameters``; raises CaseError."""
    sections: dict[str, Any] = dict(base)
    # All numbers of a quantity are changed at once: a section lists every member, also those that are not sought.
    for quantity, numbers in numbers_of(base, parameters, values).items():
        sections = QUANTITIES[quantity].put(sections, numbers)

    changes = {}
    for key in ("lattice", "contacts", "drive"):
        before = getattr(base, key)
        # Only what changes: the case of a preset would have another hash if its cell were written out.
        if sections[key] is not before:
            # A key that is gone is None, which removes it.
            gone = dict.fromkeys(before.model_dump(by_alias=True, exclude_none=True))
            changes[key] = gone | sections[key].model_dump(by_alias=True, exclude_none=True)
    # The samples that count are those of the record. A run's interval may be too coarse for the bands of the new cell,
    # for which the case would be refused.
    assert base.time.sample_interval != "auto"  # the case is resolved
    cell = sections["lattice"].undamped_cell()
    if "lattice" in changes and base.time.sample_interval * pass_bands(cell)[-1].high >= np.pi:
        changes["time"] = {"sample_interval": None}
    return base.varied(name=name, **changes)
