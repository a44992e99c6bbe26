"""Compliance between sites: against dense solutions, long damped lattices, Bloch sums, reciprocity, energy."""

from dataclasses import replace

import numpy as np
import pytest

from vipetsc.lattice import Chain, Spring, UnitCell, bloch, diatomic, four_band
from vipetsc.lattice.compliance import DenseCompliance, WaveCompliance

pytestmark = pytest.mark.parallel(1)

# Three springs to the next cell, which overlap in masses: two waves of rank 2 each way.
RICH = UnitCell(
    (0.005, 0.003, 0.002, 0.004),
    (
        Spring(3, 0, 2e4, True),
        Spring(0, 1, 1e4),
        Spring(1, 3, 1e4),
        Spring(1, 2, 1e3),
        Spring(1, 1, 4e3, True),
        Spring(3, 1, 3e3, True),
    ),
    1,
    2,
)
# The pair carries the lattice's tension, so that a static force at one site moves the others.
TENSE = replace(four_band("calibrated"), host=0, resonator=3)
CELLS = {"four-band": four_band("calibrated"), "diatomic": diatomic(), "rich": RICH, "tense": TENSE}
FREQUENCIES = [123.4, 1023.27, 1700.0, 3000.0 - 3j, 9000.0, 40000.0, -800.0 - 20j, 50.0 - 200j]


def rows_of(chain):
    rows = np.zeros((len(chain.sites), chain.cells * chain.cell.dofs))
    for row, site in zip(rows, chain.sites, strict=True):
        row[site * chain.cell.dofs + chain.cell.resonator], row[site * chain.cell.dofs + chain.cell.host] = 1, -1
    return rows


def largest(error, of):
    return float(np.abs(error).max() / np.abs(of).max())


@pytest.mark.slow
@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
@pytest.mark.parametrize("name", CELLS)
@pytest.mark.parametrize(("cells", "sites"), [(1, (0,)), (2, (0, 1)), (3, (1,)), (12, (2, 3, 9)), (12, (0, 11))])
def test_finite_lattices_as_dense_ones(name, ends, cells, sites):
    chain = Chain(CELLS[name], cells, ends, sites, (1e-3,) * len(sites))
    compliance = WaveCompliance(chain, points=((cells - 1, 0),))
    rows = rows_of(chain)
    d = chain.cell.dofs
    point = np.eye(cells * d)[(cells - 1) * d]
    stiffness = chain.stiffness_matrix().toarray()
    forces = np.arange(1, len(sites) + 2) * (1 + 0.3j)
    for omega, got in zip(FREQUENCIES, compliance.response(FREQUENCIES), strict=True):
        inverse = np.linalg.inv(stiffness - np.diag(chain.masses()) * omega**2)
        expected = rows @ inverse @ np.vstack([rows, point]).T
        assert largest(got - expected, expected) < 1e-11
        field = (inverse @ (forces[-1] * point - forces[:-1] @ rows)).reshape(cells, d)
        assert largest(compliance.field(omega, forces, np.arange(cells)) - field, field) < 1e-11
    dense = DenseCompliance(chain.masses(), stiffness, rows)
    for omega in (0.0, *FREQUENCIES):
        assert largest(compliance.at(omega) - dense.at(omega), dense.at(omega)) < 1e-11
    moved = dense.field(1700.0, forces[:-1]).reshape(cells, d)
    assert largest(compliance.field(1700.0, forces[:-1], np.arange(cells)) - moved, moved) < 1e-11


@pytest.mark.parametrize("name", CELLS)
def test_an_infinite_lattice_is_the_limit_of_long_damped_ones(name):
    sites = (500, 503)
    chain = Chain(CELLS[name], 1000, "free", sites, (1e-3,) * 2)
    for omega in (0.0, 400 - 40j, 1023.27 - 40j, 3100.0 - 90j, 8000.0):
        finite = WaveCompliance(chain).at(omega)
        infinite = WaveCompliance(chain, infinite=True).at(omega)
        assert largest(finite - infinite, infinite) < 1e-10
    on_axis, below = (WaveCompliance(chain, infinite=True).at(1023.27 - decay) for decay in (0.0, 1e-6j))
    assert largest(on_axis - below, on_axis) < 1e-6  # from below, the outgoing side
    assert WaveCompliance(chain, infinite=True).at(-1023.27)[0, 0, 1] == on_axis[0, 0, 1].conj()


def test_self_compliance_is_a_sum_over_bloch_waves():
    cell = CELLS["four-band"]
    omega = np.array([10.0 - 20j, 900.0 - 20j, 3000.0 - 20j])
    waves = bloch(cell, 2 * np.pi * np.arange(4096) / 4096)
    weight = np.abs(waves.vectors[:, cell.resonator] - waves.vectors[:, cell.host]) ** 2
    sums = [np.mean(np.sum(weight / (waves.frequency**2 - w**2), axis=1)) for w in omega]
    assert np.allclose(WaveCompliance(Chain(cell, 1, sites=(0,)), infinite=True).at(omega)[:, 0, 0], sums, rtol=1e-11)


