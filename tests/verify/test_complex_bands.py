"""Waves of a damped lattice decay in exact steps as the complex dispersion says."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from tests.exact_lattices import unlike_lattice
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.dynamics.propagator.stencil import HaloRegions, apply_propagator, create_stencil, exchange
from vipetsc.lattice import UnitCell

CELLS = 16
KAPPA = 2 * np.pi * 3 / CELLS


def damped_wave(cell: UnitCell, band: int) -> tuple[complex, np.ndarray]:
    """The complex rate s in 1/s of a wave and its shape (u, s u), from (s^2 M + s C(kappa) + K(kappa)) u = 0."""
    d = cell.dofs
    inverse = np.diag(1 / np.array(cell.masses))
    system = np.zeros((2 * d, 2 * d), complex)
    system[:d, d:] = np.eye(d)
    system[d:, :d] = -inverse @ cell.stiffness_matrix(KAPPA)
    system[d:, d:] = -inverse @ cell.damping_matrix(KAPPA)
    rates, vectors = np.linalg.eig(system)
    # Each conjugate pair counts once, by its rate with a positive imaginary part, in the order of frequencies.
    number = np.argsort(np.where(rates.imag > 0, rates.imag, np.inf))[band]
    return rates[number], vectors[:, number]


@pytest.mark.parametrize("band", [0, 1, 3])
def test_a_bloch_wave_decays_as_the_complex_dispersion_says(band):
    """The propagator moves a damped wave as Re(u exp(i kappa n + s t)) with the complex rate s at a real kappa."""
    model = unlike_lattice("periodic", CELLS, "none", dashpots=0.02)
    chain = model.chain
    layout = Layout(model, MPI.COMM_SELF)
    series = StepSeries(chain, 2e-4, 1e-15)
    halo = HaloRegions(layout)
    stencil = create_stencil(series, layout, halo)
    records = halo.bind_columns([])

    rate, vector = damped_wave(chain.cell, band)
    shape = vector[:, None] * np.exp(1j * KAPPA * np.arange(CELLS))
    # The wave decays until its amplitude has fallen to 1/e.
    steps = int(1 / (-rate.real * series.interval))
    assert 25 < steps < 1500
    state = shape.real.copy()
    out = np.empty_like(state)
    for _ in range(steps):
        exchange(records, 0, state)
        apply_propagator(stencil, state, records.columns, out)
        state, out = out, state

    exact = (shape * np.exp(rate * steps * series.interval)).real
    # The rounding errors of up to 1500 steps add up.
    np.testing.assert_allclose(state, exact, rtol=0, atol=1e-10 * np.abs(exact).max())
