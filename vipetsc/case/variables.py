"""Variables of a search: quantities by name, and keys of the case, with bounds or lists of values."""

import copy
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from vipetsc.case.case_file import Section
from vipetsc.case.objective import Pair
from vipetsc.case.value_ranges import leaves

SECTIONS = ("lattice", "contacts", "drive", "initial", "time", "output")  # whose keys may vary
Kind = Literal["log", "linear", "whole", "site", "choice"]
Fraction = Annotated[float, Field(ge=0, le=1)]


class VariablesTable(Section):
    """The variables by name, each with bounds [low, high], and those that are keys of the case, by their sections.

    By name: ``clearance`` in m of each site independently, or ``profile``, those of the first and of the last site with
    the others log-spaced between; ``sites``: the cells (1-based), whole numbers that differ; ``restitution``;
    ``masses`` in kg and ``springs`` in N/m of the cell by their number in it (from 1). All except sites and restitution
    are searched by their logarithm.

    Keys of ``lattice``, ``contacts``, ``drive``, ``initial``, ``time`` and ``output`` have a range, { log = [low,
    high] }, { linear = [low, high] } or { whole = [low, high] }, or a list of the values that they may take. A range of
    a key that is a list in the case, as all of ``contacts.each`` are, is one of each entry.
    """

    clearance: Pair | None = None
    profile: Pair | None = None
    sites: Annotated[list[int], Field(min_length=2, max_length=2)] | None = None
    restitution: Annotated[list[Fraction], Field(min_length=2, max_length=2)] | None = None
    masses: dict[str, Pair] = Field({})
    springs: dict[str, Pair] = Field({})
    lattice: dict[str, Any] | None = None
    contacts: dict[str, Any] | None = None
    drive: dict[str, Any] | None = None
    initial: dict[str, Any] | None = None
    time: dict[str, Any] | None = None
    output: dict[str, Any] | None = None

    def keys_of_case(self) -> dict[str, Any]:
        """The ranges and the lists of values of keys of the case, by the keys' paths."""
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
        """The position between the bounds, 0 to 1, of a ``value``."""
        if self.kind == "log":
            return float(np.log(value / self.low) / np.log(self.high / self.low))
        if self.kind == "choice":
            # Each choice has an interval of equal length, so that all are equally likely; this is its middle.
            return (value - 0.5) / self.high
        return (value - self.low) / (self.high - self.low)

    def from_unit(self, position: float) -> float:
        """The value at a ``position`` between the bounds, 0 to 1; of a site before it is rounded."""
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
        """A ``value`` as the case has it."""
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
