"""Spectral measures of waves against closed forms, and their sums against Parseval's identity."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import fft
from scipy.integrate import trapezoid

from vipetsc.lattice import Band, bloch, four_band
from vipetsc.spectra import (
    CellWindow,
    Parts,
    block_means,
    dispersion,
    dispersions,
    estimated_peak,
    front_arrival,
    ibtet,
    kinetic_energy,
    part_energies,
    peak_arrival,
    ridge,
    taper,
    wavenumber_content,
)

MASSES = (0.5, 2.0)


def noise(shape, seed=0):
    """Return standard normal numbers."""
    return np.random.default_rng(seed).standard_normal(shape)


def split(signal, interval, edges):
    """Yield the parts of ``signal`` (t, ...) between consecutive ``edges`` in rad/s, at every sample."""
    nt = len(signal)
    spectrum = fft.dct(signal, type=1, axis=0)
    frequency = np.pi * np.arange(nt) / ((nt - 1) * interval)
    part = np.searchsorted(edges, frequency, side="right") - 1

    # The shape lets one value for each time apply to all further axes.
    part = part.reshape(-1, *[1] * (signal.ndim - 1))
    for number in range(len(edges) - 1):
        yield fft.idct(np.where(part == number, spectrum, 0.0), type=1, axis=0)


@pytest.mark.parametrize(("row", "direction"), [(5, 1), (5, -1), (12, 1)])
def test_a_plane_wave_lands_on_its_bin(row, direction):
    """A wave of whole periods in time and space has all its energy in one bin of wavenumber and frequency."""
    nt = 128
    n = 48
    interval = 0.01
    column = 17
    kappa = direction * 2 * np.pi * row / n
    omega = 2 * np.pi * column / (nt * interval)
    t = np.arange(nt)[:, None] * interval
    x = np.arange(n)
    mass = 2.0
    velocity = np.cos(kappa * x - omega * t)[..., None]

    found = dispersion(velocity, [mass], interval, tapers=(0, 0))

    k, w = np.unravel_index(np.argmax(found.energy), found.energy.shape)
    assert found.wavenumber[k] == pytest.approx(kappa)
    assert found.frequency[w] == pytest.approx(omega)
    # The energy is the sum over the cells of (m/2) cos^2, and the mean of cos^2 is 1/2.
    assert found.energy[k, w] == pytest.approx(0.5 * mass * n * 0.5)
    assert np.delete(found.energy.ravel(), found.energy.argmax()).max() < 1e-20

    fold = found.folded()
    k, w = np.unravel_index(np.argmax(fold.energy), fold.energy.shape)
    assert fold.wavenumber[k] == pytest.approx(abs(kappa))


@settings(max_examples=30)
@given(st.integers(2, 40), st.integers(2, 40), st.integers(0, 99))
def test_energies_obey_parseval(nt, n, seed):
    """Energies over wavenumbers and frequencies sum to the kinetic energy, for records of any lengths."""
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
    """The energies of all parts, integrated over time, sum to that of the signal."""
    edges = np.array([0.0, *sorted(inner), np.inf])
    signal = noise((nt, n), seed)

    # The trapezoidal rule is the one in which cosines of a DCT-I are orthogonal.
    energy = part_energies(signal[..., None], [2.0], 0.1, edges).total.sum(axis=0)
    assert trapezoid(energy) == pytest.approx(trapezoid(np.sum(signal**2, axis=1)), rel=1e-12)


@settings(max_examples=60)
@given(st.integers(2, 300), st.floats(0, 1), st.floats(0, 1), st.integers(0, 99))
def test_few_times_give_the_energy_of_a_part_at_every_sample(nt, one, other, seed):
    """Energies of a part, computed at as few times as its width needs, are exact at every sample, for any position."""
    # The highest frequency of samples at this interval.
    interval = 0.1
    highest = np.pi / interval
    edges = sorted((highest * one, highest * other))
    velocity = noise((nt, 3, 2), seed)

    (part,) = split(velocity, interval, edges)
    expected = kinetic_energy(part, MASSES).sum(axis=1)

    energy = part_energies(velocity, MASSES, interval, edges).total
    # An empty part has the energy 0.
    tolerance = 1e-12 * expected.max() + 1e-300
    assert np.allclose(energy, [expected], rtol=0, atol=tolerance)


@settings(max_examples=60)
@given(st.integers(2, 300), st.floats(0, 1), st.floats(0, 1), st.integers(1, 9), st.integers(1, 7), st.booleans())
def test_maps_of_parts_are_means_of_their_energy(nt, one, other, samples, cells, whole):
    """Maps of a part are means of its energy over blocks of samples and cells, of which the last may be shorter."""
    interval = 0.1
    highest = np.pi / interval
    edges = sorted((highest * one, highest * other))
    velocity = noise((nt, 5, 2))

    (part,) = split(velocity, interval, edges)
    energy = kinetic_energy(part, MASSES)
    expected = block_means(block_means(energy, samples, 0), cells, 1)

    kept = {"mapped": (0,), "sizes": (samples, cells), "memory": np.inf if whole else 1.0}
    found = part_energies(velocity, MASSES, interval, [*edges, np.inf], **kept)
    # Maps are kept in single precision.
    assert found.maps.dtype == np.float32
    assert np.allclose(found.maps, [expected], rtol=1e-6, atol=1e-12 * energy.max() + 1e-300)


def test_a_last_wide_part_is_coarser_by_the_stride():
    """The energy above the last edge is interpolated between every tenth sample; other parts stay exact."""
    velocity = noise((100, 3, 2))
    edges = [0.0, 20.0, np.inf]
    every = part_energies(velocity, MASSES, 0.1, edges, 1).total
    tenth = part_energies(velocity, MASSES, 0.1, edges, 10).total
    assert np.allclose(every[0], tenth[0], rtol=1e-12)
    assert not np.allclose(every[1], tenth[1], rtol=0.1)
    # 99 steps become 10; the samples 0 and 99 belong to both.
    assert np.allclose(every[1, [0, 99]], tenth[1, [0, 99]], rtol=1e-12)


def test_parts_of_bands_that_overlap_touch_or_begin_above_zero():
    """Bands that overlap are one part; there is a gap below a first band unless that begins at zero within rounding."""
    merged = Parts.of([Band(1, 0.0, 2.0), Band(2, 1.0, 3.0), Band(3, 5.0, 6.0)])
    assert merged.bands == ((1, 2), (), (3,), ())
    assert merged.edges.tolist() == [0, 3, 5, 6, np.inf]
    assert Parts.of([Band(1, 4.0, 6.0)]).names == ("gap 1", "band 1", "above")
    assert list(Parts.of([Band(1, 0.0, 5.0), Band(2, 1.0, 3.0), Band(3, 6.0, 7.0)]).edges) == [0, 5, 6, 7, np.inf]
    # The lowest frequency of a free lattice is zero within rounding.
    assert Parts.of([Band(1, 1e-9, 6.0)]).names == ("band 1", "above")


def test_transfer_is_the_mean_fraction_after_arrival():
    """The transfer is the mean over time, from the arrival on, of the fraction of the energy above the drive."""
    energy = np.array([[1.0, 1.0, 3.0], [0.0, 1.0, 1.0]])
    above = np.array([False, True])

    # The fractions from sample 1 on are 1/2 and 1/4.
    assert ibtet(energy, above, 1) == pytest.approx((0.5 + 0.25) / 2)
    # The transfer is NaN without a part above the drive, and without energy.
    assert np.isnan(ibtet(energy, ~above & above))
    assert np.isnan(ibtet(0 * energy, above))


@pytest.mark.parametrize(("middle", "width", "size"), [(0.4, 0.1, 1.0), (0.6, 0.2, -3e-9), (0.9, 0.3, 1e5)])
def test_front_and_peak_of_a_packet_arrive_when_its_formula_says(middle, width, size):
    """A packet A exp(-((t - m)/s)^2) has its front at m - s sqrt(ln(100)/2), and its peak at m."""
    time = np.linspace(0.0, 2.0, 4001)
    velocity = size * np.exp(-(((time - middle) / width) ** 2))
    front = middle - width * np.sqrt(np.log(100) / 2)

    assert time[front_arrival(velocity**2)] == pytest.approx(front, abs=time[1])
    assert time[peak_arrival(velocity)] == pytest.approx(middle, abs=time[1] / 2)
    assert peak_arrival(np.stack([velocity, velocity[::-1]], axis=1)).tolist() == [
        peak_arrival(velocity),
        4000 - peak_arrival(velocity),
    ]


@pytest.mark.parametrize(("speed", "expected"), [(100.0, 0.25), (0.0, 0.05)])
def test_the_middle_of_a_burst_travels_at_the_group_velocity(speed, expected):
    assert estimated_peak(duration=0.1, distance=20, speed=speed) == pytest.approx(expected)


def test_taper_keeps_the_mean_square():
    """Tapers of any width are symmetric, with the mean square 1, and begin near zero."""
    for fraction in (0.0, 0.1, 1.0):
        window = taper(101, fraction)
        assert np.mean(window**2) == pytest.approx(1, rel=1e-14)
        assert np.allclose(window, window[::-1])
    assert taper(101, 0.2)[0] < 1e-2


def test_windows_of_a_dispersion_are_dispersions_of_their_cells():
    """A window of cells, from one transform in time of all cells, has the dispersion of the field of these cells."""
    velocity = noise((40, 21, 2), 3)
    windows = [CellWindow(), CellWindow(slice(0, 8), taper=0.5), CellWindow(slice(9, 21), taper=0.2)]
    options = {"lengths": (45, 24), "highest": 20.0}

    found = dispersions(velocity, MASSES, 0.1, windows, **options)
    assert found[0].frequency[-1] <= 20.0
    for spectrum, window in zip(found, windows, strict=True):
        (alone,) = dispersions(velocity[:, window.cells], MASSES, 0.1, [CellWindow(taper=window.taper)], **options)
        assert np.allclose(spectrum.energy, alone.energy, rtol=1e-12, atol=1e-15 * alone.energy.max())


def test_ridge_of_a_packet_lies_on_the_branch():
    """The ridge of a packet of Bloch waves of band 2 lies on that band, to a tenth of a bin of frequency."""
    cell = four_band("calibrated")
    n = 128
    interval = 4e-4
    rows = np.arange(28, 46)
    kappa = 2 * np.pi * rows / n
    weight = np.exp(-(((rows - 37) / 4) ** 2))
    omega = bloch(cell, kappa).frequency[:, 1]
    t = np.arange(1200) * interval
    x = np.arange(n)
    waves = np.exp(-1j * omega * t[:, None]) * weight
    velocity = (waves @ np.exp(1j * kappa[:, None] * (x - 40))).real[..., None]

    found, frequency = ridge(dispersion(velocity, [1.0], interval, tapers=(1, 0)), floor=1e-2)
    assert len(found) >= 10
    # The packet travels in one direction.
    assert np.all(found > 0)
    branch = bloch(cell, found).frequency[:, 1]
    assert np.abs(frequency / branch - 1).max() < 1e-3
    # The ridge is refined off the grid of frequencies.
    bin_width = 2 * np.pi / (1200 * interval)
    assert np.abs(frequency - branch).max() < 0.1 * bin_width
