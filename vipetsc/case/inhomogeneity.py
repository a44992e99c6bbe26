"""Masses, springs and dashpots of all cells, from profiles, scatter and absorbing ends.

A quantity is named as in a cell's table: ``masses[2]``, ``springs[1].stiffness``, ``springs[1].damping``,
``springs[1].quadratic``, ``springs[1].cubic``, ``grounding[3]``, counted from 1.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from vipetsc.case.inhomogeneity_sections import AbsorbingTable, AnyProfile, Deviation, Profile
from vipetsc.case.reading import LARGEST
from vipetsc.case.schema import LatticeTable
from vipetsc.case.section import Problem
from vipetsc.lattice import Chain, SpringTerms, UnitCell, Variation
from vipetsc.lattice.ends import absorber

QUANTITY = re.compile(r"(masses|grounding)\[([1-9]\d*)\]|springs\[([1-9]\d*)\]\.(stiffness|damping|quadratic|cubic)")
# Cells of an inhomogeneous lattice. Every rank holds all of them: each quantity of so many takes 0.8 GB a rank.
MOST_VARIED = 10**8


def place_of(key: str, cell: UnitCell) -> tuple[str, int] | None:
    """Return the name in ``Variation`` and the column of a quantity; None if the cell has none of that name."""
    match = QUANTITY.fullmatch(key)
    if match is None:
        return None

    masses_or_grounding, mass, spring, of_spring = match.groups()
    if masses_or_grounding:
        name = masses_or_grounding
        index = int(mass) - 1
        count = cell.dofs
    else:
        name = of_spring
        index = int(spring) - 1
        count = len(cell.springs)
    if index >= count:
        return None
    return name, index


def _profile(given: AnyProfile, values: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the values (cells,) that a profile gives in place of the reference cell's ``values`` (cells,).

    The second result says what is wrong with the profile; it is "" if nothing is.
    """
    if isinstance(given, Profile):
        return np.linspace(given.first, given.last, len(values)), ""
    if isinstance(given, list):
        if len(given) != len(values):
            return values, f"give one value for each of the {len(values)} cells"
        return np.array(given), ""

    outside = [cell for cell in given.cells if not 1 <= cell <= len(values)]
    if outside:
        return values, f"cells {outside} are outside the lattice; cells are numbered from 1 to {len(values)}"
    if (given.value is None) == (given.factor is None):
        return values, "give either value or factor"
    at = np.array(given.cells) - 1
    # A copy: the values of other cells stay, and the caller compares old and new.
    new = values.copy()
    if given.factor is None:
        new[at] = given.value
        return new, ""
    new[at] = given.factor * values[at]
    if not values[at].any():
        return new, "is 0, so that a factor has no effect: give value"
    return new, ""


def _drawn(deviation: Deviation, seed: int, key: str, values: np.ndarray) -> tuple[np.ndarray, str]:
    """Return numbers (cells,) drawn about the ``values`` (cells,) of the quantity ``key``.

    The second result says what is wrong with the deviation; it is "" if nothing is.
    """
    drawn = deviation.draw(values, seed, key)
    if deviation.relative and not values.any():
        return drawn, "is 0 in all cells, so that a relative deviation has no effect"
    return drawn, ""


def _arrays(chain: Chain, start: int, stop: int) -> dict[str, np.ndarray]:
    """Return the arrays (cell, ...) of cells ``start`` to ``stop`` of ``chain``, by their names in ``Variation``."""
    return chain.coefficients(start, stop)._asdict() | chain.spring_terms(start, stop)._asdict()


def vary(lattice: LatticeTable, cell: UnitCell) -> tuple[dict[str, np.ndarray], list[Problem]]:
    """Return arrays (cell, ...) of all cells by their names in ``Variation``, and what is wrong with them.

    They have the profiles and the scatter of the ``lattice`` about its undamped ``cell``; what follows from these, as
    Rayleigh damping and absorbing ends do, is added by ``cell_variation``.
    """
    arrays = _arrays(Chain(cell, lattice.cells), 0, lattice.cells)
    problems: list[Problem] = []
    negative = {name for name in ("stiffness", "damping", "grounding") if arrays[name].min(initial=0.0) < 0}

    def put(key: str, path: str, change: Callable[[np.ndarray], tuple[np.ndarray, str]]) -> None:
        """Put what ``change`` makes of the values (cells,) of the quantity ``key`` in their place."""
        place = place_of(key, cell)
        if place is None:
            remedy = f"the cell has {cell.dofs} masses and {len(cell.springs)} springs; as in masses[1], grounding[1]"
            terms = ", ".join(f"springs[1].{term}" for term in ("stiffness", "damping", *SpringTerms._fields))
            problems.append(Problem(path, None, f"{remedy}, {terms}"))
            return

        name, index = place
        if name in negative:
            remedy = (
                "some springs or dashpots of the cell are negative: whether cells that differ are stable is not known"
            )
            problems.append(Problem(path, None, f"{remedy}; remove it"))
            return
        # A view into the array of all cells, which the change is written into.
        column = arrays[name][:, index]
        column[:], wrong = change(column.copy())
        wrong = wrong or _wrong_values(name, column)
        if wrong:
            problems.append(Problem(path, None, wrong))

    # Profiles first: a deviation is about what they give.
    for key, given in (lattice.profiles or {}).items():
        put(key, f'lattice.profiles."{key}"', partial(_profile, given))
    scatter = lattice.scatter
    if scatter:
        for key, deviation in scatter.quantities.items():
            put(key, f'disorder.cells."{key}"', partial(_drawn, deviation, scatter.seed, key))
    return arrays, problems


