"""Complex bands of damped cells, absorbing ends, and cells that differ by keys of a case file."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import run_of, small_case
from vipetsc.case import Case
from vipetsc.case.warnings import losses
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.ts.integrator import Integrator
from vipetsc.lattice import Chain, bloch, diatomic, four_band, max_group_velocity
from vipetsc.lattice.damped import KAPPAS, damped_bloch, damped_waves, decay_length, fitted_dashpots
from vipetsc.lattice.ends import absorber, reflection

KAPPA = np.linspace(0.2, 3.0, 7)


def damped(cell, alpha=0.0, beta=0.0, extra=(0.0, 0.0, 0.0, 0.0)):
    """``cell`` with Rayleigh damping alpha M + beta K, and ``extra`` dashpots (N s/m) parallel to its springs."""
    springs = tuple(replace(s, damping=beta * s.stiffness + c) for s, c in zip(cell.springs, extra, strict=False))
    return replace(cell, springs=springs, grounding=tuple(alpha * m for m in cell.masses))


@pytest.mark.parametrize("cell", [four_band(), diatomic()])
def test_rayleigh_damping_has_its_closed_form(cell):
    """Damped waves have zeta = (alpha/omega + beta omega)/2, and at a real frequency decay over v_g/(zeta omega)."""
    alpha = 20.0
    beta = 2e-5
    omega = bloch(cell, KAPPA).frequency
    point = damped_bloch(damped(cell, alpha, beta), KAPPA)
    assert point.ratio == pytest.approx((alpha / omega + beta * omega) / 2, rel=1e-10)
    assert np.abs(point.rate) == pytest.approx(omega, rel=1e-10)

    # The decay of weak damping is of first order in it.
    weak = damped(cell, 1e-3 * alpha, 1e-3 * beta)
    _, frequency, speed = max_group_velocity(cell, 2)
    zeta = 1e-3 * (alpha / frequency + beta * frequency) / 2
    assert decay_length(weak, frequency) == pytest.approx(speed / (zeta * frequency), rel=1e-4)
    assert decay_length(cell, frequency) == np.inf


@pytest.mark.parametrize("cell", [four_band(), diatomic()])
def test_waves_of_a_real_frequency_solve_the_bloch_equation(cell):
    """Waves at a frequency of a band satisfy (K(kappa) - omega^2 M) u = 0, where exp(i kappa) is the wave's factor."""
    _, frequency, _ = max_group_velocity(cell, 2)

    waves = damped_waves(cell, frequency)

    for factor, shape in zip(waves.factor, waves.shape.T, strict=True):
        inertia = frequency**2 * np.array(cell.masses) * shape
        residual = cell.stiffness_matrix(np.angle(factor)) @ shape - inertia
        assert np.abs(residual).max() < 1e-8 * frequency**2


def test_overdamped_waves_are_the_slow_ones():
    """The rate of an overdamped wave is the root of s^2 + alpha s + omega^2 = 0, alpha > 2 omega, nearer to zero."""
    alpha = 1e5
    omega = bloch(diatomic(), 1.0).frequency

    rate = damped_bloch(damped(diatomic(), alpha=alpha), 1.0).rate

    slow = -alpha / 2 + np.sqrt(alpha**2 / 4 - omega**2)
    assert np.sort(rate.real) == pytest.approx(np.sort(slow), rel=1e-8)
    assert rate.imag == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("number", [1, 3])
def test_bloch_waves_of_a_damped_ring_decay_with_their_complex_rates(number):
    """The engine ``ts`` moves each wave as u = Re(phi exp(i kappa n + s t)), to 1e-8.

    The damping of the cell is not proportional, so that the shapes phi are complex.
    """
    cells = 8
    half = 4 * cells
    cell = damped(four_band(), 30.0, 1e-5, (0.3, 0.0, 0.1, 0.02))
    model = small_case(contacts={"sites": 0}, lattice={"cells": cells, "ends": "periodic"}).model()
    silent = replace(model.drives[0], waveform=replace(model.drive, amplitude=0.0))
    model = replace(model, chain=Chain(cell, cells, "periodic"), drives=(silent,))
    kappa = 2 * np.pi * number / cells
    point = damped_bloch(cell, kappa)
    end = 0.01

    for s, phi in zip(point.rate, point.vectors.T, strict=True):
        wave = phi * np.exp(1j * kappa * np.arange(cells))[:, None]
        # Velocities are larger than displacements by |s|.
        tight = replace(model, rtol=1e-12, atol=(1e-12, 1e-12 * abs(s)))
        engine = Integrator(tight, Layout(model, MPI.COMM_SELF))
        engine.state.array[:half] = wave.real.T.ravel()
        engine.state.array[half : 2 * half] = (s * wave).real.T.ravel()

        engine.advance(end)

        u = engine.state.array_r[:half].reshape(4, cells).T
        expected = (wave * np.exp(s * end)).real
        assert np.abs(u - expected).max() < 1e-8 * np.abs(expected).max()
        engine.destroy()


