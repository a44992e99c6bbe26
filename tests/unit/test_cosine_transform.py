"""The cosine transform of many columns against scipy's."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import fft

from vipetsc.spectra.cosine_transform import CosineTransform


@settings(max_examples=60)
@given(st.integers(2, 200), st.integers(0, 5), st.booleans(), st.integers(0, 99))
def test_it_is_the_first_kind_of_any_length(rows, columns, strided, seed):
    """The transform of contiguous or strided columns is SciPy's discrete cosine transform of type 1."""
    values = np.random.default_rng(seed).standard_normal((rows, columns))
    values = np.asfortranarray(values) if strided else values
    transform = CosineTransform(rows, columns)
    expected = fft.dct(values, type=1, axis=0)
    assert np.allclose(transform(values), expected, rtol=0, atol=1e-13 * rows)
    # A second call, of fewer columns, uses the memory of the first one.
    assert np.allclose(transform(values[:, 1:]), expected[:, 1:], rtol=0, atol=1e-13 * rows)


def test_rounding_stays_small_in_a_long_record():
    """Two cosines of amplitudes 1 and 1e-9 have their coefficients to 1e-13 and 1e-14; 5534 is twice a prime."""
    for last in (4420, 4421, 5534):
        angle = np.pi * np.arange(last + 1) / last
        record = np.cos(101 * angle) + 1e-9 * np.cos(3333 * angle)
        spectrum = CosineTransform(last + 1, 1)(record[:, None])[:, 0] / last
        assert abs(spectrum[101] - 1) < 1e-13
        assert abs(spectrum[3333] - 1e-9) < 1e-14
        assert np.abs(np.delete(spectrum, [101, 3333])).max() < 1e-14
