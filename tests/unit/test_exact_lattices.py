"""Exact steps against the matrix exponential of the whole lattice, also with dashpots and with cells that differ."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest

from tests.exact_lattices import exponential, unlike_lattice
from vipetsc.case import Model
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.dof_tables import (
    apply_impulses,
    create_dof_tables,
    create_responses,
    expand_free_motion,
)
from vipetsc.dynamics.propagator.groups import group_dofs
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.dynamics.propagator.stencil import HaloRegions, apply_propagator, create_stencil, exchange
from vipetsc.dynamics.propagator.taylor import evaluate
from vipetsc.lattice.sites import Pair, sites_at

CELLS = 24
LATTICES = pytest.mark.parametrize(
    ("ends", "differing", "damped"),
    [
        ("fixed", "all", False),
        ("free", "all", True),
        ("periodic", "all", True),
        ("periodic", "some", False),
        ("free", "some", True),
        ("fixed", "none", True),
        ("free", "none", False),
    ],
)


@pytest.mark.parametrize(("interval", "tolerance"), [(1.5e-4, 1e-15), (3e-4, 1e-7)])
@LATTICES
def test_a_step_is_the_exponential_within_its_bound(ends, differing, damped, interval, tolerance):
    """A step differs from exp(A H) by no more than the truncation of its series, which is below the tolerance."""
    model = unlike_lattice(ends, CELLS, differing, dashpots=float(damped))
    layout = Layout(model, MPI.COMM_SELF)
    series = StepSeries(model.chain, interval, tolerance)
    halo = HaloRegions(layout)
    stencil = create_stencil(series, layout, halo)
    records = halo.bind_columns([])

    rows = 2 * layout.dofs
    size = rows * CELLS
    step = np.empty((size, size))
    for column, unit in enumerate(np.eye(size)):
        state = unit.reshape(rows, CELLS)
        out = np.empty((rows, CELLS))
        exchange(records, 0, state)
        apply_propagator(stencil, state, records.columns, out)
        step[:, column] = out.ravel()

    # Errors of displacements are multiplied by omega_max, so that they compare with those of velocities.
    scale = np.repeat([series.omega_max_h / interval, 1.0], size // 2)
    error = np.abs(step - exponential(model.chain, interval)) * scale[:, None] / scale
    assert error.sum(axis=1).max() <= series.truncation + 2e-14
    assert series.truncation < tolerance


# Pairs at sites with these indices of cells: ground and a mass, masses of one cell or of neighbours, both directions.
PAIRS = {
    0: Pair(-1, 1),
    1: Pair(0, 3, offset=1),
    2: Pair(3, 0),
    3: Pair(1, 2),
    11: Pair(2, 2, offset=1),
    22: Pair(1, 0, offset=1),
}


def with_any_pairs(model: Model) -> Model:
    """Return the model with contacts of ``PAIRS``, a second one in cell 12, and one in the last cell."""
    ends_on_ring = model.chain.ends == "periodic"
    pairs = PAIRS | {CELLS - 1: Pair(2, 0, offset=1) if ends_on_ring else Pair(-1, 3)}
    law = model.chain.sites[0].law
    sites = sites_at([*pairs, 11], [*pairs.values(), Pair(-1, 2)], law, clearances=1e-4)
    return replace(model, chain=replace(model.chain, sites=sites))


def displacement_forms(model: Model, numbers: np.ndarray) -> np.ndarray:
    """Return forms (number, dof, cell) that yield w of a site, or the displacement of a driven mass (-1 - drive)."""
    chain = model.chain
    forms = np.zeros((len(numbers), chain.cell.dofs, chain.cells))
    for form, number in zip(forms, numbers, strict=True):
        if number < 0:
            drive = model.drives[-1 - number]
            form[drive.mass, drive.cell] = 1
            continue
        cell = chain.sites[number].cell
        pair = chain.sites[number].pair
        form[pair.resonator, (cell + pair.offset) % chain.cells] += 1
        if pair.host >= 0:
            form[pair.host, cell] -= 1
    return forms


@pytest.mark.parametrize("pairs", ["the cell's pair", "any pairs"])
@LATTICES
def test_free_motion_and_impulses_are_the_exponential(ends, differing, damped, pairs):
    """Free motion, impulses and responses of all contact DoFs at 0.7 of a step are those of the matrix exponential.

    Contacts and driven masses near an end and across the joint of a ring are among them.
    """
    model = unlike_lattice(ends, CELLS, differing, dashpots=float(damped))
    if pairs == "any pairs":
        model = with_any_pairs(model)
    layout = Layout(model, MPI.COMM_SELF)
    series = StepSeries(model.chain, 2e-4, 1e-15)
    groups = group_dofs(model, series.reach)
    halo = HaloRegions(layout)
    tables = create_dof_tables(groups, model, layout, series, halo)
    response = create_responses(groups, tables, model, series)
    records = halo.bind_columns([])
    d = layout.dofs
    n = layout.cells

    # Displacements and velocities of comparable energies.
    state = np.random.default_rng(5).normal(size=(2 * d, n)) * np.repeat([1e-4, 0.1], d)[:, None]
    exchange(records, 0, state)
    taylor = np.zeros((len(groups.numbers), 2 * series.terms))
    for cluster in range(len(groups.first) - 1):
        expand_free_motion(tables, cluster, records.columns, taylor)

    # The motion is compared at 0.7 of the step.
    step = exponential(model.chain, 0.7 * series.interval)
    exact = (step @ state.ravel()).reshape(2 * d, n)
    forms = displacement_forms(model, groups.numbers)
    for series_of_dof, form in zip(taylor, forms, strict=True):
        w, rate = evaluate(series_of_dof, 0.7)
        assert w == pytest.approx(np.sum(form * exact[:d]), rel=1e-11, abs=1e-17)
        assert rate / series.interval == pytest.approx(np.sum(form * exact[d:]), rel=1e-11)

    masses = model.chain.masses().reshape(n, d)
    powers = 0.7 ** (1 + np.arange(response.shape[2]) * (1 if damped else 2))
    for i, form in enumerate(forms):
        # An impulse on the DoF at 0.3 of the step has acted for 0.7 of it at the end.
        moments = 0.7 ** np.arange(2 * series.terms)[None]
        out = np.zeros((2 * d, n))
        apply_impulses(tables, i, moments, out)
        exact = step @ np.append(np.zeros(d * n), form / masses.T)
        for part, expected in zip(out.reshape(2, -1), exact.reshape(2, -1), strict=True):
            np.testing.assert_allclose(part, expected, rtol=0, atol=1e-13 * np.abs(expected).max())

        # The responses of the DoFs in the same cluster are power series in the time since the impulse.
        cluster = np.searchsorted(groups.first, i, side="right") - 1
        members = slice(*groups.first[cluster : cluster + 2])
        expected = forms[members].reshape(-1, d * n) @ exact[: d * n] * series.interval
        found = response[members, i - groups.first[cluster]] @ powers
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * np.abs(expected).max())
