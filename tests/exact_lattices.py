"""Lattices with cells that differ and are damped, and their exact motion by the matrix exponential."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.linalg import expm

from tests.conftest import small_case
from vipetsc.case import Model
from vipetsc.lattice import Chain, Variation

# Which cells differ from the reference cell: all, every sixth, or none.
Differing = Literal["all", "some", "none"]


def unlike_lattice(ends: str, cells: int, differing: Differing, dashpots: float) -> Model:
    """A four-band lattice whose masses, springs and dashpots differ by up to 30 %.

    ``dashpots`` in N s/m scales those of all springs and of three masses of a cell; there are none at 0.
    """
    model = small_case(lattice={"ends": ends, "cells": cells}, contacts={"sites": [1, 12, cells]}).model()
    cell = model.chain.cell
    if dashpots:
        springs = []
        for number, spring in enumerate(cell.springs):
            springs.append(replace(spring, damping=dashpots * (2.0 + number)))
        grounding = (0.5 * dashpots, dashpots, 0.0, 2 * dashpots)
        cell = replace(cell, springs=tuple(springs), grounding=grounding)
    chain = replace(model.chain, cell=cell)
    if differing == "none":
        return replace(model, chain=chain)

    random = np.random.default_rng(7)
    differs = np.ones(cells, bool) if differing == "all" else np.arange(cells) % 6 == 0
    coefficients = []
    for array in chain.coefficients(0, cells):
        # Cells that differ are alike among themselves, where they are few.
        factors = random.uniform(0.7, 1.3, array.shape if differing == "all" else 1)
        coefficients.append(np.where(differs[:, None], array * factors, array))
    return replace(model, chain=replace(chain, variation=Variation(*coefficients)))


def exponential(chain: Chain, t: float) -> np.ndarray:
    """The exact map exp(A t) of free motion over ``t`` in s, with A = [[0, I], [-M^-1 K, -M^-1 C]].

    Its rows and columns are states: displacements, then velocities, each mass by mass and within a mass cell by cell.
    """
    n = chain.cells
    size = n * chain.cell.dofs
    # Matrices of a chain are ordered cell by cell, states of the propagator mass by mass.
    order = np.arange(size).reshape(n, -1).T.ravel()
    inverse = -1 / chain.masses()[order][:, None]
    system = np.zeros((2 * size, 2 * size))
    system[:size, size:] = np.eye(size)
    system[size:, :size] = inverse * chain.stiffness_matrix().toarray()[np.ix_(order, order)]
    system[size:, size:] = inverse * chain.damping_rows(0, n).toarray()[np.ix_(order, order)]
    return expm(system * t)
