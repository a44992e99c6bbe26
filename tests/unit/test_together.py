"""Forces that hold stuck sites together, against the dense matrix of their accelerations."""

from __future__ import annotations

import numpy as np
import pytest

from vipetsc.contact.law import create_contacts
from vipetsc.contact.together import join, solve
from vipetsc.lattice import Contact


@pytest.mark.parametrize(
    ("pairs", "dependent"),
    [
        ([(i, i + 1) for i in range(40)], 0),
        ([(i, (i + 1) % 9) for i in range(9)], 1),
        ([(0, 1), (1, 2), (0, 2), (-1, 0), (2, 3)], 1),
        ([(-1, 0), (0, 1), (1, 2), (-1, 2)], 1),
        ([(0, 1), (5, 6), (2, 0), (6, 4)], 0),
    ],
)
@pytest.mark.parametrize("spread", [1.0, 1e6])
def test_forces_stop_the_relative_accelerations_of_all_sites(pairs, dependent, spread):
    """Rows, rings, loops and stops of the ground; masses that differ; sites that follow from others bear nothing."""
    rng = np.random.default_rng(1)
    count = max(max(pair) for pair in pairs) + 1
    masses = spread ** rng.uniform(0, 1, count)
    sites = create_contacts(Contact("rigid", 0.0), np.ones(len(pairs)))
    rows = np.zeros((len(pairs), count))
    for site, row, (host, resonator) in zip(sites, rows, pairs, strict=True):
        site["host"] = host
        site["resonator"] = resonator
        row[resonator] = 1
        site["resonator_inverse"] = 1 / masses[resonator]
        if host >= 0:
            row[host] = -1
            site["host_inverse"] = 1 / masses[host]

    accelerations = rows @ rng.normal(size=count)
    forces = accelerations.copy()
    joined = join(sites, np.arange(len(pairs)))
    solve(joined, forces)

    left = accelerations - rows @ (rows.T @ forces / masses)
    np.testing.assert_allclose(left, 0, atol=1e-12 * spread)
    assert np.count_nonzero(joined.diagonal == 0) == np.count_nonzero(forces == 0) == dependent
