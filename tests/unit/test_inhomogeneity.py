"""Dashpots and cells that differ: matrices against an assembly spring by spring, and what a case file says."""

from dataclasses import replace

import numpy as np
import pytest

from vipetsc.case import Case, CaseError
from vipetsc.lattice import Chain, UnitCell, Variation, four_band

CELLS = 6
ENDS = ["fixed", "free", "periodic"]


def varied(ends="fixed", seed=1, **arrays):
    """A damped four-band lattice, every mass, spring and dashpot of which is another."""
    cell = replace(
        four_band(),
        springs=tuple(replace(s, damping=0.1 * i) for i, s in enumerate(four_band().springs)),
        grounding=(0.0, 0.2, 0.0, 0.1),
    )
    scatter = np.random.default_rng(seed).uniform(0.8, 1.2, (4, CELLS, 4))
    reference = Chain(cell, CELLS).coefficients(0, CELLS)
    values = {name: factor * array for name, factor, array in zip(reference._fields, scatter, reference, strict=True)}
    return Chain(cell, CELLS, ends, variation=Variation(**values | arrays))


def assembled(chain: Chain, of_springs: np.ndarray, of_walls: list[float]) -> np.ndarray:
    """The matrix of springs (cell, spring) that are added one by one; ``of_walls`` are those of cell -1."""
    n, d = chain.cells, chain.cell.dofs
    matrix = np.zeros((n * d, n * d))
    for i in range(-1, n):
        for s, spring in enumerate(chain.cell.springs):
            row = np.zeros(n * d)
            first, second = i, i + spring.next_cell
            if chain.ends == "periodic":
                second %= n
            inside = [0 <= cell < n for cell in (first, second)]
            if first < 0 and (chain.ends == "periodic" or not spring.next_cell):
                continue
            if not any(inside) or (chain.ends == "free" and not all(inside)):
                continue
            if inside[1]:
                row[second * d + spring.end] += 1
            if inside[0]:
                row[first * d + spring.start] -= 1
            matrix += np.outer(row, row) * (of_springs[i, s] if i >= 0 else of_walls[s])
    return matrix


@pytest.mark.parametrize("ends", ENDS)
def test_rows_are_those_of_an_assembly_spring_by_spring(ends):
    chain = varied(ends)
    springs, n = chain.cell.springs, chain.cells
    k = assembled(chain, chain.variation.stiffness, [s.stiffness for s in springs])
    c = assembled(chain, chain.variation.damping, [s.damping for s in springs])
    c += np.diag(chain.variation.grounding.ravel())
    for expected, rows in ((k, chain.stiffness_rows), (c, chain.damping_rows)):
        whole = rows(0, n).toarray()
        assert np.allclose(whole, expected, rtol=1e-14, atol=1e-12 * np.abs(expected).max())
        assert np.array_equal(whole, whole.T)
        assert np.array_equal(np.vstack([rows(a, b).toarray() for a, b in ((0, 1), (1, 4), (4, n))]), whole)
    assert np.array_equal(chain.masses(), chain.variation.masses.ravel())


@pytest.mark.parametrize("ends", ENDS)
def test_a_variation_that_changes_nothing_leaves_the_bits(ends):
    cell = four_band()
    plain = Chain(cell, CELLS, ends)
    values = plain.coefficients(0, CELLS)
    same = Chain(cell, CELLS, ends, variation=Variation(values.masses, stiffness=values.stiffness))
    assert same.is_uniform()
    assert not same.is_damped
    assert np.array_equal(same.stiffness_rows(0, CELLS).toarray(), plain.stiffness_rows(0, CELLS).toarray())
    assert np.array_equal(same.masses(), plain.masses())
    assert plain.damping_rows(1, 3).nnz == 0


def test_cells_beyond_the_ends():
    fixed, ring = varied(), varied("periodic")
    values = ring.variation.stiffness
    assert np.array_equal(ring.coefficients(-2, CELLS + 1).stiffness, values[[-2, -1, *range(CELLS), 0]])
    reference = [s.stiffness for s in fixed.cell.springs]
    beyond = fixed.coefficients(-1, CELLS + 1).stiffness
    assert np.array_equal(beyond, np.vstack([reference, values, reference]))


def test_where_cells_differ():
    masses = np.tile(four_band().masses, (CELLS, 1))
    masses[4, 2] *= 1.1
    chain, ring = (Chain(four_band(), CELLS, ends, variation=Variation(masses)) for ends in ("fixed", "periodic"))
    assert chain.differs.tolist() == [False] * 4 + [True, False]
    assert chain.is_uniform(-3, 4)
    assert chain.is_uniform(5, 12)
    assert not chain.is_uniform(4, 5)
    assert not ring.is_uniform(-3, 0)
    damped = Chain(four_band(), CELLS, variation=Variation(grounding=0.1 * (masses > 0)))
    assert damped.is_damped
    assert not chain.is_damped


def test_variations_are_equal_by_what_they_hold():
    one, same, other = varied(), varied(), varied(seed=2)
    assert one == same
    assert hash(one) == hash(same)
    assert one != other
    with pytest.raises(ValueError, match="read-only"):
        one.variation.masses[0, 0] = 1.0
    with pytest.raises(ValueError, match="shape"):
        replace(one, cells=5)


def test_dashpots_of_a_case():
    table = {
        "lattice": {
            "cell": {
                "masses": [0.01, 0.02],
                "springs": [
                    {"start": 1, "end": 1, "stiffness": 9e3, "next_cell": True, "damping": 0.5},
                    {"start": 1, "end": 2, "stiffness": 5e3},
                ],
                "contact": [1, 2],
                "grounding": [0.0, 0.3],
            },
            "damping": {"mass": 2.0, "stiffness": 1e-5},
            "cells": 10,
        },
        "drive": {"frequency": 100.0},
    }
    case = Case.from_table(table)
    cell = case.model().chain.cell
    assert [s.damping for s in cell.springs] == pytest.approx([0.5 + 0.09, 0.05])
    assert cell.grounding == pytest.approx((0.02, 0.3 + 0.04))
    assert Case.from_toml(case.to_toml()) == case
    bloch = UnitCell(cell.masses, cell.springs, 0, 1, cell.grounding).damping_matrix(np.pi)
    assert bloch == pytest.approx(np.array([[4 * 0.59 + 0.07, -0.05], [-0.05, 0.39]]))
    wrong = table["lattice"]["cell"] | {"grounding": [-1.0]}
    with pytest.raises(CaseError) as error:
        Case.from_table(table | {"lattice": table["lattice"] | {"cell": wrong, "damping": {"mass": -1.0}}})
    told = str(error.value)
    assert "lattice.damping.mass" in told
    wrong["springs"] = [wrong["springs"][0] | {"damping": -1.0}, wrong["springs"][1]]
    with pytest.raises(CaseError) as error:
        Case.from_table(table | {"lattice": {"cell": wrong}})
    told = str(error.value)
    assert "lattice.cell.springs[1].damping" in told
    assert "lattice.cell.grounding" in told
