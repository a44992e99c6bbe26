"""Compliance between sites: against dense solutions, long damped lattices, Bloch sums, reciprocity, energy."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from vipetsc.lattice import Chain, Spring, UnitCell, Variation, bloch, diatomic, four_band
from vipetsc.lattice.compliance.by_elimination import DirectCompliance
from vipetsc.lattice.compliance.by_modes import ModalCompliance
from vipetsc.lattice.compliance.by_waves import WaveCompliance
from vipetsc.lattice.compliance.dense import DenseCompliance
from vipetsc.lattice.damped import damped_waves
from vipetsc.lattice.ends import EndSection, Side, condensed, reflections
from vipetsc.lattice.sites import sites_at

pytestmark = pytest.mark.parallel(1)

# The three springs to the next cell start at two masses and end at two: there are two waves in each direction.
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
# Frequencies in rad/s in bands and gaps, far above all bands, damped, with negative real parts, almost imaginary.
FREQUENCIES = [123.4, 1023.27, 1700.0, 3000.0 - 3j, 9000.0, 40000.0, -800.0 - 20j, 50.0 - 200j]
# The frequency of the paper's drive in rad/s, in band 2.
DRIVEN = 1023.27


def chain_of(cell: UnitCell, cells: int, sites: Sequence[int], ends: str = "fixed") -> Chain:
    """Return a chain with contacts at ``sites``, whose clearances do not matter here."""
    return Chain(cell, cells, ends, sites_at(sites, cell.pair, clearances=1e-3))


def relative_error(found: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest difference over the largest expected value."""
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def site_rows(chain: Chain) -> np.ndarray:
    """Return rows (site, mass of the chain) that yield w = u_resonator - u_host from displacements."""
    cell = chain.cell
    rows = np.zeros((len(chain.sites), chain.cells * cell.dofs))
    for row, site in zip(rows, chain.sites.cells, strict=True):
        row[site * cell.dofs + cell.resonator] = 1
        row[site * cell.dofs + cell.host] = -1
    return rows


# Chains (cells, sites) of one and two cells, and with contacts at ends, next to each other and far apart.
FINITE = [(1, (0,)), (2, (0, 1)), (12, (0, 2, 3, 11))]


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
@pytest.mark.parametrize("name", CELLS)
@pytest.mark.parametrize(("cells", "sites"), FINITE)
def test_the_compliance_of_a_finite_lattice_is_that_of_dense_matrices(name, ends, cells, sites):
    """Compliance and fields by waves are those of (K - omega^2 M)^-1, for all ends, sites and frequencies."""
    chain = chain_of(CELLS[name], cells, sites, ends)
    d = chain.cell.dofs
    # A mass of the last cell stands for a driven one.
    compliance = WaveCompliance(chain, points=((cells - 1, 0),))
    point = np.eye(cells * d)[(cells - 1) * d]
    rows = site_rows(chain)
    stiffness = chain.stiffness_matrix().toarray()
    forces = np.arange(1, len(sites) + 2) * (1 + 0.3j)

    for omega, found in zip(FREQUENCIES, compliance.response(FREQUENCIES), strict=True):
        inverse = np.linalg.inv(stiffness - np.diag(chain.masses()) * omega**2)
        expected = rows @ inverse @ np.vstack([rows, point]).T
        assert relative_error(found, expected) < 1e-11
        field = (inverse @ (forces[-1] * point - forces[:-1] @ rows)).reshape(cells, d)
        assert relative_error(compliance.field(omega, forces, np.arange(cells)), field) < 1e-11

    dense = DenseCompliance(chain.masses(), stiffness, rows)
    for omega in (0.0, *FREQUENCIES):
        assert relative_error(compliance.at(omega), dense.at(omega)) < 1e-11
    field = dense.field(1700.0, forces[:-1]).reshape(cells, d)
    assert relative_error(compliance.field(1700.0, forces[:-1], np.arange(cells)), field) < 1e-11


@pytest.mark.parametrize("name", CELLS)
def test_an_infinite_lattice_is_the_limit_of_long_damped_ones(name):
    """A lattice of 1000 cells in which waves decay has the compliance of the infinite one.

    At a real omega the infinite lattice has the limit from Im omega < 0.
    """
    chain = chain_of(CELLS[name], 1000, (500, 503), "free")
    infinite = WaveCompliance(chain, infinite=True)
    # Waves of these frequencies decay before they reach an end.
    for omega in (0.0, 400 - 40j, DRIVEN - 40j, 3100.0 - 90j, 8000.0):
        assert relative_error(WaveCompliance(chain).at(omega), infinite.at(omega)) < 1e-10

    # On the real axis the compliance is the limit from below, where waves go outwards.
    on_axis = infinite.at(DRIVEN)
    assert relative_error(on_axis, infinite.at(DRIVEN - 1e-6j)) < 1e-6
    assert infinite.at(-DRIVEN)[0, 0, 1] == on_axis[0, 0, 1].conj()


def bloch_sum(cell: UnitCell, wavenumbers: np.ndarray, omega: complex) -> complex:
    """Return the self-compliance of a site in a ring with these ``wavenumbers``, as a sum over its Bloch waves."""
    waves = bloch(cell, wavenumbers)
    weight = np.abs(waves.vectors[:, cell.resonator] - waves.vectors[:, cell.host]) ** 2
    return np.mean(np.sum(weight / (waves.frequency**2 - omega**2), axis=1))


