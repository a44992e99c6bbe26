"""Energies of the linear modes: they sum to the lattice's energy, stay constant, and belong to their bands."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from vipetsc.lattice import Chain, Spring, ToneBurst, UnitCell, diatomic, four_band, linear_modes, modes, pass_bands
from vipetsc.spectra import ModalParts, upper_share
from vipetsc.spectra.modal_energies import cluster_samples

CELLS = {
    "four-band": four_band("calibrated"),
    "diatomic": diatomic("calibrated"),
    "asymmetric": UnitCell((1.0, 2.0, 0.5), (Spring(0, 1, 3.0), Spring(1, 2, 1.0), Spring(2, 0, 2.0, True)), 0, 1),
}


def fields(chain, count=3, seed=1):
    """Displacements and velocities (t, cell, dof) of noise with comparable spring and kinetic energies."""
    u, v = np.random.default_rng(seed).standard_normal((2, count, chain.cells, chain.cell.dofs))
    return u, v * pass_bands(chain.cell)[-1].high


def energy(chain, u, v):
    """Kinetic and spring energy (t)."""
    u, v = u.reshape(len(u), -1), v.reshape(len(v), -1)
    return 0.5 * ((v**2) @ chain.masses() + np.sum(u * (chain.stiffness_matrix() @ u.T).T, axis=1))


def later(chain, u, v, interval):
    """Fields (cell, dof) of the free lattice after an ``interval`` in s."""
    n = u.size
    matrix = np.block([[np.zeros((n, n)), np.eye(n)], [-chain.stiffness_matrix().toarray(), np.zeros((n, n))]])
    matrix[n:] /= chain.masses()[:, None]
    state = expm(matrix * interval) @ np.concatenate([u.ravel(), v.ravel()])
    return state[:n].reshape(u.shape), state[n:].reshape(u.shape)


@pytest.mark.parametrize("cells", [2, 3, 9, 24])
@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
@pytest.mark.parametrize("name", CELLS)
def test_energies_sum_up_and_stay_until_a_force_acts(name, ends, cells):
    chain = Chain(CELLS[name], cells, ends, (1,), (1e-3,))
    parts, (u, v) = ModalParts.of(chain), fields(chain)
    before = parts.energies(u, v, range(3))
    assert before.sum(axis=(0, 1)) == pytest.approx(energy(chain, u, v), rel=1e-12)
    interval = 2.3 / pass_bands(chain.cell)[-1].high
    after = parts.modes.amplitudes(*(field[None] for field in later(chain, u[0], v[0], interval)))[0]
    expected = parts.modes.later(parts.modes.amplitudes(u, v)[0], interval)
    assert after == pytest.approx(expected, abs=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
@pytest.mark.parametrize("name", CELLS)
def test_modes_are_in_bands_but_for_those_of_the_ends(name, ends):
    chain = Chain(CELLS[name], 30, ends)
    parts = ModalParts.of(chain)
    in_bands = np.array([bool(inside) for inside in parts.parts.bands])[parts.part]
    counts = np.bincount(parts.part, minlength=len(parts.parts.names))[[bool(b) for b in parts.parts.bands]]
    assert np.all(counts <= 31) and np.all(counts >= 28) and np.count_nonzero(~in_bands) <= 2 * chain.cell.dofs
    if ends == "periodic":
        assert in_bands.all() and np.all(counts == 30)
    if ends == "free":
        assert parts.modes.frequency[0] == 0.0 and parts.part[0] == 0
    # Those in bands obey the dispersion relation, whatever the ends are.
    from vipetsc.lattice import bloch

    branches = bloch(chain.cell, parts.modes.wavenumber[in_bands]).frequency
    nearest = np.abs(branches - parts.modes.frequency[in_bands, None]).min(axis=1)
    assert nearest.max() < 1e-6 * pass_bands(chain.cell)[-1].high


def test_inverse_iteration_gives_the_modes_of_a_dense_solution():
    for name, cell in CELLS.items():
        chain = Chain(cell, 60)
        found = linear_modes(chain)
        root = 1 / np.sqrt(chain.masses())
        matrix = chain.stiffness_matrix().toarray() * root[:, None] * root
        squared = np.linalg.eigvalsh(matrix)
        assert found.frequency == pytest.approx(np.sqrt(squared), rel=1e-10), name
        assert np.abs(found.vectors.T @ found.vectors - np.eye(len(squared))).max() < 1e-12, name
        assert np.abs(matrix @ found.vectors - found.vectors * found.frequency**2).max() < 1e-13 * squared[-1], name


def test_modes_are_those_of_all_chains_that_differ_in_contacts_alone():
    chain = Chain(CELLS["diatomic"], 20)
    assert linear_modes(replace(chain, sites=(3,), clearances=(1e-3,))) is linear_modes(chain)


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
def test_the_burst_drives_the_modes_as_its_force_does(ends):
    """The closed form against quadrature of the force, and an interval across the burst's end."""
    chain, drive = Chain(CELLS["four-band"], 12, ends), ToneBurst(3.0, 1023.27, 4)
    for start, stop in ((0.0, 1e-3), (2e-3, 5e-3), (0.02, 0.03), (0.03, 0.04)):
        s, weights = np.polynomial.legendre.leggauss(200)
        last = min(stop, drive.duration)
        t = start + (last - start) * (s + 1) / 2
        frequency = linear_modes(chain).frequency[:, None]
        integrand = np.exp(1j * frequency * (stop - t)) * drive.force(t) * (start < drive.duration)
        expected = integrand @ weights * (last - start) / 2
        assert linear_modes(chain).driven(drive, start, stop) == pytest.approx(expected, rel=1e-9, abs=1e-12)
    # A velocity that 1 N s gives to a mass.
    u, v = np.zeros((2, 1, 12, 4))
    v[0, 7, 1] = 1 / chain.cell.masses[1]
    assert linear_modes(chain).amplitudes(u, v)[0] == pytest.approx(linear_modes(chain).force(7, 1), abs=1e-12)


