"""Energies of the linear modes sum to the lattice's energy, stay constant, and belong to their bands."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from vipetsc.lattice import (
    Chain,
    Drive,
    Spring,
    ToneBurst,
    UnitCell,
    bloch,
    diatomic,
    four_band,
    linear_modes,
    modes,
    pass_bands,
)
from vipetsc.lattice.drive import impulse
from vipetsc.lattice.sites import sites_at
from vipetsc.spectra import ModalParts, upper_fraction
from vipetsc.spectra.modal_energies import cluster_samples

CELLS = {
    "four-band": four_band("calibrated"),
    "diatomic": diatomic("calibrated"),
    "asymmetric": UnitCell((1.0, 2.0, 0.5), (Spring(0, 1, 3.0), Spring(1, 2, 1.0), Spring(2, 0, 2.0, True)), 0, 1),
}
ENDS = pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
# Frequency in rad/s of the paper's drive, in band 2 of the four-band lattice.
DRIVEN = 1023.27


def random_fields(chain: Chain, count: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Return random displacements and velocities (t, cell, dof) with comparable spring and kinetic energies."""
    u, v = np.random.default_rng(1).standard_normal((2, count, chain.cells, chain.cell.dofs))
    return u, v * pass_bands(chain.cell)[-1].high


def energy_of(chain: Chain, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the sum of kinetic and spring energy (t,)."""
    u = u.reshape(len(u), -1)
    v = v.reshape(len(v), -1)
    spring = np.sum(u * (chain.stiffness_matrix() @ u.T).T, axis=1)
    return 0.5 * ((v**2) @ chain.masses() + spring)


def free_motion(chain: Chain, u: np.ndarray, v: np.ndarray, interval: float) -> tuple[np.ndarray, np.ndarray]:
    """Return fields (cell, dof) of the free lattice after an ``interval`` in s, from the matrix exponential."""
    n = u.size
    system = np.zeros((2 * n, 2 * n))
    system[:n, n:] = np.eye(n)
    system[n:, :n] = -chain.stiffness_matrix().toarray() / chain.masses()[:, None]
    state = expm(system * interval) @ np.concatenate([u.ravel(), v.ravel()])
    return state[:n].reshape(u.shape), state[n:].reshape(u.shape)


@pytest.mark.parametrize("cells", [2, 9])
@ENDS
@pytest.mark.parametrize("name", CELLS)
def test_energies_sum_up_and_modes_turn_freely(name, ends, cells):
    """Modal energies sum to the lattice's energy; amplitudes of a free motion turn by exp(i omega t).

    The free motion is computed by a matrix exponential.
    """
    chain = Chain(CELLS[name], cells, ends, sites_at([1], CELLS[name].pair))
    parts = ModalParts.of(chain)
    u, v = random_fields(chain)
    energies = parts.energies(u, v, range(3))
    assert energies.sum(axis=(0, 1)) == pytest.approx(energy_of(chain, u, v), rel=1e-12)

    # The fastest oscillation turns by 2.3 rad.
    interval = 2.3 / pass_bands(chain.cell)[-1].high
    end_u, end_v = free_motion(chain, u[0], v[0], interval)
    found = parts.modes.amplitudes(end_u[None], end_v[None])[0]
    expected = parts.modes.amplitudes(u, v)[0] * np.exp(1j * parts.modes.frequency * interval)
    assert found == pytest.approx(expected, abs=1e-11 * np.abs(expected).max())


@ENDS
@pytest.mark.parametrize("name", CELLS)
def test_modes_are_in_bands_but_for_those_of_the_ends(name, ends):
    """Each band has one mode a cell, except for a few at the ends; modes in bands lie on the dispersion relation."""
    cells = 30
    chain = Chain(CELLS[name], cells, ends)
    parts = ModalParts.of(chain)
    is_band = np.array([bool(bands) for bands in parts.parts.bands])
    in_bands = is_band[parts.part]
    counts = np.bincount(parts.part, minlength=len(is_band))[is_band]
    # A band has one mode a cell; an end may pull some of each branch out of it.
    assert np.all(counts <= cells + 1)
    assert np.all(counts >= cells - 2)
    assert np.count_nonzero(~in_bands) <= 2 * chain.cell.dofs
    if ends == "periodic":
        assert in_bands.all()
        assert np.all(counts == cells)
    if ends == "free":
        assert parts.modes.frequency[0] == 0.0
        assert parts.part[0] == 0

    # Modes in bands obey the dispersion relation with any ends.
    branches = bloch(chain.cell, parts.modes.wavenumber[in_bands]).frequency
    nearest = np.abs(branches - parts.modes.frequency[in_bands, None]).min(axis=1)
    assert nearest.max() < 1e-6 * pass_bands(chain.cell)[-1].high


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("ends", ["fixed", "free"])
def test_modes_of_equal_masses_are_those_of_the_formula(ends):
    """Chains of 2 to 40 equal masses have the frequencies 2 (k/m)^1/2 sin(p j/2), with p = pi/(n + 1) or pi/n.

    An eigenvalue is often exact to the last bit in such a chain, and a matrix shifted by it has no inverse.
    """
    cell = UnitCell((1e-3,), (Spring(0, 0, 1e4, offset=1),), 0, 0)
    for cells in range(2, 41):
        found = linear_modes(Chain(cell, cells, ends))
        exact = 2 * np.sqrt(1e7) * np.sin(np.pi * np.arange(cells) / (2 * cells))
        if ends == "fixed":
            exact = 2 * np.sqrt(1e7) * np.sin(np.pi * np.arange(1, cells + 1) / (2 * (cells + 1)))
        assert found.frequency == pytest.approx(exact, rel=1e-10, abs=1e-3)
        assert np.abs(found.vectors.T @ found.vectors - np.eye(cells)).max() < 1e-12


# Intervals in s within the burst of 24.6 ms, across its end, and after it.
@pytest.mark.parametrize(("start", "stop"), [(0.0, 1e-3), (0.02, 0.03)])
@ENDS
def test_the_burst_drives_the_modes_as_its_force_does(ends, start, stop):
    """The closed form of the response to a burst is the integral of exp(i omega (stop - t)) times the force.

    So is that to its derivative, by which a wall moves the end of a dashpot.
    """
    burst = ToneBurst(3.0, DRIVEN, 4)
    modes_ = linear_modes(Chain(CELLS["four-band"], 12, ends))
    found = burst.response(modes_.frequency, start, stop)
    by_dashpot = Drive(burst, 0, 0, damping=2.0).response(modes_.frequency, start, stop)

    if start >= burst.duration:
        assert not found.any()
        return
    # 200 nodes of Gauss resolve the fastest mode, which turns by 36 rad, to rounding.
    s, weights = np.polynomial.legendre.leggauss(200)
    last = min(stop, burst.duration)
    t = start + (last - start) * (s + 1) / 2
    turned = np.exp(1j * modes_.frequency[:, None] * (stop - t)) * weights * (last - start) / 2
    assert found == pytest.approx(turned @ burst.force(t), rel=1e-9, abs=1e-12)
    assert by_dashpot == pytest.approx(turned @ burst.rate(t), rel=1e-9, abs=1e-9)


# Intervals in s within the force, from its beginning to its end, and beyond its end.
@pytest.mark.parametrize(("start", "stop"), [(0.013, 0.052), (0.0, 0.1), (0.0, 0.3)])
def test_a_long_force_drives_the_modes_as_its_integral_says(start, stop):
    """Half a sine of 0.1 s, in which the fastest mode turns by 360 rad, has its integral in closed form."""
    duration = 0.1
    frequency = np.array([0.0, 90.0, DRIVEN, 3600.0])
    found = impulse(2.0, duration).response(frequency, start, stop)

    rate = np.pi / duration
    ends = np.array([[start], [min(stop, duration)]])
    terms = 1j * frequency * np.sin(rate * ends) + rate * np.cos(rate * ends)
    lower, upper = -terms * np.exp(1j * frequency * (stop - ends)) / (rate**2 - frequency**2)
    # The force is 2 pi / (2 duration) = pi / duration times the sine.
    assert found == pytest.approx(rate * (upper - lower), rel=1e-11, abs=1e-14)


@pytest.mark.parametrize("ends", ["fixed", "free"])
def test_a_long_lattice_is_taken_for_a_part_of_a_ring(ends, monkeypatch):
    """Energies of bands are those of the lattice's own modes for motions that are zero near the ends."""
    chain = Chain(CELLS["four-band"], 200, ends)
    u, v = random_fields(chain)
    window = np.exp(-(((np.arange(200) - 100) / 15.0) ** 2))[:, None]
    u = u * window
    v = v * window
    exact = ModalParts.of(chain).energies(u, v, range(3)).sum(axis=1)

    modes._modes.cache_clear()
    monkeypatch.setattr(modes, "MOST_DOFS", 100)
    ring = ModalParts.of(chain)
    found = ring.energies(u, v, range(3)).sum(axis=1)
    # Other tests need exact modes.
    modes._modes.cache_clear()

    assert not ring.modes.exact
    # The ring has one more cell for the two walls of a fixed lattice.
    assert ring.modes.cells == 200 + (ends == "fixed")
    assert found.sum(axis=0) == pytest.approx(energy_of(chain, u, v), rel=1e-12)
    assert found == pytest.approx(exact, abs=1e-9 * exact.sum(axis=0).max())


def test_the_upper_fraction_is_that_of_the_bands_above_the_drive():
    """The upper fraction is the energy of bands above the driven one over the work, NaN for a drive in the highest."""
    chain = Chain(CELLS["four-band"], 20)
    burst = ToneBurst(1.0, DRIVEN, 30)
    u, v = random_fields(chain, 1)
    parts = ModalParts.of(chain).energies(u, v, [0]).sum(axis=(1, 2))
    # Bands 3 and 4 are the parts 4 and 6, with gaps between; 4 J is the work.
    assert upper_fraction(chain, burst, u[0], v[0], 4.0) == pytest.approx((parts[4] + parts[6]) / 4.0)
    assert np.isnan(upper_fraction(chain, replace(burst, frequency=3500.0), u[0], v[0], 4.0))


TIME = np.arange(11) * 1.0
ONSET = np.array([1.2, 1.4, 4.5, 2.1, 6.0, 8.5, 9.2])
SEPARATION = np.array([2.7, 1.6, 4.8, 3.0, 7.0, np.nan, 9.9])


def test_episodes_that_touch_between_the_same_samples_are_one_cluster():
    """Episodes are in one cluster if the samples around them overlap; an unfinished one lasts until the end."""
    bounds, cluster = cluster_samples(ONSET, SEPARATION, TIME)
    assert bounds.tolist() == [[1, 3], [4, 5], [6, 7], [8, 10]]
    assert cluster.tolist() == [0, 0, 1, 0, 2, 3, 3]


def test_an_episode_that_begins_after_the_sample_at_which_another_has_ended_is_apart():
    """Two episodes with a sample between them are two clusters."""
    bounds, _ = cluster_samples(ONSET[[1, 3]], SEPARATION[[1, 3]], TIME)
    assert bounds.tolist() == [[1, 2], [2, 3]]


def test_clusters_are_joined_to_a_coarser_grid_of_samples():
    """Bounds of clusters are multiples of the stride, and clusters that then overlap are joined."""
    bounds, cluster = cluster_samples(ONSET, SEPARATION, TIME, 4)
    assert bounds.tolist() == [[0, 4], [4, 8], [8, 10]]
    assert cluster.tolist() == [0, 0, 1, 0, 1, 2, 2]
