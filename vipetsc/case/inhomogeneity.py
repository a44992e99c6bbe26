"""Masses, springs and dashpots of all cells, from profiles, scatter and absorbing ends.

A quantity is named as in a cell's table: ``masses[2]``, ``springs[1].stiffness``, ``springs[1].damping``,
``grounding[3]``, counted from 1.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial

import numpy as np

from vipetsc.case.case_file import LARGEST, Problem
from vipetsc.case.inhomogeneity_sections import AbsorbingTable, AnyProfile, Deviation, Profile
from vipetsc.case.schema import LatticeTable
from vipetsc.lattice import Chain, Coefficients, ToneBurst, UnitCell, Variation, waves_at
from vipetsc.lattice.chain import Ends
from vipetsc.lattice.damped import absorber, reflection

QUANTITY = re.compile(r"(masses|grounding)\[([1-9]\d*)\]|springs\[([1-9]\d*)\]\.(stiffness|damping)")
MOST_VARIED = 10**8  # cells that may differ: every rank holds them all
# Cells of an absorbing end that are tried, and logarithms of what comes back of the energy along the way.
LENGTHS, LOSSES = (10, 20, 40, 80, 160), (8.0, 10.0, 13.0, 17.0)


def place_of(key: str, cell: UnitCell) -> tuple[str, int] | None:
    """The name in ``Coefficients`` and the column of a quantity; None if the cell has none of that name."""
    match = QUANTITY.fullmatch(key)
    if match is None:
        return None
    name, index = match[1] or match[4], int(match[2] or match[3]) - 1
    return (name, index) if index < (cell.dofs if match[1] else len(cell.springs)) else None


def _profile(given: AnyProfile, values: np.ndarray) -> tuple[np.ndarray, str]:
    """The quantity's values (cells,) in place of the reference cell's, or what is wrong."""
    if isinstance(given, Profile):
        return np.linspace(given.first, given.last, len(values)), ""
    if isinstance(given, list):
        wrong = f"one value for each of the {len(values)} cells is needed" if len(given) != len(values) else ""
        return (values if wrong else np.array(given)), wrong
    if outside := [c for c in given.cells if not 1 <= c <= len(values)]:
        return values, f"cells {outside} are outside the lattice; cells count from 1 to {len(values)}"
    if (given.value is None) == (given.factor is None):
        return values, "give one of value and factor"
    at, new = np.array(given.cells) - 1, values.copy()
    new[at] = given.value if given.factor is None else given.factor * values[at]
    return new, "" if given.factor is None or values[at].any() else "is 0, and so is any factor of it: give value"


def _drawn(deviation: Deviation, seed: int, key: str, values: np.ndarray) -> tuple[np.ndarray, str]:
    nothing = "is 0 in all cells, and so is what is relative to it" if deviation.relative and not values.any() else ""
    return deviation.draw(values, seed, key), nothing


def vary(lattice: LatticeTable, cell: UnitCell) -> tuple[Coefficients, list[Problem]]:
    """Masses, springs and dashpots of all cells without Rayleigh damping, and what is wrong with what differs."""
    arrays, problems = Chain(cell, lattice.cells).coefficients(0, lattice.cells), list[Problem]()

    def put(key: str, path: str, change: Callable[[np.ndarray], tuple[np.ndarray, str]]) -> None:
        place = place_of(key, cell)
        if place is None:
            remedy = f"the cell has {cell.dofs} masses and {len(cell.springs)} springs; as in masses[1], grounding[1]"
            problems.append(Problem(path, None, f"{remedy}, springs[1].stiffness or springs[1].damping"))
            return
        column = getattr(arrays, place[0])[:, place[1]]
        column[:], wrong = change(column.copy())
        least = column.min()
        if not wrong and not np.all((np.abs(column) < LARGEST) & ((np.abs(column) > 1 / LARGEST) | (column == 0))):
            wrong = f"is no number, or not between {1 / LARGEST:g} and {LARGEST:g}, in some cells"
        elif not wrong and (least < 0 or (least == 0 and place[0] in ("masses", "stiffness"))):
            wrong = (
                f"is {least:.4g} in cell {int(column.argmin()) + 1}: no smaller than 0, and a mass or spring above it"
            )
        if wrong:
            problems.append(Problem(path, None, wrong))

    for key, given in (lattice.profiles or {}).items():
        put(key, f'lattice.profiles."{key}"', partial(_profile, given))
    if scatter := lattice.scatter:
        for key, deviation in scatter.quantities.items():
            put(key, f'disorder.cells."{key}"', partial(_drawn, deviation, scatter.seed, key))
    return arrays, problems


def cell_variation(lattice: LatticeTable) -> Variation | None:
    """What differs from the reference cell in a valid, resolved case; None if nothing may."""
    if not (lattice.profiles or lattice.scatter or lattice.absorbing):
        return None
    cell, damping, absorbing = lattice.undamped_cell(), lattice.damping, lattice.absorbing
    arrays = vary(lattice, cell)[0]
    if damping:
        ground, beside = damping.fitted(cell)
        arrays.grounding[:] += damping.mass * arrays.masses + ground
        arrays.damping[:] += damping.stiffness * arrays.stiffness + beside
    if absorbing and absorbing.cells and absorbing.strength:
        graded = absorber(lattice.unit_cell(), lattice.ends, absorbing.cells, absorbing.strength, 0)
        assert graded.variation is not None and graded.variation.grounding is not None
        extra = graded.variation.grounding - graded.coefficients(-2, -1).grounding
        if absorbing.end != "left":
            arrays.grounding[-absorbing.cells :] += extra
        if absorbing.end != "right":
            arrays.grounding[: absorbing.cells] += extra[::-1]
    reference = Chain(lattice.unit_cell(), 2).coefficients(0, 1)
    differing = {n: a for n, a, r in zip(Coefficients._fields, arrays, reference, strict=True) if np.any(a != r)}
    return Variation(**differing) if differing else None


def check_inhomogeneity(lattice: LatticeTable, driven: Sequence[int]) -> Iterator[Problem]:
    """What is wrong with what differs from a valid cell; ``driven`` are the cells (from 1) of the drives."""
    if (lattice.profiles or lattice.scatter or lattice.absorbing) and lattice.cells > MOST_VARIED:
        yield Problem("lattice.cells", lattice.cells, f"at most {MOST_VARIED} cells may differ: every rank holds them")
        return
    if lattice.profiles or lattice.scatter:
        yield from vary(lattice, lattice.undamped_cell())[1]
    if (absorbing := lattice.absorbing) is None:
        return
    if not lattice.undamped_cell().springs:
        yield Problem("lattice.absorbing", None, "no waves come to an end of a lattice without springs; leave it out")
    if lattice.ends == "periodic":
        yield Problem("lattice.absorbing", None, 'a ring has no end; ends = "fixed" or "free"')
    n = absorbing.cells or 0
    if 2 * n >= lattice.cells:
        yield Problem("lattice.absorbing.cells", n, f"half of the {lattice.cells} cells, or more")
        return
    low, high = n * (absorbing.end != "right"), lattice.cells - n * (absorbing.end != "left")
    if inside := [cell for cell in driven if not low < cell <= high]:
        yield Problem("lattice.absorbing.end", absorbing.end, f"the driven cell {inside[0]} is in the absorbing end")


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
