"""Sections about cells that differ: profiles and defects, scatter cell by cell, ends that absorb."""

from functools import lru_cache
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from vipetsc.case.case_file import Section
from vipetsc.lattice import Chain, ToneBurst, UnitCell, waves_at
from vipetsc.lattice.chain import Ends
from vipetsc.lattice.damped import absorber, reflection

Finite = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
# Cells of an absorbing end that are tried, and logarithms of what comes back of the energy along the way.
LENGTHS, LOSSES = (10, 20, 40, 80, 160), (8.0, 10.0, 13.0, 17.0)


class Deviation(Section):
    """Standard deviation of values about those of the case: ``relative`` to each, or ``absolute`` in its unit.

    Their mean is the case's value with every ``distribution``; ``uniform`` ends sqrt(3) deviations from it.
    """

    relative: NotNegative | None = None
    absolute: NotNegative | None = None
    distribution: Literal["normal", "uniform", "lognormal"] = "normal"

    @model_validator(mode="after")
    def _one_size(self) -> Self:
        if (self.relative is None) == (self.absolute is None):
            raise ValueError("give one of relative and absolute")
        return self

    def draw(self, values: np.ndarray, seed: int, name: str) -> np.ndarray:
        """Values (n) of the quantity ``name`` about ``values`` (n); a larger n begins with the same numbers."""
        key = np.random.SeedSequence([seed, int.from_bytes(name.encode(), "little")])
        generator = np.random.Generator(np.random.Philox(key))
        deviation = np.full(len(values), self.absolute) if self.relative is None else self.relative * np.abs(values)
        if self.distribution == "uniform":
            return values + deviation * np.sqrt(3) * generator.uniform(-1, 1, len(values))
        normal = generator.standard_normal(len(values))
        if self.distribution == "normal":
            return values + deviation * normal
        with np.errstate(all="ignore"):  # of 0 there is none: not a number
            spread = np.log1p((deviation / values) ** 2)  # variance of the logarithm
            return np.asarray(values * np.exp(np.sqrt(spread) * normal - spread / 2))

    def __str__(self) -> str:
        size = f"{100 * self.relative:g} %" if self.relative is not None else f"{self.absolute:g}"
        return f"{self.distribution}, deviation {size}"


class Profile(Section):
    """A quantity that grows linearly from the ``first`` cell to the ``last``."""

    first: Finite
    last: Finite


class Defects(Section):
    """A quantity that has another ``value``, or ``factor`` times its own, in some ``cells`` (from 1)."""

    cells: list[int] = Field(min_length=1)
    value: Finite | None = None
    factor: Finite | None = None


class ScatterTable(Section):
    """What ``[disorder.cells]`` asks for, in a resolved case: the ``seed`` and the deviation of each quantity."""

    seed: Annotated[int, Field(ge=0)]
    quantities: dict[str, Deviation]


class AbsorbingTable(Section):
    """An end that absorbs: dashpots to ground, strength x^3 times the mass, over the last ``cells``, x from 0 to 1.

    ``cells`` and ``strength`` are by default the first that keep what comes back of the burst's energy below
    ``reflection``.
    """

    end: Literal["left", "right", "both"] = "right"
    cells: Annotated[int, Field(ge=1)] | None = None
    strength: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    reflection: Annotated[float, Field(gt=0, lt=1)] = 1e-3


@lru_cache
def designed_end(
    table: AbsorbingTable, cell: UnitCell, ends: Ends, drives: tuple[tuple[float, int], ...], most: int
) -> AbsorbingTable:
    """``table`` with cells, at ``most`` so many, and a strength; raises ValueError if none will do.

    ``drives`` are frequencies in rad/s and cycles; those in gaps send no wave.
    """
    waves = [wave for frequency, _ in drives for wave in waves_at(cell, frequency)]
    if not waves:
        raise ValueError("the drive is in a gap: no wave comes to the end")
    speed, best = max(wave[2] for wave in waves), np.inf
    for cells in [table.cells] if table.cells else [n for n in LENGTHS if n <= most]:
        for strength in [table.strength] if table.strength else [2 * speed * loss / cells for loss in LOSSES]:
            end = absorber(cell, ends, cells, strength)
            back = float(np.nanmax([lobe_reflection(end, *drive) for drive in drives]))
            best = min(best, back)
            if back <= table.reflection:
                return table.model_copy(update={"cells": cells, "strength": strength})
    raise ValueError(f"no end of up to {most} cells has it ({best:.2g} comes back): allow more, or more cells")


def lobe_reflection(chain: Chain, frequency: float, cycles: int) -> float:
    """Share of a burst's energy that comes back from the right end of ``chain``.

    Mean over the pass bands in the main lobe of its spectrum, weighted with the square of that; NaN if there are none.
    """
    lobe = frequency * (1 + np.linspace(-2, 2, 17)[1:-1] / cycles)
    lobe = lobe[lobe > 0]
    shares = np.array([reflection(chain, omega, chain.cells - 1) for omega in lobe.tolist()])
    waves, weights = np.isfinite(shares), np.abs(ToneBurst(1.0, frequency, cycles).spectrum(lobe)) ** 2
    return float(np.average(shares[waves], weights=weights[waves])) if waves.any() else np.nan


AnyProfile = list[Finite] | Profile | Defects
