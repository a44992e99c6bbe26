"""Variables of a search: quantities by name, and keys of the case, with bounds or lists of values."""

import copy
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import AfterValidator, Field

from vipetsc.case.schema import PositiveRange, rising
from vipetsc.case.section import Section, described
from vipetsc.case.value_ranges import leaves

SECTIONS = ("lattice", "contacts", "drive", "initial", "time", "output")  # whose keys may vary
Kind = Literal["log", "linear", "whole", "site", "choice"]
Fraction = Annotated[float, Field(ge=0, le=1)]
Fractions = Annotated[list[Fraction], Field(min_length=2, max_length=2), AfterValidator(rising)]


class VariablesTable(Section):
    """The variables by name, each with bounds [low, high], and those that are keys of the case, by their sections.

    All named variables except sites and restitution are searched by their logarithm. A range of a key that is a list in
    the case, as all of ``contacts.each`` are, is one of each entry.
    """

    clearance: PositiveRange | None = described("bounds of each site's clearance", None, unit="m")
    profile: PositiveRange | None = described(
        "bounds of the clearances of the first and the last site; the others are log-spaced in between", None, unit="m"
    )
    sites: Annotated[list[int], Field(min_length=2, max_length=2)] | None = described(
        "first and last cell in which a site may be", None
    )
    restitution: Fractions | None = described("bounds of the restitution", None)
    masses: dict[str, PositiveRange] = described("bounds of masses, by their number in the cell", {}, unit="kg")
    springs: dict[str, PositiveRange] = described(
        "bounds of stiffnesses, by the spring's number in the cell", {}, unit="N/m"
    )
    lattice: dict[str, Any] | None = described(
        "keys of [lattice] that vary: { log, linear or whole = [low, high] }, or a list of values", None
    )
    contacts: dict[str, Any] | None = described(
        "keys of [contacts] that vary, likewise; a range of a key that is a list varies every entry", None
    )
    drive: dict[str, Any] | None = described("keys of [drive] that vary, likewise", None)
    initial: dict[str, Any] | None = described("keys of [initial] that vary, likewise", None)
    time: dict[str, Any] | None = described("keys of [time] that vary, likewise", None)
    output: dict[str, Any] | None = described(
        "keys of [output] that vary, likewise, such as the cells of named points", None
    )

    def keys_of_case(self) -> dict[str, Any]:
        """Return the ranges and the lists of values of keys of the case, by the keys' paths."""
        return dict(leaves({section: getattr(self, section) or {} for section in SECTIONS}))

    @property
    def varies_cell(self) -> bool:
        """Whether the unit cell varies, and with it the pass bands."""
        # Any key of the lattice: whether it changes the cell is seen only when it is resolved.
        return bool(self.masses or self.springs or self.lattice)

    @property
    def is_empty(self) -> bool:
        """Whether nothing varies."""
        named = self.model_dump(exclude_none=True, exclude={*SECTIONS})
        return not any(named.values()) and not self.keys_of_case()


class Variable(NamedTuple):
    """A key of the case, by its ``path``, that varies between ``low`` and ``high``.

    ``kind`` is "log" (searched by its logarithm), "linear", "whole" (a whole number), "site" (the cell of one of the
    sites, which rise and differ) or "choice" (the number, from 1, of one of the ``choices``). ``start`` is the value of
    the case. Variables with the same ``row`` belong to one list, and a search varies neighbours together at first.
    """

    name: str
    path: str
    low: float
    high: float
    kind: Kind
    start: float
    row: str = ""
    choices: tuple[Any, ...] = ()

    def to_unit(self, value: float) -> float:
        """Return the position between the bounds, 0 to 1, of a ``value``."""
        if self.kind == "log":
            return float(np.log(value / self.low) / np.log(self.high / self.low))
        if self.kind == "choice":
            # Each choice has an interval of equal length, so that all are equally likely; this is its middle.
            return (value - 0.5) / self.high
        return (value - self.low) / (self.high - self.low)

    def from_unit(self, position: float) -> float:
        """Return the value at a ``position`` between the bounds, 0 to 1; of a site before it is rounded."""
        if self.kind == "log":
            return float(self.low * (self.high / self.low) ** position)
        if self.kind == "choice":
            # At 1, the end of the last interval, floor gives one more than there are.
            return min(float(np.floor(position * self.high)) + 1, self.high)
        value = self.low + (self.high - self.low) * position
        if self.kind == "whole":
            return float(np.round(value))
        return value

    def in_case(self, value: float) -> Any:
        """Return a ``value`` as the case has it."""
        if self.kind == "choice":
            # A copy: a choice may be a list, which two designs must not have in common.
            return copy.deepcopy(self.choices[int(value) - 1])
        if self.kind in ("whole", "site"):
            return int(value)
        return float(value)

    @property
    def step(self) -> float:
        """The distance in the unit cube of neighbouring values; 0 for real numbers."""
        if self.kind == "choice":
            return 1 / self.high
        if self.kind in ("whole", "site"):
            return 1 / (self.high - self.low)
        return 0.0
