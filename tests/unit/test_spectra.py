"""Spectral measures against waves whose spectrum is known, and their sums against Parseval."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import trapezoid

from vipetsc.lattice import Band, bloch, diatomic, four_band, pass_bands
from vipetsc.spectra import (
    Dispersion,
    Parts,
    dispersion,
    front_arrival,
    ibtet,
    kinetic_energy,
    part_energies,
    ridge,
    split,
    taper,
    wavenumber_content,
)

MASSES = (0.5, 2.0)


def noise(shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape)


@pytest.mark.parametrize(("row", "direction"), [(5, 1), (5, -1), (12, 1)])
def test_a_plane_wave_lands_on_its_bin(row, direction):
    nt, n, interval, column = 128, 48, 0.01, 17
    kappa, omega = direction * 2 * np.pi * row / n, 2 * np.pi * column / (nt * interval)
    t, x = np.arange(nt)[:, None] * interval, np.arange(n)
    velocity = np.cos(kappa * x - omega * t)[..., None]
    found = dispersion(velocity, [2.0], interval, tapers=(0, 0))
    k, w = np.unravel_index(np.argmax(found.energy), found.energy.shape)
    assert found.wavenumber[k] == pytest.approx(kappa)
    assert found.frequency[w] == pytest.approx(omega)
    assert found.energy[k, w] == pytest.approx(0.5 * 2 * n * 0.5)  # m/2 sum of cos^2
    assert np.delete(found.energy.ravel(), found.energy.argmax()).max() < 1e-20
    fold = found.folded()
    k, w = np.unravel_index(np.argmax(fold.energy), fold.energy.shape)
    assert fold.wavenumber[k] == pytest.approx(abs(kappa))


@settings(max_examples=30)
@given(st.integers(2, 40), st.integers(2, 40), st.integers(0, 99))
def test_energies_obey_parseval(nt, n, seed):
    velocity = noise((nt, n, 2), seed)
    kinetic = kinetic_energy(velocity, MASSES)
    assert kinetic.sum() == pytest.approx(0.5 * np.sum(np.array(MASSES) * velocity**2), rel=1e-12)
    wavenumber, content = wavenumber_content(velocity, MASSES)
    assert np.allclose(content.sum(axis=1), kinetic.sum(axis=1), rtol=1e-12)
    assert wavenumber[0] == 0
    assert wavenumber[-1] <= np.pi * (1 + 1e-15)
    found = dispersion(velocity, MASSES, 0.1, tapers=(0, 0))
    assert found.energy.sum() == pytest.approx(kinetic.sum(axis=1).mean(), rel=1e-12)
    assert np.all(np.diff(found.wavenumber) > 0)
    fold = found.folded()
    assert fold.energy.shape == (len(fold.wavenumber), len(fold.frequency))
    assert fold.energy.sum() == pytest.approx(found.energy.sum(), rel=1e-12)


@settings(max_examples=30)
@given(st.integers(2, 60), st.integers(1, 5), st.integers(0, 99), st.lists(st.floats(1, 40), max_size=5, unique=True))
def test_parts_are_a_partition(nt, n, seed, inner):
    edges = np.array([0.0, *sorted(inner), np.inf])
    signal = noise((nt, n), seed)
    parts = list(split(signal, 0.1, edges))
    assert np.allclose(sum(parts), signal, atol=1e-12)
    weights = np.ones(nt)
    weights[[0, -1]] = 0.5
    energies = [np.sum(weights[:, None] * p**2) for p in parts]
    assert sum(energies) == pytest.approx(np.sum(weights[:, None] * signal**2), rel=1e-12)


def test_part_energies_add_up_and_do_not_depend_on_blocks(monkeypatch):
    velocity, edges = noise((64, 10, 2)), [0.0, 8.0, 20.0, np.inf]
    energy = part_energies(velocity, MASSES, 0.1, edges)
    total = kinetic_energy(velocity, MASSES).sum(axis=1)
    assert trapezoid(energy.sum(axis=0)) == pytest.approx(trapezoid(total), rel=1e-12)
    monkeypatch.setattr("vipetsc.spectra.bands.BLOCK", 64 * 3)
    assert np.allclose(part_energies(velocity, MASSES, 0.1, edges), energy, rtol=1e-12)
    (middle,) = split(velocity, 0.1, edges[1:3])
    assert np.allclose(kinetic_energy(middle, MASSES).sum(axis=1), energy[1], rtol=1e-12)


def test_a_tone_stays_in_its_part():
    t = np.arange(2001) * 1e-3
    velocity = (1 - np.cos(np.pi * t))[:, None, None] * np.sin(200 * t)[:, None, None]
    energy = part_energies(velocity, [1.0], 1e-3, [0.0, 100.0, 300.0, np.inf]).sum(axis=1)
    assert energy[1] / energy.sum() > 1 - 1e-6


def test_parts_name_bands_and_gaps():
    parts = Parts.of(pass_bands(four_band("calibrated")))
    assert parts.names == ("band 1", "gap 1", "band 2", "gap 2", "band 3", "gap 3", "band 4", "above")
    assert np.allclose(parts.edges[1:-1], [612.25, 681.48, 1414.21, 2267.36, 3162.28, 3214.90, 3644.75], atol=0.006)
    assert [parts.names[i] for i in np.nonzero(parts.above(1023.27))[0]] == ["band 3", "band 4"]
    assert not Parts.of(pass_bands(diatomic())).above(5520.0).any()
    merged = Parts.of([Band(1, 0.0, 2.0), Band(2, 1.0, 3.0), Band(3, 5.0, 6.0)])
    assert merged.bands == ((1, 2), (), (3,), ())
    assert merged.edges.tolist() == [0, 3, 5, 6, np.inf]
    assert Parts.of([Band(1, 4.0, 6.0)]).names == ("gap 1", "band 1", "above")
    assert list(Parts.of([Band(1, 0.0, 5.0), Band(2, 1.0, 3.0), Band(3, 6.0, 7.0)]).edges) == [0, 5, 6, 7, np.inf]
    assert Parts.of([Band(1, 1e-9, 6.0)]).names == ("band 1", "above")  # a free lattice's zero, rounded


def test_transfer_is_the_mean_share_after_arrival():
    energy = np.array([[1.0, 1.0, 3.0], [0.0, 1.0, 1.0]])
    above = np.array([False, True])
    assert ibtet(energy, above, 1) == pytest.approx((0.5 + 0.25) / 2)
    assert np.isnan(ibtet(energy, ~above & above))
    assert np.isnan(ibtet(0 * energy, above))
    assert front_arrival(np.array([0, 1e-4, 0.02, 1.0, 0.5])) == 2


def test_taper_keeps_the_mean_square():
    for fraction in (0.0, 0.1, 1.0):
        window = taper(101, fraction)
        assert np.mean(window**2) == pytest.approx(1, rel=1e-14)
        assert np.allclose(window, window[::-1])
    assert taper(101, 0.2)[0] < 1e-2


def test_ridge_of_a_packet_lies_on_the_branch():
    """A packet on band 2 of the four-band cell, made of its Bloch modes."""
    cell, n, interval = four_band("calibrated"), 128, 4e-4
    rows = np.arange(28, 46)
    kappa = 2 * np.pi * rows / n
    weight = np.exp(-(((rows - 37) / 4) ** 2))
    omega = bloch(cell, kappa).frequency[:, 1]
    t, x = np.arange(1200) * interval, np.arange(n)
    waves = np.exp(-1j * omega * t[:, None]) * weight
    velocity = (waves @ np.exp(1j * kappa[:, None] * (x - 40))).real[..., None]
    found, frequency = ridge(dispersion(velocity, [1.0], interval, tapers=(1, 0)), floor=1e-2)
    assert len(found) >= 10
    assert np.all(found > 0)  # the packet travels one way only
    branch = bloch(cell, found).frequency[:, 1]
    assert np.abs(frequency / branch - 1).max() < 1e-3
    bins = 2 * np.pi / (1200 * interval)
    assert np.abs(frequency - branch).max() < 0.1 * bins  # refined off the grid


def test_ridge_leaves_quiet_wavenumbers_out():
    energy = np.full((3, 5), 1e-9)
    energy[1] = [1e-9, 0.5, 1.0, 0.5, 1e-9]
    found, frequency = ridge(Dispersion(np.arange(3.0), np.arange(5.0), energy))
    assert found.tolist() == [1.0]
    assert frequency == pytest.approx(2.0)