@pytest.mark.parametrize("infinite", [False, True])
def test_reciprocity(infinite):
    g = WaveCompliance(Chain(RICH, 90, sites=(3, 40, 41), clearances=(1e-3,) * 3), infinite).at(FREQUENCIES)
    assert np.abs(g - g.swapaxes(1, 2)).max() < 1e-12 * np.abs(g).max()


@pytest.mark.parametrize("name", CELLS)
@pytest.mark.parametrize(("band", "direction"), [(1, 1), (2, 1), (2, -1)])
def test_a_linear_scatterer_keeps_or_takes_the_energy(name, band, direction):
    cell = CELLS[name]
    chain = Chain(cell, 30, sites=(7, 12), clearances=(1e-3,) * 2)
    omega = float(bloch(cell, 1.3).frequency[band - 1])
    compliance = WaveCompliance(chain, infinite=True)
    wave = compliance.incident(omega, band, direction)
    assert wave.relative[0] == 1
    assert compliance.outgoing(omega, [0, 0], wave, 2.0)[0 if direction > 0 else 1].sum() == pytest.approx(
        4 * wave.flux
    )
    for spring in (3e3, 3e3 * (1 + 0.2j)):
        w = np.linalg.solve(np.eye(2) + compliance.at(omega)[0] * spring, wave.relative)
        taken = 0.5 * np.sum(np.real((spring * w).conj() * 1j * omega * w))
        leaving = compliance.outgoing(omega, spring * w, wave, 1.0)
        assert leaving.sum() + taken == pytest.approx(wave.flux, rel=1e-11)
        assert leaving.min() >= 0
        # Beyond the sites the fields are those of the waves that leave: w comes out of them too.
        u = wave.field(chain.sites) + compliance.field(omega, spring * w, chain.sites)
        assert np.allclose(u[:, cell.resonator] - u[:, cell.host], w, rtol=1e-11)


def test_the_flux_is_energy_times_group_velocity():
    cell = CELLS["four-band"]
    kappa = 1.1
    point = bloch(cell, kappa)
    compliance = WaveCompliance(Chain(cell, 3, sites=(1,)), infinite=True)
    wave = compliance.incident(float(point.frequency[2]), 3)
    energy = np.sum(np.array(cell.masses) * np.abs(wave.shape) ** 2) * wave.frequency**2 / 2
    assert wave.flux == pytest.approx(energy * abs(point.group_velocity[2]), rel=1e-9)
    assert wave.wavenumber == pytest.approx(kappa, rel=1e-9)
    with pytest.raises(ValueError, match="no wave of band 1"):
        compliance.incident(2700.0, 1)


def test_a_long_lattice_costs_what_a_short_one_does():
    """The number of unknowns does not grow; its answers with losses are those of the infinite one."""
    short, long = (Chain(CELLS["four-band"], n, sites=(n // 2,), clearances=(1e-3,)) for n in (40, 1_000_000))
    assert WaveCompliance(short).cells == [0, 20, 39] and WaveCompliance(long).cells == [0, 500_000, 999_999]
    infinite = WaveCompliance(long, infinite=True).at(1023.27 - 0.1j)
    assert largest(WaveCompliance(long).at(1023.27 - 0.1j) - infinite, infinite) < 1e-11
    ring = Chain(long.cell, 30_011, "periodic", (5,), (1e-3,))
    kappa = 2 * np.pi * np.arange(ring.cells) / ring.cells
    waves = bloch(ring.cell, kappa)
    weight = np.abs(waves.vectors[:, 2] - waves.vectors[:, 1]) ** 2
    expected = np.mean(np.sum(weight / (waves.frequency**2 - 1023.27**2), axis=1))
    assert WaveCompliance(ring).at(1023.27)[0, 0, 0] == pytest.approx(expected, rel=1e-7)


def test_an_infinite_lattice_is_at_rest_beyond_static_forces():
    """Opposite forces stretch the cells between them; beyond, all cells are shifted alike on either side."""
    compliance = WaveCompliance(
        Chain(four_band("calibrated"), 30, sites=(10, 14), clearances=(1e-3,) * 2), infinite=True
    )
    field = compliance.field(0.0, [1.0, -0.3], [-60, -20, 9, 15, 40, 90])
    assert field[0] == pytest.approx(field[1], rel=1e-9)
    assert field[4] == pytest.approx(field[5], rel=1e-9)
    assert np.ptp(field[1].real) < 1e-9 * np.abs(field).max()
