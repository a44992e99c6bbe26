"""Space-wavenumber entropy: closed forms for tones and noise, invariances, and the averages against plain loops."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import erf

from vipetsc.spectra import entropy, local_entropy, padded_length, transform

KC = 12.0
KAPPA = np.pi * np.arange(1, 61) / 60


def bits(power):
    share = power / power.sum(axis=0)
    return -np.sum(share * np.log2(share, out=np.zeros_like(share), where=share > 0), axis=0)


def noise(shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape)


def packet(centre, cells=600, kappa=5 * np.pi / 9):
    x = np.arange(cells) - centre
    return np.exp(-0.5 * (x / 30) ** 2) * np.cos(kappa * x)


def run(times=12):
    """A packet that leaves others behind as it goes."""
    fields = [packet(150 + 20 * t) + 0.3 * t * packet(300 - 9 * t, kappa=1.1) for t in range(times)]
    return 1e-3 * np.array(fields)


@pytest.mark.parametrize("kappa", [np.pi / 3, 5 * np.pi / 9, 2.5])
def test_a_tone_has_the_entropy_of_its_gaussian_over_the_nodes(kappa):
    """Far from its ends, which fade so that they add no other wavenumbers, 4 S = kc/kappa |Psi(kc kappa_0/kappa)|^2."""
    x = np.arange(6000)
    fade = 0.5 * (erf((x - 300) / 60) - erf((x - 5700) / 60))
    signal = fade * np.cos(kappa * x)
    local, weight = local_entropy(signal[None])
    power = KC / KAPPA * np.exp(-((KC * kappa / KAPPA - KC) ** 2))
    assert local[0, 2900:3100] == pytest.approx(np.full(200, bits(power)), abs=1e-9)
    assert weight[0, 3000] == pytest.approx(power.sum() / 4, rel=1e-9)


def test_white_noise_approaches_its_limit():
    """S is exponential about its mean E: H over cells and nodes is log2 cells + H(E / sum E) - (1 - gamma)/ln 2."""
    cells = 20_000
    found = entropy(noise((10, cells)))
    eta = np.pi * (np.arange(20_000) + 0.5) / 20_000
    mean = KC / KAPPA * np.exp(-((KC * eta[:, None] / KAPPA - KC) ** 2)).sum(axis=0)
    limit = np.log2(cells) + bits(mean) - (1 - np.euler_gamma) / np.log(2)
    assert found.joint == pytest.approx(limit, abs=0.02)
    # Neighbouring nodes are correlated, so the shares within one cell are more alike than those of the whole.
    assert limit - np.log2(cells) < found.energy_weighted < np.log2(60)


def test_it_is_the_entropy_of_the_transform():
    signal = noise((5, 150))
    local, weight = local_entropy(signal)
    power = np.empty((60, 5, 150))
    for lowest in (1, 2, 4, 8, 16, 32):
        rows = slice(lowest - 1, 2 * lowest - 1)
        length = padded_length(150, KC, KAPPA[lowest - 1])
        x = transform(signal, KAPPA[rows], KC, length)[..., :150]
        power[rows] = np.moveaxis(np.abs(x) ** 2, 1, 0)
    assert np.allclose(weight, power.sum(axis=0), rtol=1e-12)
    assert np.abs(local - bits(power)).max() < 1e-11


@pytest.mark.parametrize("stride", [2, 3])
def test_fewer_cells_have_the_entropy_they_had(stride):
    """Nothing is lost by the folding; only the padded line may be a little longer."""
    signal = run(3)
    (all_local, all_weight), (local, weight) = local_entropy(signal), local_entropy(signal, stride)
    loud = all_weight[:, ::stride] > 1e-4 * all_weight.max()
    assert np.abs(local - all_local[:, ::stride])[loud].max() < 1e-6
    assert weight == pytest.approx(all_weight[:, ::stride], rel=1e-6, abs=1e-9 * all_weight.max())
    every = entropy(signal)
    few = entropy(signal, stride=stride)
    for name in ("energy_weighted", "masked", "joint"):
        assert getattr(few, name) == pytest.approx(getattr(every, name), rel=1e-3)


def test_the_mask_is_relative_to_the_largest_weight_between_the_snapshots_too():
    signal = run()
    signal[5] *= 4
    weight = local_entropy(signal)[1]
    local, few = (array[::2] for array in local_entropy(signal))
    above_threshold = few > 0.01 * weight.max()
    assert entropy(signal, every=2).masked == pytest.approx(local[above_threshold].mean(), rel=1e-12)
    assert entropy(signal[::2]).masked != pytest.approx(local[above_threshold].mean(), rel=1e-3)


def test_one_long_transform_gives_the_same_packet():
    """The padding of every octave is enough: one long transform for all nodes changes nothing."""
    signal = packet(300.0)
    local, weight = local_entropy(signal[None])
    power = np.abs(transform(signal, KAPPA, KC, 6000)[:, :600]) ** 2
    loud = weight[0] > 1e-4 * weight.max()
    assert np.abs(local[0] - bits(power))[loud].max() < 1e-6
    assert weight[0] == pytest.approx(power.sum(axis=0), rel=1e-6, abs=1e-12)


@settings(max_examples=15)
@given(st.integers(0, 99), st.integers(-200, 200), st.floats(1e-9, 1e9))
def test_entropy_does_not_depend_on_the_amplitude(seed, power, factor):
    signal = noise((3, 40), seed)
    plain, twice, other = (entropy(s) for s in (signal, np.ldexp(signal, power), factor * signal))
    assert np.array_equal(plain.local, twice.local)
    assert np.array_equal(np.ldexp(plain.weight, 2 * power), twice.weight)
    for name in ("energy_weighted", "masked", "joint", "error"):
        assert getattr(plain, name) == getattr(twice, name)
        assert getattr(plain, name) == pytest.approx(getattr(other, name), abs=1e-11)


def test_entropy_moves_with_the_field():
    here, there = (local_entropy(packet(c)[None]) for c in (250.0, 310.0))
    loud = slice(190, 311)
    moved = slice(250, 371)
    assert there[0][0, moved] == pytest.approx(here[0][0, loud], abs=1e-8)
    assert there[1][0, moved] == pytest.approx(here[1][0, loud], rel=1e-8)


def test_snapshots_do_not_see_each_other():
    signal = run()
    local, weight = local_entropy(signal)
    for first in (1, 4, 7, 11):
        late = local_entropy(signal[first:])
        assert np.array_equal(local[first:], late[0])
        assert np.array_equal(weight[first:], late[1])


def test_averages_are_what_they_say():
    signal = run()
    start = 5
    signal[:5] *= 100  # loud before the averages start: it must not count
    signal[8:] *= 0.05
    found = entropy(signal, start)
    h, w = found.local[start:], found.weight[start:]
    assert found.snapshot.shape == (12,)
    assert found.snapshot[start:] == pytest.approx((h * w).sum(axis=1) / w.sum(axis=1), rel=1e-12)
    assert found.energy_weighted == pytest.approx(found.snapshot[start:].mean(), rel=1e-14)
    loud = w > 0.01 * w.max()
    assert found.masked == pytest.approx(h[loud].mean(), rel=1e-12)
    means = [h[loud[:, c], c].mean() for c in range(600) if loud[:, c].any()]
    assert found.error == pytest.approx(np.std(means), rel=1e-12)
    joint = []
    for one in signal[start:]:
        power = np.abs(transform(one, KAPPA, KC)[:, :600]) ** 2
        joint.append(bits(power.ravel()))
    assert found.joint == pytest.approx(np.mean(joint), abs=1e-6)


def test_the_mask_leaves_out_where_the_run_grows_quiet():
    signal = run()
    signal[8:] *= 0.01
    assert entropy(signal).masked == pytest.approx(entropy(signal[:8]).masked)


def test_scattering_raises_every_average():
    before = entropy(packet(200.0)[None])
    after = entropy((packet(200.0) + packet(220.0, kappa=1.1))[None])
    for name in ("energy_weighted", "masked", "joint"):
        assert getattr(after, name) > getattr(before, name) + 0.1


def test_rest_has_no_entropy():
    found = entropy(np.zeros((3, 50)))
    assert not found.local.any()
    assert not found.weight.any()
    assert (found.energy_weighted, found.masked, found.joint, found.error) == (0, 0, 0, 0)
    signal = noise((6, 50))
    signal[2] = 0
    found = entropy(signal)
    assert found.snapshot[2] == 0
    assert np.all(np.delete(found.snapshot, 2) > 0)


def test_bad_requests_are_named():
    signal = noise((3, 20))
    with pytest.raises(ValueError, match="start"):
        entropy(signal, 3)
    signal[1, 4] = np.nan
    with pytest.raises(ValueError, match="not finite in samples 0 to 2"):
        entropy(signal)
