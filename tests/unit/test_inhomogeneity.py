"""Dashpots and cells that differ: matrices against an assembly spring by spring, and the keys of a case file."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.assembly import assembled
from vipetsc.case import Case
from vipetsc.lattice import Chain, UnitCell, Variation, four_band

CELLS = 6
ENDS = pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])


def scattered_chain(ends: str = "fixed", seed: int = 1) -> Chain:
    """Return a damped four-band lattice whose masses, springs and dashpots all differ."""
    springs = []
    for number, spring in enumerate(four_band().springs):
        springs.append(replace(spring, damping=0.1 * number))
    cell = replace(four_band(), springs=tuple(springs), grounding=(0.0, 0.2, 0.0, 0.1))

    reference = Chain(cell, CELLS).coefficients(0, CELLS)._asdict()
    factors = np.random.default_rng(seed).uniform(0.8, 1.2, (4, CELLS, 4))
    values = {}
    for (name, array), factor in zip(reference.items(), factors, strict=True):
        values[name] = factor * array
    return Chain(cell, CELLS, ends, variation=Variation(**values))


@ENDS
def test_rows_are_those_of_an_assembly_spring_by_spring(ends):
    """Rows of stiffness and damping are symmetric and those of an assembly; rows of ranks have their bits."""
    chain = scattered_chain(ends)
    springs = chain.cell.springs
    stiffness = assembled(chain, chain.variation.stiffness, [s.stiffness for s in springs])
    damping = assembled(chain, chain.variation.damping, [s.damping for s in springs])
    damping += np.diag(chain.variation.grounding.ravel())

    for expected, rows in ((stiffness, chain.stiffness_rows), (damping, chain.damping_rows)):
        whole = rows(0, CELLS).toarray()
        assert np.allclose(whole, expected, rtol=1e-14, atol=1e-12 * np.abs(expected).max())
        assert np.array_equal(whole, whole.T)
        # The rows of ranks are those of the whole, bit for bit.
        parts = [rows(first, last).toarray() for first, last in ((0, 1), (1, 4), (4, CELLS))]
        assert np.array_equal(np.vstack(parts), whole)
    assert np.array_equal(chain.masses(), chain.variation.masses.ravel())


@ENDS
def test_a_variation_that_changes_nothing_leaves_the_bits(ends):
    """A variation with the reference's numbers is uniform and has the bits of the matrices without it."""
    plain = Chain(four_band(), CELLS, ends)
    values = plain.coefficients(0, CELLS)
    same = Chain(four_band(), CELLS, ends, variation=Variation(values.masses, stiffness=values.stiffness))
    assert same.is_uniform()
    assert not same.is_damped
    assert np.array_equal(same.stiffness_rows(0, CELLS).toarray(), plain.stiffness_rows(0, CELLS).toarray())
    assert np.array_equal(same.masses(), plain.masses())
    assert plain.damping_rows(1, 3).nnz == 0


def test_cells_beyond_the_ends_of_a_ring_are_those_of_its_other_end():
    ring = scattered_chain("periodic")
    values = ring.variation.stiffness
    assert np.array_equal(ring.coefficients(-2, CELLS + 1).stiffness, values[[-2, -1, *range(CELLS), 0]])


def test_cells_beyond_fixed_ends_are_reference_cells():
    fixed = scattered_chain()
    reference = [s.stiffness for s in fixed.cell.springs]
    found = fixed.coefficients(-1, CELLS + 1).stiffness
    assert np.array_equal(found, np.vstack([reference, fixed.variation.stiffness, reference]))


def damped_table(lattice: dict[str, Any] | None = None, **cell: Any) -> dict[str, Any]:
    """Return the table of a case with dashpots of each kind; ``lattice`` and ``cell`` update it."""
    damped_cell = {
        "masses": [0.01, 0.02],
        "springs": [
            {"start": 1, "end": 1, "stiffness": 9e3, "next_cell": True, "damping": 0.5},
            {"start": 1, "end": 2, "stiffness": 5e3},
        ],
        "contact": [1, 2],
        "grounding": [0.0, 0.3],
    }
    damped_lattice = {"cell": damped_cell | cell, "damping": {"mass": 2.0, "stiffness": 1e-5}, "cells": 10}
    return {"lattice": damped_lattice | (lattice or {}), "drive": {"frequency": 100.0}}


def test_rayleigh_damping_is_added_to_the_dashpots_of_a_case():
    """A spring k gets the dashpot c + b k and a mass m the dashpot g + a m to the ground, with the case's a and b."""
    case = Case.from_table(damped_table())
    cell = case.model().chain.cell
    # Dashpots of a spring get 1e-5 s of its stiffness, those of a mass 2/s of the mass.
    assert [s.damping for s in cell.springs] == pytest.approx([0.5 + 0.09, 0.05])
    assert cell.grounding == pytest.approx((0.02, 0.3 + 0.04))
    assert Case.from_toml(case.to_toml()) == case

    # At the wavenumber pi the dashpot c to the next cell adds 4 c to the diagonal.
    bloch = UnitCell(cell.masses, cell.springs, 0, 1, cell.grounding).damping_matrix(np.pi)
    assert bloch == pytest.approx(np.array([[4 * 0.59 + 0.07, -0.05], [-0.05, 0.39]]))