def test_self_compliance_is_a_sum_over_bloch_waves():
    """The self-compliance is the mean over wavenumbers of sum |u_r - u_h|^2/(omega_b^2 - omega^2), over the bands b."""
    cell = CELLS["four-band"]
    infinite = WaveCompliance(chain_of(cell, 1, (0,)), infinite=True)
    wavenumbers = 2 * np.pi * np.arange(4096) / 4096
    for omega in (10.0 - 20j, 900.0 - 20j, 3000.0 - 20j):
        expected = bloch_sum(cell, wavenumbers, omega)
        assert infinite.at(omega)[0, 0, 0] == pytest.approx(expected, rel=1e-11)


@pytest.mark.parametrize("name", CELLS)
@pytest.mark.parametrize(("band", "direction"), [(1, 1), (2, -1)])
# The first spring is elastic, the second one takes energy.
@pytest.mark.parametrize("spring", [3e3, 3e3 * (1 + 0.2j)])
def test_linear_scatterers_conserve_the_energy_but_for_what_they_take(name, band, direction, spring):
    """Flux that leaves and power that complex springs take, Re(F* i omega w)/2, sum to the incident flux."""
    cell = CELLS[name]
    chain = chain_of(cell, 30, (7, 12))
    compliance = WaveCompliance(chain, infinite=True)
    omega = float(bloch(cell, 1.3).frequency[band - 1])
    wave = compliance.incident(omega, band, direction)

    w = np.linalg.solve(np.eye(2) + compliance.at(omega)[0] * spring, wave.relative)

    taken = 0.5 * np.sum(np.real((spring * w).conj() * 1j * omega * w))
    leaving = compliance.outgoing(omega, spring * w, wave, 1.0)
    assert leaving.sum() + taken == pytest.approx(wave.flux, rel=1e-11)
    assert leaving.min() >= 0
    # The displacements by the incident wave and the springs' forces have the same w.
    u = wave.field(chain.sites.cells) + compliance.field(omega, spring * w, chain.sites.cells)
    assert np.allclose(u[:, cell.resonator] - u[:, cell.host], w, rtol=1e-11)


def test_the_flux_is_energy_times_group_velocity():
    """The flux of a wave is (sum m |u|^2) omega^2/2 times the group velocity; a gap has no wave."""
    cell = CELLS["four-band"]
    kappa = 1.1
    point = bloch(cell, kappa)
    compliance = WaveCompliance(chain_of(cell, 3, (1,)), infinite=True)
    wave = compliance.incident(float(point.frequency[2]), 3)
    energy = np.sum(np.array(cell.masses) * np.abs(wave.shape) ** 2) * wave.frequency**2 / 2
    assert wave.flux == pytest.approx(energy * abs(point.group_velocity[2]), rel=1e-9)
    assert wave.wavenumber == pytest.approx(kappa, rel=1e-9)
    with pytest.raises(ValueError, match="no wave of band 1"):
        compliance.incident(2700.0, 1)


@pytest.mark.parametrize("ends", ["fixed", "free"])
@pytest.mark.parametrize("end", ["left", "right"])
def test_an_end_without_dashpots_sends_back_all_of_each_waves_energy(ends, end):
    """The energies of the waves that go back add up to that of the one that comes, also where these are two."""
    # Two rows of masses that are joined in each cell, with two waves of one frequency.
    cell = UnitCell((1.0, 1.0), (Spring(0, 0, 1e4, True), Spring(1, 1, 4e3, True), Spring(0, 1, 3e3)), 0, 1)
    waves = damped_waves(cell, 110.0)
    assert np.all(Side.at(end, waves).decay() < 1e-7)
    other = Variation(masses=np.array([[1.5, 0.7], [0.6, 1.2], [2.0, 1.0]]))
    z = condensed(EndSection(Chain(cell, 3, ends, variation=other), 2, end), np.array([110.0]))[0]
    assert reflections(z, waves, end) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("damping", [0.0, 0.4])
def test_a_force_on_one_mass_of_a_free_lattice_moves_its_pairs_as_by_elimination(damping):
    """What all modes leave of the motion as a rigid body does not move a pair, however slow it is."""
    cell = CELLS["tense"]
    cell = replace(cell, springs=tuple(replace(spring, damping=damping) for spring in cell.springs))
    chain = chain_of(cell, 6, (1, 4), "free")
    omega = np.array([0.1, 30.0, 700.0, 5000.0])
    found = ModalCompliance(chain, points=((2, 0), (5, 3))).response(omega)
    expected = DirectCompliance(chain, points=((2, 0), (5, 3))).response(omega)
    assert relative_error(found, expected) < 1e-7


def test_a_long_lattice_costs_what_a_short_one_does():
    """The number of unknowns does not grow with the cells; with losses a long lattice is as an infinite one."""
    cell = CELLS["four-band"]
    long = chain_of(cell, 1_000_000, (500_000,))
    assert WaveCompliance(chain_of(cell, 40, (20,))).loaded_cells == [0, 20, 39]
    assert WaveCompliance(long).loaded_cells == [0, 500_000, 999_999]
    # A wave of this frequency, at 429 cells/s, decays by a factor e within 4300 cells.
    omega = DRIVEN - 0.1j
    assert relative_error(WaveCompliance(long).at(omega), WaveCompliance(long, infinite=True).at(omega)) < 1e-11


def test_an_infinite_lattice_is_at_rest_beyond_static_forces():
    """Static forces at two pairs strain the cells between them; beyond, all cells of a side are shifted alike."""
    compliance = WaveCompliance(chain_of(CELLS["four-band"], 30, (10, 14)), infinite=True)
    field = compliance.field(0.0, [1.0, -0.3], [-60, -20, 9, 15, 40, 90])
    assert field[0] == pytest.approx(field[1], rel=1e-9)
    assert field[4] == pytest.approx(field[5], rel=1e-9)
    assert np.ptp(field[1].real) < 1e-9 * np.abs(field).max()
