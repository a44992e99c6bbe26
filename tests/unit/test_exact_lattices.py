"""Exact steps, with dashpots and cells that differ too, against the matrix exponential of the whole lattice."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from scipy.linalg import expm

from tests.conftest import small_case
from vipetsc.case import Model
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.clusters import (
    apply_impulses,
    create_dof_tables,
    create_responses,
    expand_free_motion,
    group_dofs,
)
from vipetsc.dynamics.propagator.series import StepSeries, evaluate
from vipetsc.dynamics.propagator.stencil import HaloRegions, apply_propagator, create_stencil, exchange
from vipetsc.lattice import Chain, Variation
from vipetsc.lattice.chain import Pair

VARIED = ("all", "some", "none")


def lattice(ends: str, cells: int, varied: str, damped: float) -> Model:
    """Cells of which all, every sixth, or none differ from the reference cell, with dashpots of so much."""
    model = small_case(lattice={"ends": ends, "cells": cells}, contacts={"sites": [1, 12, cells]}).model()
    cell = model.chain.cell
    if damped:
        springs = tuple(replace(spring, damping=damped * (2.0 + i)) for i, spring in enumerate(cell.springs))
        cell = replace(cell, springs=springs, grounding=(0.5 * damped, damped, 0.0, 2 * damped))
    chain = replace(model.chain, cell=cell)
    random = np.random.default_rng(7)
    every = {"all": np.ones(cells, bool), "some": np.arange(cells) % 6 == 0, "none": np.zeros(cells, bool)}[varied]
    of_cells = [
        np.where(every[:, None], array * random.uniform(0.7, 1.3, array.shape if varied == "all" else 1), array)
        for array in chain.coefficients(0, cells)
    ]
    return replace(model, chain=chain if varied == "none" else replace(chain, variation=Variation(*of_cells)))


def exponential(chain: Chain, t: float) -> np.ndarray:
    """The exact P(t), states ordered as (2 dof, cell)."""
    n = chain.cells
    size = chain.cells * chain.cell.dofs
    order = np.arange(size).reshape(n, -1).T.ravel()  # mass by mass
    system = np.zeros((2 * size, 2 * size))
    inverse = -1 / chain.masses()[order][:, None]
    system[:size, size:] = np.eye(size)
    system[size:, :size] = inverse * chain.stiffness_matrix().toarray()[np.ix_(order, order)]
    system[size:, size:] = inverse * chain.damping_rows(0, n).toarray()[np.ix_(order, order)]
    return expm(system * t)


EVERY = pytest.mark.parametrize(
    ("ends", "varied", "damped"),
    [
        ("fixed", "all", False),
        ("free", "all", True),
        ("periodic", "all", True),
        ("periodic", "some", False),
        ("free", "some", True),
        ("fixed", "some", False),
        ("fixed", "none", True),
        ("fixed", "none", False),
        ("free", "none", False),
        ("periodic", "none", False),
    ],
)


@pytest.mark.slow
@EVERY
def test_a_step_is_the_exponential_within_its_bound(ends, varied, damped):
    model = lattice(ends, 24, varied, damped)
    layout = Layout(model, MPI.COMM_SELF)
    for interval, tolerance in ((1.5e-4, 1e-15), (3e-4, 1e-7)):
        series = StepSeries(model.chain, interval, tolerance)
        halo = HaloRegions(layout)
        stencil = create_stencil(series, layout, halo)
        records = halo.bind_columns([])
        rows = 2 * layout.dofs
        n = layout.cells
        matrix = np.empty((rows * n, rows * n))
        for column, unit in enumerate(np.eye(rows * n)):
            state = unit.reshape(rows, n)
            out = np.empty((rows, n))
            exchange(records, 0, state)
            apply_propagator(stencil, state, records.columns, out)
            matrix[:, column] = out.ravel()
        # A velocity counts as omega u.
        scale = np.repeat([series.omega_max_h / interval, 1.0], rows * n // 2)
        error = np.abs(matrix - exponential(model.chain, interval)) * scale[:, None] / scale
        assert error.sum(axis=1).max() <= series.truncation + 2e-14
        assert series.truncation < tolerance


# Sites of any pairs: the cell's, ground and a mass, masses of neighbours, two contacts in one cell, next to others.
PAIRS = {0: Pair(-1, 1), 1: Pair(0, 3, True), 2: Pair(3, 0), 3: Pair(1, 2), 11: Pair(2, 2, True), 22: Pair(1, 0, True)}


@pytest.mark.slow
@pytest.mark.parametrize("own", [True, False])
@EVERY
def test_free_motion_and_impulses_are_the_exponential(ends, varied, damped, own):
    """Of contacts and driven masses, those near an end and across the joint of a ring among them."""
    model = lattice(ends, 24, varied, damped)
    if not own:
        pairs = PAIRS | {23: Pair(2, 0, True) if ends == "periodic" else Pair(-1, 3)}
        chain = replace(model.chain, sites=(*pairs, 11), pairs=(*pairs.values(), Pair(-1, 2)), clearances=(1e-4,) * 8)
        model = replace(model, chain=chain)
    layout = Layout(model, MPI.COMM_SELF)
    series = StepSeries(model.chain, 2e-4, 1e-15)
    groups = group_dofs(model, series.reach)
    halo = HaloRegions(layout)
    tables = create_dof_tables(groups, model, layout, series, halo)
    response = create_responses(groups, tables, model, series)
    records = halo.bind_columns([])
    d = layout.dofs
    n = layout.cells
    state = np.random.default_rng(5).normal(size=(2 * d, n)) * np.repeat([1e-4, 0.1], d)[:, None]
    exchange(records, 0, state)
    taylor = np.zeros((len(groups.numbers), 2 * series.terms))
    for c in range(len(groups.first) - 1):
        expand_free_motion(tables, c, records.columns, taylor)
    step = exponential(model.chain, 0.7 * series.interval)
    exact = (step @ state.ravel()).reshape(2 * d, n)
    masses = model.chain.masses().reshape(n, d)
    forms = np.zeros((len(taylor), d, n))
    for form, number in zip(forms, groups.numbers, strict=True):
        drive = model.drives[max(-1 - number, 0)]
        site = max(number, 0)
        pair, cell = (model.chain.contact_pairs[site], model.chain.sites[site]) if number >= 0 else (None, drive.cell)
        form[pair.resonator if pair else drive.mass, (cell + (pair is not None and pair.next_cell)) % n] += 1
        if pair and pair.host >= 0:
            form[pair.host, cell] -= 1
    powers = 0.7 ** (1 + np.arange(response.shape[2]) * (1 if damped else 2))
    for i, form in enumerate(forms):
        w, rate = evaluate(taylor[i], 0.7)
        assert w == pytest.approx(np.sum(form * exact[:d]), rel=1e-11, abs=1e-17)
        assert rate / series.interval == pytest.approx(np.sum(form * exact[d:]), rel=1e-11)
        # An impulse on the DoF at .3 of the step.
        moments = 0.7 ** np.arange(2 * series.terms)[None]
        out = np.zeros((2 * d, n))
        apply_impulses(tables, i, moments, out)
        left = step @ np.append(np.zeros(d * n), form / masses.T)
        for part, expected in zip(out.reshape(2, -1), left.reshape(2, -1), strict=True):
            np.testing.assert_allclose(part, expected, rtol=0, atol=1e-13 * np.abs(expected).max())
        c = np.searchsorted(groups.first, i, side="right") - 1
        members = slice(*groups.first[c : c + 2])
        moved = forms[members].reshape(-1, d * n) @ left[: d * n] * series.interval
        felt = response[members, i - groups.first[c]] @ powers
        np.testing.assert_allclose(felt, moved, rtol=0, atol=1e-13 * np.abs(moved).max())


@pytest.mark.parametrize("band", [0, 1, 3])
def test_a_bloch_wave_decays_as_the_complex_dispersion_says(band):
    model = lattice("periodic", 16, "none", 0.02)
    chain = model.chain
    layout = Layout(model, MPI.COMM_SELF)
    d = model.chain.cell.dofs
    kappa = 2 * np.pi * 3 / 16
    series = StepSeries(chain, 2e-4, 1e-15)
    halo = HaloRegions(layout)
    # (s^2 M + s C(kappa) + K(kappa)) u = 0 as a linear problem.
    inverse = np.diag(1 / np.array(chain.cell.masses))
    zero = np.zeros((d, d))
    one = np.eye(d)
    blocks = [[zero, one], [-inverse @ chain.cell.stiffness_matrix(kappa), -inverse @ chain.cell.damping_matrix(kappa)]]
    rates, vectors = np.linalg.eig(np.block(blocks))
    number = np.argsort(np.where(rates.imag > 0, rates.imag, np.inf))[band]
    rate = rates[number]
    shape = vectors[:, number, None] * np.exp(1j * kappa * np.arange(16))
    steps = int(4 / (-rate.real * series.interval))
    assert 100 < steps < 6000
    stencil = create_stencil(series, layout, halo)
    records = halo.bind_columns([])
    state = shape.real.copy()
    out = np.empty_like(shape.real)
    for _ in range(steps):
        exchange(records, 0, state)
        apply_propagator(stencil, state, records.columns, out)
        state, out = out, state
    exact = (shape * np.exp(rate * steps * series.interval)).real
    np.testing.assert_allclose(state, exact, rtol=0, atol=1e-10 * np.abs(exact).max())