def _wrong_values(name: str, column: np.ndarray) -> str:
    """Return problems with the values (cells,) of a quantity called ``name`` in ``Variation``; "" if nothing."""
    size = np.abs(column)
    if not np.all((size < LARGEST) & ((size > 1 / LARGEST) | (column == 0))):
        return f"is not a number, or not between {1 / LARGEST:g} and {LARGEST:g}, in some cells"
    if name in SpringTerms._fields:
        return ""
    least = column.min()
    if least < 0 or (least == 0 and name in ("masses", "stiffness")):
        where = f"cell {int(column.argmin()) + 1}"
        return f"is {least:.4g} in {where}: it must not be negative, and a mass or stiffness must be positive"
    return ""


def cell_variation(lattice: LatticeTable) -> Variation | None:
    """Return quantities that differ from the reference cell in a valid, resolved case; None if nothing may differ."""
    if not (lattice.profiles or lattice.scatter or lattice.absorbing):
        return None

    cell = lattice.undamped_cell()
    arrays, _ = vary(lattice, cell)
    damping = lattice.damping
    if damping:
        # After profiles and scatter: Rayleigh damping is in proportion to the masses and springs that there are.
        grounding, dashpots = damping.fitted(cell)
        arrays["grounding"] += damping.mass * arrays["masses"] + grounding
        arrays["damping"] += damping.stiffness * arrays["stiffness"] + dashpots

    absorbing = lattice.absorbing
    if absorbing and absorbing.cells and absorbing.strength:
        # Last: absorbing dashpots are added to what profiles, scatter and Rayleigh damping give. A cell outside the
        # absorber, as cell -2, has the reference cell's dashpots: the end adds the difference from these.
        graded = absorber(lattice.unit_cell(), lattice.ends, absorbing.cells, absorbing.strength, before=0)
        assert graded.variation is not None and graded.variation.grounding is not None
        extra = graded.variation.grounding - graded.coefficients(-2, -1).grounding
        if absorbing.end != "left":
            arrays["grounding"][-absorbing.cells :] += extra
        if absorbing.end != "right":
            # The strength grows towards the end, hence the mirrored order on the left.
            arrays["grounding"][: absorbing.cells] += extra[::-1]

    reference = _arrays(Chain(lattice.unit_cell(), 2), 0, 1)
    # Every rank holds these arrays: those that equal the reference are left out.
    differing = {name: array for name, array in arrays.items() if np.any(array != reference[name])}
    if not differing:
        return None
    return Variation(**differing)


def check_inhomogeneity(lattice: LatticeTable, driven: Sequence[int]) -> Iterator[Problem]:
    """Yield problems with what differs from a valid cell; waves are sent from the ``driven`` cells (from 1)."""
    if (lattice.profiles or lattice.scatter or lattice.absorbing) and lattice.cells > MOST_VARIED:
        yield Problem(
            "lattice.cells", lattice.cells, f"at most {MOST_VARIED} cells may differ, because every rank stores them"
        )
        return
    if lattice.profiles or lattice.scatter:
        yield from vary(lattice, lattice.undamped_cell())[1]
    if lattice.absorbing is not None:
        yield from _check_absorbing(lattice, lattice.absorbing, driven)


def check_right_wall(lattice: LatticeTable, key: str) -> list[Problem]:
    """Return problems with a drive that moves the right wall of a valid lattice, by the ``key`` that names this end.

    The springs to the left wall are as the reference cell's, and are checked with it.
    """
    cell = lattice.unit_cell()
    last = lattice.cells - 1
    chain = Chain(cell, lattice.cells, lattice.ends, variation=cell_variation(lattice))
    springs = [chain.spring(last, number) for number, spring in enumerate(cell.springs) if spring.offset]
    if all(spring.is_linear for spring in springs):
        return []
    remedy = f"a wall can only move a linear spring: remove quadratic and cubic in cell {lattice.cells}"
    return [Problem(key, "right", remedy)]


def _check_absorbing(lattice: LatticeTable, absorbing: AbsorbingTable, driven: Sequence[int]) -> Iterator[Problem]:
    """Yield problems with an absorbing end that no wave reaches, or that covers half the lattice or a driven cell."""
    if not lattice.undamped_cell().joins_cells:
        remedy = "without springs from cell to cell no linear waves reach an end; remove it"
        yield Problem("lattice.absorbing", None, remedy)
    if lattice.ends == "periodic":
        yield Problem("lattice.absorbing", None, 'a ring has no end; use ends = "fixed" or "free"')
    # A length that is not given is chosen later, and checked then.
    n = absorbing.cells or 0
    if 2 * n >= lattice.cells:
        yield Problem("lattice.absorbing.cells", n, f"half of the {lattice.cells} cells, or more")
        return

    low = 0
    high = lattice.cells
    if absorbing.end != "right":
        low += n
    if absorbing.end != "left":
        high -= n
    inside = [cell for cell in driven if not low < cell <= high]
    if inside:
        remedy = f"waves are sent from cell {inside[0]}, which is in the absorbing end"
        yield Problem("lattice.absorbing.end", absorbing.end, remedy)
