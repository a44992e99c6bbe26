"""Wavelets in space against closed forms, direct sums and each other; partitions against the physical energy."""

import numpy as np
import pytest
from scipy.integrate import quad

from vipetsc.spectra import BINS, Nodes, filter_bank, inverse, kinetic_energy, local_entropy, partition, transform
from vipetsc.spectra.wavelet import constant, wavenumbers


def noise(shape, seed=0):
    """Return standard normal numbers."""
    return np.random.default_rng(seed).standard_normal(shape)


@pytest.mark.parametrize("length", [64, 75])
@pytest.mark.parametrize("kc", [6.0, 12.0])
def test_transform_is_the_direct_sum_over_the_periodised_wavelet(length, kc):
    """Transforms of even and odd length are sums over the cells with a wavelet of that period."""
    kappa = np.array([0.05, 0.4, 1.5, 3.0, np.pi, 4.0])
    signal = noise(40)
    eta = 2 * np.pi * np.arange(1, length // 2 + 1) / length
    # The node at pi, which an even length has, stands for pi and -pi: half of it is the analytic part.
    half = np.where(np.isclose(eta, np.pi), 0.5, 1.0)
    place = np.arange(length)

    expected = np.zeros((len(kappa), length), dtype=complex)
    for i, k in enumerate(kappa):
        gauss = half * np.exp(-0.5 * (kc * eta / k - kc) ** 2) * np.sqrt(kc / k)
        wavelet = (gauss * np.exp(1j * eta * place[:, None])).sum(axis=1) / length
        for y, value in enumerate(signal):
            expected[i] += value * wavelet[(place - y) % length]

    assert np.abs(transform(signal, kappa, kc, length) - expected).max() < 1e-12


@pytest.mark.parametrize(("cells", "kc", "odd"), [(90, 6.0, 0), (152, 6.0, 1), (90, 12.0, 0), (79, 12.0, 1)])
def test_bank_is_transform_binning_and_inverse(cells, kc, odd):
    """The filters of the bank are transform, sum over the nodes of a bin, and inverse in one."""
    signal = noise((2, cells))
    nodes = Nodes.log(kc)
    bank = filter_bank(cells, kc)
    assert bank.length % 2 == odd

    parts = inverse(transform(signal, nodes.kappa, kc, bank.length), nodes, kc)
    assert parts.shape == (BINS, 2, bank.length)
    assert np.abs(parts[..., :cells] - bank.split(signal)).max() < 1e-12


@pytest.mark.parametrize("kc", [6.0, 12.0])
def test_analytic_bank_sums_to_one_where_the_nodes_reach(kc):
    """Above 1.6 times the lowest node the filters sum to 1 within 1 %; none passes a mean, and none is negative.

    The sum is nowhere above 1, hence the energies of the parts add up to no more than the whole.
    """
    bank = filter_bank(600, kc)
    eta = wavenumbers(bank.length)
    total = bank.transfer.sum(axis=0)

    assert np.abs(total[(eta > np.pi / 60 * 1.6)] - 1).max() < 0.01
    assert total.max() < 1 + 1e-12
    assert total[0] == 0
    assert np.all(bank.transfer >= 0)


@pytest.mark.parametrize("kc", [6.0, 12.0])
def test_constant_is_the_integral(kc):
    """The constant of admissibility is the integral of exp(-(s - kc)^2)/s over s > 0."""

    def integrand(s):
        return np.exp(-((s - kc) ** 2)) / s

    # exp(-64) and exp(-36) are left out at the two ends.
    expected, _ = quad(integrand, 1e-3, kc + 8, points=[kc], epsabs=0, epsrel=1e-13)
    assert constant(kc) == pytest.approx(expected, rel=1e-12)


def test_nodes_span_the_log_grid():
    """Nodes are equally spaced in their logarithm, from pi/60 to 5 pi/3, as many an octave as requested or more."""
    nodes = Nodes.log(6.0, 4.0)
    assert nodes.kappa[[0, -1]] == pytest.approx([np.pi / 60, np.pi * 5 / 3])
    assert np.diff(np.log(nodes.kappa)) == pytest.approx(np.full(len(nodes.kappa) - 1, nodes.weight))
    assert nodes.weight <= np.log(2) / 4


def test_nodes_lie_in_bins_of_equal_width():
    """Each node is in the bin of width pi/12 that holds its wavenumber; those beyond pi are in the last one."""
    nodes = Nodes.log(6.0)
    kappa = nodes.kappa
    bins = nodes.bins

    assert set(bins) == set(range(BINS))
    assert np.all(bins[kappa > np.pi] == BINS - 1)
    inside = kappa <= np.pi
    width = np.pi / BINS
    assert np.all(kappa[inside] >= bins[inside] * width - 1e-12)
    assert np.all(kappa[inside] <= (bins[inside] + 1) * width + 1e-12)


def test_partition_accounts_for_its_energies():
    """Energies of parts, of their sum and of the whole are those of the filtered velocities; fields sum to them."""
    velocity = noise((37, 80, 2))
    masses = np.array([0.01, 0.08])
    # A snapshot at rest has no energy to divide by.
    velocity[0] = 0

    found = partition(velocity, masses, mean_over=1)

    assert found.field.shape == (12, 37, 80)
    assert np.allclose(found.field.sum(axis=2), found.energy, rtol=1e-12)
    assert np.allclose(found.kinetic, kinetic_energy(velocity, masses).sum(axis=1), rtol=1e-12)

    parts = filter_bank(80).split(velocity[5].T)
    assert np.allclose(found.energy[:, 5], 0.5 * np.einsum("j,bjc->b", masses, parts**2), rtol=1e-10)
    assert found.reconstructed[5] == pytest.approx(0.5 * masses @ (parts.sum(axis=0) ** 2).sum(axis=1), rel=1e-12)

    assert found.error[0] == 0
    assert found.cross_share[0] == 0
    assert np.allclose(found.cross_share[1:], 1 - found.energy.sum(axis=0)[1:] / found.kinetic[1:])
    # Fields are as large as the record and are kept on request alone.
    assert partition(velocity, masses).field is None


class Record:
    """A dataset that refuses to be read by more than a few snapshots at a time."""

    def __init__(self, values):
        self.values = values
        self.shape = values.shape

    def __len__(self):
        return len(self.values)

    def __getitem__(self, rows):
        assert rows.stop - rows.start <= 32
        return self.values[rows]


def test_records_are_read_in_chunks_that_do_not_matter():
    """The last snapshots have the same bits as the second chunk of a long record and as a record alone."""
    velocity = noise((40, 30))

    whole = partition(Record(velocity), 2.0, mean_over=1)
    late = partition(velocity[33:], 2.0, mean_over=1)

    assert np.array_equal(whole.field[:, 33:], late.field)
    assert np.array_equal(whole.energy[:, 33:], late.energy)
    assert np.array_equal(local_entropy(Record(velocity))[0][33:], local_entropy(velocity[33:])[0])


def test_bad_requests_are_named():
    """Too few voices, an inadmissible wavelet, a length below the signal's and missing masses are refused."""
    with pytest.raises(ValueError, match="voices"):
        Nodes.log(12.0, 4.0)
    with pytest.raises(ValueError, match="admissible"):
        transform(noise(10), [1.0], 2.0)
    with pytest.raises(ValueError, match="length"):
        transform(noise(10), [1.0], 6.0, 9)
    with pytest.raises(ValueError, match="masses"):
        partition(noise((3, 10, 2)), [1.0])
