"""Names of files that contain numbers have as many digits as distinguish these numbers."""

import pytest

from vipetsc.wording import distinct


@pytest.mark.parametrize(
    ("numbers", "names"),
    [
        ([1023.27, 1023.2701], ["1023.27", "1023.2701"]),
        ([0.7, 0.7000001, 0.3], ["0.7", "0.7000001", "0.3"]),
        ([1420.0, 1420.001], ["1420", "1420.001"]),
        # Six digits stay where they distinguish a number from all others, also next to numbers that need more.
        ([1 / 3, 1000 / 3, 1e7], ["0.333333", "333.333", "1e+07"]),
        ([1 / 3, 1420.0, 1420.001], ["0.333333", "1420", "1420.001"]),
        ([1.0, 1.0 + 2**-52], ["1", "1.0000000000000002"]),
    ],
)
def test_numbers_that_differ_have_names_that_differ(numbers, names):
    """Each number is written with six digits, or with as many as distinguish it from the others."""
    assert distinct(numbers) == names
