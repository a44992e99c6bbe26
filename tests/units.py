"""Change of units: what a case and its results become if mass, length and time are measured in other units."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from vipetsc.case.keys import unit_of

# Exponents of kg, m and s. Angles, cells and counts have none.
EXPONENTS = {
    "kg": (1, 0, 0),
    "m": (0, 1, 0),
    "s": (0, 0, 1),
    "N": (1, 1, -2),
    "J": (1, 2, -2),
    "W": (1, 2, -3),
    "Pa": (1, -1, -2),
    "Hz": (0, 0, -1),
    "rad": (0, 0, 0),
    "cell": (0, 0, 0),
    "cells": (0, 0, 0),
    "site": (0, 0, 0),
    "1": (0, 0, 0),
}
POWER = re.compile(r"([A-Za-z1]+)(?:\^\(?(-?[\d./]+)\)?)?")
INDEX = re.compile(r"\[\d+\]")


@dataclass(frozen=True)
class Units:
    """Units of mass, length and time, by their sizes in kg, m and s."""

    mass: float
    length: float
    time: float

    def factor(self, unit: str) -> float:
        """Return the number that 1 ``unit``, as "N/m^1.5", becomes in these units."""
        dimensions = np.zeros(3)
        sign = 1
        for part in re.split(r"([/ ])", unit):
            if part == "/":
                sign = -1
            elif part.strip():
                match = POWER.fullmatch(part)
                assert match and match[1] in EXPONENTS, f"unknown unit {unit!r}"
                dimensions += sign * float(match[2] or 1) * np.array(EXPONENTS[match[1]])
        return float(np.prod(np.array([self.mass, self.length, self.time]) ** -dimensions))

    def of_table(self, table: dict[str, Any], units: dict[str, str] | None = None) -> dict[str, Any]:
        """Return the ``table`` of a case in these units; ``units`` are those of keys whose unit depends on others."""
        return self._of_value(table, "", table, units or {})

    def _of_value(self, value: Any, path: str, table: dict[str, Any], units: dict[str, str]) -> Any:
        if isinstance(value, dict):
            return {key: self._of_value(item, f"{path}.{key}".lstrip("."), table, units) for key, item in value.items()}
        if isinstance(value, list):
            return [self._of_value(item, f"{path}[{i}]", table, units) for i, item in enumerate(value, 1)]
        if isinstance(value, bool | str):
            return value
        unit = units.get(INDEX.sub("", path)) or unit_of(path, table)
        if not unit or self.factor(unit) == 1:
            return value
        return value * self.factor(unit)


# Sizes that are powers of 16: products with them, and square roots of these, have no rounding errors.
TINY = Units(mass=16.0**6, length=16.0**3, time=16.0**2)
HUGE = Units(mass=16.0**-5, length=16.0**-4, time=16.0**-1)


def assert_same_motion(found: xr.Dataset, expected: xr.Dataset, units: Units, tolerance: float = 0.0) -> None:
    """Assert that ``found`` is ``expected`` in other ``units``, to a ``tolerance`` relative to each largest value."""
    assert set(found.variables) == set(expected.variables)
    for name, variable in expected.variables.items():
        values = np.asarray(variable)
        if values.dtype.kind not in "fc":
            np.testing.assert_array_equal(found[name], values, err_msg=str(name))
            continue
        values = values * units.factor(variable.attrs.get("units", "1"))
        largest = np.max(np.abs(values[np.isfinite(values)]), initial=0.0)
        np.testing.assert_allclose(found[name], values, rtol=0, atol=tolerance * largest, err_msg=str(name))