@pytest.mark.parametrize("ends", ["fixed", "free"])
def test_a_long_lattice_is_taken_for_a_part_of_a_ring(ends, monkeypatch):
    """Away from the ends, where they meet no wave, bands have the energies that the lattice's own modes tell."""
    chain = Chain(CELLS["four-band"], 200, ends)
    u, v = fields(chain)
    window = np.exp(-(((np.arange(200) - 100) / 15.0) ** 2))[:, None]
    u, v = u * window, v * window
    exact = ModalParts.of(chain).energies(u, v, range(3)).sum(axis=1)
    modes._modes.cache_clear()
    monkeypatch.setattr(modes, "MOST_DOFS", 100)
    ring = ModalParts.of(chain)
    waves = ring.energies(u, v, range(3)).sum(axis=1)
    modes._modes.cache_clear()
    assert not ring.modes.exact and ring.modes.cells == 200 + (ends == "fixed")
    assert waves.sum(axis=0) == pytest.approx(energy(chain, u, v), rel=1e-12)
    assert waves == pytest.approx(exact, abs=1e-9 * exact.sum(axis=0).max())


def test_upper_share_is_of_the_bands_above_the_drive():
    chain = Chain(CELLS["four-band"], 20)
    parts, drive = ModalParts.of(chain), ToneBurst(1.0, 1023.27, 30)
    u, v = fields(chain, 1)
    bands = parts.energies(u, v, [0]).sum(axis=(1, 2))
    assert upper_share(chain, drive, u[0], v[0], 4.0) == pytest.approx((bands[4] + bands[6]) / 4.0)
    assert np.isnan(upper_share(chain, replace(drive, frequency=3500.0), u[0], v[0], 4.0))


def test_episodes_that_touch_between_the_same_samples_are_one_cluster():
    time = np.arange(11) * 1.0
    onset = np.array([1.2, 1.4, 4.5, 2.1, 6.0, 8.5, 9.2])
    separation = np.array([2.7, 1.6, 4.8, 3.0, 7.0, np.nan, 9.9])
    bounds, cluster = cluster_samples(onset, separation, time)
    assert bounds.tolist() == [[1, 3], [4, 5], [6, 7], [8, 10]]
    assert cluster.tolist() == [0, 0, 1, 0, 2, 3, 3]
    # 2.1 to 3.0 begins after the sample at which another has ended: apart.
    assert cluster_samples(onset[[1, 3]], separation[[1, 3]], time)[0].tolist() == [[1, 2], [2, 3]]
    bounds, cluster = cluster_samples(onset, separation, time, 4)
    assert bounds.tolist() == [[0, 4], [4, 8], [8, 10]] and cluster.tolist() == [0, 0, 1, 0, 1, 2, 2]
    bounds, cluster = cluster_samples(np.zeros(0), np.zeros(0), time)
    assert bounds.shape == (0, 2) and cluster.shape == (0,)
