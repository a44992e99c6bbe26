"""Values that a case file gives as text with a unit: "150 Hz" for a frequency in rad/s, "1 mm" for a length in m."""

import math
import re
from typing import Any, NamedTuple

NUMBER_WITH_UNIT = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s+(\S.*?)\s*")
FACTOR = re.compile(r"([A-Za-zµ]+)(?:\^(\d+(?:\.\d+)?))?")
PREFIXES = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3, "M": 1e6, "G": 1e9}


class SiUnit(NamedTuple):
    """A unit: its ``factor`` to SI, and the powers of metre, kilogram and second."""

    factor: float
    metre: float = 0.0
    kilogram: float = 0.0
    second: float = 0.0


# A frequency in Hz is one of 2 pi rad/s; rad has no dimension.
SYMBOLS = {
    "m": SiUnit(1.0, metre=1),
    "g": SiUnit(1e-3, kilogram=1),
    "s": SiUnit(1.0, second=1),
    "N": SiUnit(1.0, metre=1, kilogram=1, second=-2),
    "Pa": SiUnit(1.0, metre=-1, kilogram=1, second=-2),
    "J": SiUnit(1.0, metre=2, kilogram=1, second=-2),
    "Hz": SiUnit(2 * math.pi, second=-1),
    "rad": SiUnit(1.0),
    "1": SiUnit(1.0),
}


def in_unit(value: Any, unit: str) -> Any:
    """Return a ``value`` of a key in the key's ``unit``, where it is a text as "1 mm", or holds some; else as it is.

    So is a text in a unit of another dimension, which is then refused as a text.
    """
    if not unit:
        return value
    if isinstance(value, list):
        return [in_unit(item, unit) for item in value]
    if isinstance(value, dict):
        return {key: in_unit(item, unit) for key, item in value.items()}
    match = NUMBER_WITH_UNIT.fullmatch(value) if isinstance(value, str) else None
    if not match:
        return value

    given = _unit_of(match[2])
    wanted = _unit_of(unit)
    if given is None or wanted is None or given[1:] != wanted[1:]:
        return value
    # A key in Hz takes Hz as they are. 1.1 mm are 0.0011 m to the last bit, as if the case file had that number.
    return float(f"{float(match[1]) * given.factor / wanted.factor:.15g}")


def _unit_of(text: str) -> SiUnit | None:
    """Return the unit that a ``text`` such as "kN/mm^1.5" or "N s/m" stands for; None if it is not one."""
    above, *below = text.split("/")
    product = SiUnit(1.0)
    for part, sign in ((above, 1), *((part, -1) for part in below)):
        for symbol in part.split():
            factor = _power_of(symbol, sign)
            if factor is None:
                return None
            powers = [mine + further for mine, further in zip(product[1:], factor[1:], strict=True)]
            product = SiUnit(product.factor * factor.factor, *powers)
    return product


def _power_of(symbol: str, sign: int) -> SiUnit | None:
    """Return a ``symbol`` as "mm^2", with or without a prefix, to the power of its ``sign``; None if unknown."""
    if symbol == "1":
        return SYMBOLS["1"]
    match = FACTOR.fullmatch(symbol)
    if not match:
        return None
    name, exponent = match[1], sign * float(match[2] or 1)
    prefix = 1.0
    if name not in SYMBOLS:
        prefix = PREFIXES.get(name[0], 0.0)
        name = name[1:]
    if not prefix or name not in SYMBOLS:
        return None
    unit = SYMBOLS[name]
    return SiUnit((prefix * unit.factor) ** exponent, *(exponent * power for power in unit[1:]))