def test_a_packet_comes_back_as_computed():
    """A weak absorbing end leaves the predicted fraction of a packet's energy, within ten per cent.

    The prediction is that of the packet's middle frequency; the end reflects its other frequencies differently.
    """
    cell = four_band("calibrated")
    kappa = 1.8
    table = {
        "lattice": {"preset": "four-band", "cells": 130, "absorbing": {"cells": 10, "strength": 400.0}},
        "contacts": {"sites": 0},
        "initial": {"kind": "packet", "band": 2, "wavenumber": kappa, "cell": 70, "width": 8, "amplitude": 1e-3},
        "time": {"end": 0.26, "engine": "propagator"},
    }
    run = run_of(Case.from_table(table))

    energy = (run["energy/kinetic"] + run["energy/spring"]).values
    omega = float(bloch(cell, kappa).frequency[1])
    computed = reflection(absorber(cell, "fixed", 10, 400.0), omega, 10)
    # The reflection is large enough to be measured, and small enough for the end to absorb most of the packet.
    assert 1e-3 < computed < 0.1
    assert energy[-1] / energy[0] == pytest.approx(computed, rel=0.1)


def lossy(cell, loss):
    """``cell`` with dashpots fitted to a ``loss``, a table of loss factors by band number."""
    grounding, springs = fitted_dashpots(cell, tuple(loss.items()))
    return replace(damped(cell, extra=springs.tolist()), grounding=tuple(grounding.tolist()))


@pytest.mark.parametrize("loss", [{2: 0.02}, {2: 0.002, 4: 0.003}, {1: 0.001, 2: 0.001, 3: 0.001, 4: 0.001}])
def test_dashpots_fitted_to_a_loss_are_the_best_by_the_complex_dispersion(loss):
    """Fitted dashpots are not negative, and no change of one by 3 % of the largest comes nearer to the loss."""
    cell = four_band("calibrated")
    bands = np.array([*loss]) - 1

    def ratios(grounding, springs):
        varied = replace(damped(cell, extra=springs), grounding=tuple(grounding))
        return 2 * damped_bloch(varied, KAPPAS).ratio[:, bands] / [*loss.values()]

    def misfit(grounding, springs):
        return float(((ratios(grounding, springs) - 1) ** 2).sum())

    fitted = lossy(cell, loss)
    dashpots = np.array([fitted.grounding, [spring.damping for spring in fitted.springs]])
    assert dashpots.min() >= 0
    if len(loss) == 1:
        # The loss of a single band can be met at all wavenumbers.
        assert ratios(*dashpots) == pytest.approx(1.0, abs=4e-3)

    least = misfit(*dashpots)
    # A minimum over all dashpots is a minimum in each: every one is changed alone, in both directions.
    for place in np.ndindex(dashpots.shape):
        for step in (0.03, -0.03):
            changed = dashpots.copy()
            changed[place] = max(changed[place] + step * dashpots.max(), 0.0)
            assert misfit(*changed) >= least * (1 - 1e-3)


def test_a_loss_by_bands_is_resolved_to_dashpots():
    """A loss by bands becomes dashpots of the resolved case, and a warning gives the loss where it cannot be met."""
    case = small_case(
        lattice={"damping": {"loss": {"2": 0.02}}, "profiles": {"masses[1]": {"cells": [3], "factor": 2.0}}}
    )
    resolved = case.lattice.damping
    chain = case.model().chain

    assert Case.from_toml(case.to_toml()) == case
    assert chain.cell == lossy(four_band("calibrated"), {2: 0.02})
    assert [*chain.cell.grounding] == resolved.grounding
    assert [s.damping for s in chain.cell.springs] == resolved.springs
    # A factor of one mass leaves the dashpots as in all cells.
    assert [name for name, _ in chain.variation.items()] == ["masses"]
    assert chain.is_damped

    asked, least, mean, most = losses(case.lattice)[1]
    assert asked == 0.02
    assert 0.0199 < least < mean < most < 0.0201
    assert mean == pytest.approx(0.02, rel=1e-3)
    assert not any("loss" in sentence for sentence in case.warnings())

    # No dashpots meet the loss in both bands.
    flat = small_case(lattice={"damping": {"loss": {"1": 0.02, "2": 0.02}}})
    assert any("band 1 0.00" in sentence and "requested 0.02" in sentence for sentence in flat.warnings())
