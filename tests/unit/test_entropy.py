"""Space-wavenumber entropy: closed forms for tones and noise, invariances, and the averages against plain loops."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import erf

from vipetsc.spectra import entropy, local_entropy, padded_length, transform

# Centre of the wavelet, and the wavenumbers in rad/cell of its nodes.
KC = 12.0
KAPPA = np.pi * np.arange(1, 61) / 60
AVERAGES = ("energy_weighted", "masked", "joint")


def bits(power: np.ndarray) -> np.ndarray:
    """Return the entropy in bits of the fractions of ``power`` along the first axis."""
    share = power / power.sum(axis=0)
    log = np.log2(share, out=np.zeros_like(share), where=share > 0)
    return -np.sum(share * log, axis=0)


def noise(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape)


def packet(centre: float, kappa: float = 5 * np.pi / 9) -> np.ndarray:
    """Return a packet (cell,) of 600 cells about ``centre``, with the deviation 30 cells."""
    x = np.arange(600) - centre
    return np.exp(-0.5 * (x / 30) ** 2) * np.cos(kappa * x)


def scattering_run(samples: int = 12) -> np.ndarray:
    """Return velocities (sample, cell) of a packet that travels forwards and leaves a growing backward one behind."""
    fields = []
    for t in range(samples):
        left_behind = packet(300 - 9 * t, kappa=1.1)
        fields.append(packet(150 + 20 * t) + 0.3 * t * left_behind)
    return 1e-3 * np.array(fields)


@pytest.mark.parametrize("kappa", [np.pi / 3, 5 * np.pi / 9, 2.5])
def test_a_tone_has_the_entropy_of_its_gaussian_over_the_nodes(kappa):
    """Far from its ends, a tone of the wavenumber kappa_0 has 4 S = kc/kappa |Psi(kc kappa_0/kappa)|^2 at the nodes."""
    x = np.arange(6000)
    # Ends that fade add no other wavenumbers.
    fade = 0.5 * (erf((x - 300) / 60) - erf((x - 5700) / 60))
    local, weight = local_entropy((fade * np.cos(kappa * x))[None])
    power = KC / KAPPA * np.exp(-((KC * kappa / KAPPA - KC) ** 2))
    assert local[0, 2900:3100] == pytest.approx(np.full(200, bits(power)), abs=1e-9)
    assert weight[0, 3000] == pytest.approx(power.sum() / 4, rel=1e-9)


def test_white_noise_approaches_its_limit():
    """The spectrum S of white noise is exponentially distributed about its mean E at each node.

    Its entropy over cells and nodes is hence log2 cells + H(E / sum E) - (1 - gamma)/ln 2, with Euler's gamma.
    """
    cells = 20_000
    found = entropy(noise((10, cells)))
    eta = np.pi * (np.arange(20_000) + 0.5) / 20_000
    mean = KC / KAPPA * np.exp(-((KC * eta[:, None] / KAPPA - KC) ** 2)).sum(axis=0)
    limit = np.log2(cells) + bits(mean) - (1 - np.euler_gamma) / np.log(2)
    # Ten samples of 20,000 cells; at the smallest wavenumber some hundred neighbouring cells are correlated.
    assert found.joint == pytest.approx(limit, abs=0.02)
    # Neighbouring nodes are correlated: the fractions within one cell are more alike than those of all cells.
    assert limit - np.log2(cells) < found.energy_weighted < np.log2(60)


def test_the_local_entropy_is_that_of_the_wavelet_transform():
    """The local entropy is that of the squares of the wavelet transform, octave by octave."""
    signal = noise((5, 150))
    local, weight = local_entropy(signal)

    # Octave by octave, since each has a padding of its own.
    power = np.empty((60, 5, 150))
    for lowest in (1, 2, 4, 8, 16, 32):
        rows = slice(lowest - 1, 2 * lowest - 1)
        length = padded_length(150, KC, KAPPA[lowest - 1])
        transformed = transform(signal, KAPPA[rows], KC, length)[..., :150]
        power[rows] = np.moveaxis(np.abs(transformed) ** 2, 1, 0)
    assert np.allclose(weight, power.sum(axis=0), rtol=1e-12)
    assert np.abs(local - bits(power)).max() < 1e-11


@pytest.mark.parametrize("stride", [2, 3])
def test_fewer_cells_have_the_entropy_that_they_have_among_all(stride):
    """Every second or third cell has the entropy of the same cell among all, up to the length of the padded line."""
    signal = scattering_run(3)
    whole_local, whole_weight = local_entropy(signal)
    local, weight = local_entropy(signal, stride)
    is_loud = whole_weight[:, ::stride] > 1e-4 * whole_weight.max()
    assert np.abs(local - whole_local[:, ::stride])[is_loud].max() < 1e-6
    assert weight == pytest.approx(whole_weight[:, ::stride], rel=1e-6, abs=1e-9 * whole_weight.max())

    whole = entropy(signal)
    thinned = entropy(signal, stride=stride)
    for name in AVERAGES:
        assert getattr(thinned, name) == pytest.approx(getattr(whole, name), rel=1e-3)


def test_the_mask_is_relative_to_the_largest_weight_of_all_snapshots():
    """The threshold of the mask is 1 % of the largest weight of all snapshots, also of those left out of averages."""
    # The loudest snapshot is not among every second one.
    signal = scattering_run()
    signal[5] *= 4
    local, weight = local_entropy(signal)
    above_threshold = weight[::2] > 0.01 * weight.max()
    expected = local[::2][above_threshold].mean()
    assert entropy(signal, every=2).masked == pytest.approx(expected, rel=1e-12)
    assert entropy(signal[::2]).masked != pytest.approx(expected, rel=1e-3)


@settings(max_examples=15)
@given(st.integers(0, 99), st.integers(-200, 200))
def test_a_power_of_two_leaves_the_bits_of_the_entropy(seed, power):
    """A factor 2^n changes no bit of the entropy, and the weight by 2^(2n)."""
    signal = noise((3, 40), seed)
    plain = entropy(signal)
    scaled = entropy(np.ldexp(signal, power))
    assert np.array_equal(plain.local, scaled.local)
    assert np.array_equal(np.ldexp(plain.weight, 2 * power), scaled.weight)
    for name in (*AVERAGES, "error"):
        assert getattr(plain, name) == getattr(scaled, name)


def test_averages_are_those_of_their_definitions():
    """Averages are those of their definitions, from the local entropy and weight after the start."""
    signal = scattering_run()
    start = 5
    # Loud before the averages start: it must not count.
    signal[:start] *= 100
    signal[8:] *= 0.05

    found = entropy(signal, start)

    local = found.local[start:]
    weight = found.weight[start:]
    assert found.snapshot.shape == (12,)
    assert found.snapshot[start:] == pytest.approx((local * weight).sum(axis=1) / weight.sum(axis=1), rel=1e-12)
    assert found.energy_weighted == pytest.approx(found.snapshot[start:].mean(), rel=1e-14)

    is_loud = weight > 0.01 * weight.max()
    assert found.masked == pytest.approx(local[is_loud].mean(), rel=1e-12)
    cells = np.nonzero(is_loud.any(axis=0))[0]
    means = [local[is_loud[:, cell], cell].mean() for cell in cells]
    assert found.error == pytest.approx(np.std(means), rel=1e-12)

    joint = []
    for snapshot in signal[start:]:
        power = np.abs(transform(snapshot, KAPPA, KC)[:, :600]) ** 2
        joint.append(bits(power.ravel()))
    assert found.joint == pytest.approx(np.mean(joint), abs=1e-6)


@pytest.mark.parametrize(("strong", "counted"), [(31, False), (5, True)])
def test_the_mask_heeds_samples_between_the_snapshots_after_the_start(strong, counted):
    """A sample with a hundred times the motion masks all snapshots though it is none, if it is not before the start."""
    signal = noise((40, 64))
    signal[strong] *= 100.0
    assert (entropy(signal, start=10, every=2).masked > 0.0) == counted


def test_a_lattice_at_rest_has_no_entropy():
    found = entropy(np.zeros((3, 50)))
    assert not found.local.any()
    assert not found.weight.any()
    assert [getattr(found, name) for name in (*AVERAGES, "error")] == [0, 0, 0, 0]


def test_a_snapshot_at_rest_has_no_entropy():
    signal = noise((6, 50))
    signal[2] = 0
    found = entropy(signal)
    assert found.snapshot[2] == 0
    assert np.all(np.delete(found.snapshot, 2) > 0)
