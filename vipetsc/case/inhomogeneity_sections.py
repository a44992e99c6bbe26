"""The sections of a case for inhomogeneous lattices: profiles and defects, scatter cell by cell, absorbing ends."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from vipetsc.case.section import Section, described

Finite = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Deviation(Section):
    """Standard deviation of values about those of the case: ``relative`` to each, or ``absolute`` in its unit.

    Their mean is the case's value with every ``distribution``; ``uniform`` ends sqrt(3) deviations from it.
    """

    relative: NotNegative | None = described("standard deviation over the value", None)
    absolute: NotNegative | None = described("standard deviation", None, unit="unit of the value")
    distribution: Literal["normal", "uniform", "lognormal"] = described(
        "distribution; its mean is the value of the case", "normal"
    )

    @model_validator(mode="after")
    def _one_size(self) -> Self:
        if (self.relative is None) == (self.absolute is None):
            raise ValueError("give either relative or absolute")
        return self

    def draw(self, values: np.ndarray, seed: int, name: str) -> np.ndarray:
        """Return values (n) of the quantity ``name`` about ``values`` (n); a larger n begins with the same numbers."""
        # A generator for each quantity, keyed by seed and name: to scatter one more quantity leaves the others as
        # they were.
        key = np.random.SeedSequence([seed, int.from_bytes(name.encode(), "little")])
        generator = np.random.Generator(np.random.Philox(key))
        if self.relative is None:
            deviation = np.full(len(values), self.absolute)
        else:
            deviation = self.relative * np.abs(values)

        if self.distribution == "uniform":
            # A uniform distribution of half-width h has the standard deviation h / sqrt(3).
            return values + deviation * np.sqrt(3) * generator.uniform(-1, 1, len(values))
        normal = generator.standard_normal(len(values))
        if self.distribution == "normal":
            return values + deviation * normal

        # A lognormal distribution about 0 does not exist: it gives NaN, which callers refuse.
        with np.errstate(all="ignore"):
            spread = np.log1p((deviation / values) ** 2)  # variance of the logarithm
            # - spread / 2: the mean of exp(s normal) is exp(s^2 / 2), and the mean shall be the value of the case.
            return np.asarray(values * np.exp(np.sqrt(spread) * normal - spread / 2))

    def __str__(self) -> str:
        if self.relative is None:
            size = f"{self.absolute:g}"
        else:
            size = f"{100 * self.relative:g} %"
        return f"{self.distribution}, deviation {size}"


class Profile(Section):
    """A quantity that varies linearly from the ``first`` cell to the ``last``."""

    first: Finite = described("value in the first cell", unit="unit of the value")
    last: Finite = described("value in the last cell; linear in between", unit="unit of the value")


class Defects(Section):
    """A quantity that has another ``value``, or ``factor`` times its value, in some ``cells`` (from 1)."""

    cells: list[int] = described("cells with another value", min_length=1)
    value: Finite | None = described("value in these cells", None, unit="unit of the value")
    factor: Finite | None = described("value in these cells over that in the other cells, instead of `value`", None)


class ScatterTable(Section):
    """The request of ``[disorder.cells]`` in a resolved case: the ``seed`` and the deviation of each quantity."""

    seed: Annotated[int, Field(ge=0)] = described("seed of the random numbers")
    quantities: dict[str, Deviation] = described("standard deviation of each quantity that scatters from cell to cell")


class AbsorbingTable(Section):
    """An absorbing end: dashpots to ground, strength x^3 (1/s) times the mass; x goes from 0 to 1 over its ``cells``.

    By default, ``cells`` and ``strength`` are the first tried values whose reflected fraction of the energy is below
    ``reflection``.
    """

    end: Literal["left", "right", "both"] = described("which end absorbs", "right")
    cells: Annotated[int, Field(ge=1)] | None = described(
        "number of absorbing cells; by default determined from `reflection`", None
    )
    strength: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = described(
        "dashpot constant to ground over the mass in the last cell; by default determined from `reflection`",
        None,
        unit="1/s",
    )
    reflection: Annotated[float, Field(gt=0, lt=1)] = described(
        "largest fraction of the energy sent by the drive that may be reflected", 1e-3
    )


AnyProfile = list[Finite] | Profile | Defects
