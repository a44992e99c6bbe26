"""Bands, matrices, contacts and drives of lattices against closed forms, other computations and published numbers."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vipetsc.lattice import (
    Chain,
    Contact,
    Spring,
    ToneBurst,
    UnitCell,
    bloch,
    diatomic,
    four_band,
    gaps,
    max_group_velocity,
    pass_bands,
    waves_at,
)
from vipetsc.lattice.bands import fastest_speed
from vipetsc.lattice.cell import cell_problems


@st.composite
def cells(draw):
    """Draw a connected cell: a line of masses, and one or two springs to the next cell."""
    n = draw(st.integers(2, 5))
    positive = st.floats(0.1, 10)
    mass = st.integers(0, n - 1)
    masses = tuple(draw(st.lists(positive, min_size=n, max_size=n)))
    # The line connects all masses: a mass without springs would have the frequency 0.
    springs = [Spring(i, i + 1, draw(positive)) for i in range(n - 1)]
    for _ in range(draw(st.integers(1, 2))):
        springs.append(Spring(draw(mass), draw(mass), draw(positive), offset=1))
    host = draw(mass)
    return UnitCell(masses, tuple(springs), host, (host + 1) % n)


@pytest.mark.parametrize(
    ("cell", "edges"),
    [
        (four_band(), [0, 836.47, 947.07, 1414.21, 2331.09, 3162.28, 3271.55, 3669.65]),
        (four_band("calibrated"), [0, 612.25, 681.48, 1414.21, 2267.36, 3162.28, 3214.90, 3644.75]),
        (diatomic(), [0, 946.27, 3181.98, 6725.29]),
    ],
)
def test_pass_bands_and_gaps_are_the_published_ones(cell, edges):
    """Edges of bands and gaps are those published for the three cells of the paper."""
    found = pass_bands(cell)
    # The published edges have two decimals.
    assert np.ravel([(band.low, band.high) for band in found]) == pytest.approx(edges, abs=0.006)
    assert np.ravel(gaps(found)) == pytest.approx(edges[1:-1], abs=0.006)


def test_published_drive_frequencies_and_speeds():
    """Frequencies and group velocities of the paper's drives are the published ones."""
    # The paper drives the wavenumber 5 pi/9.
    optical = bloch(diatomic(), 5 * np.pi / 9)
    assert optical.frequency[1] == pytest.approx(5520.026, abs=1e-3)
    assert optical.group_velocity[1] == pytest.approx(1587, abs=0.5)

    assert max_group_velocity(four_band(), 2)[1] == pytest.approx(1206.34, abs=0.01)
    _, frequency, speed = max_group_velocity(four_band("calibrated"), 2)
    assert frequency == pytest.approx(1023.2717, abs=1e-3)
    assert speed == pytest.approx(428.7, abs=0.05)


@pytest.mark.parametrize("cell", [four_band(), four_band("calibrated"), diatomic()])
def test_waves_at_a_frequency_lie_on_the_branch(cell):
    """The wave at a frequency of band 2 is that of its wavenumber on the branch, with the branch's group velocity."""
    _, frequency, speed = max_group_velocity(cell, 2)
    # There is one wave, since bands do not overlap at this frequency.
    ((band, kappa, found),) = waves_at(cell, frequency)
    assert band == 2
    assert found == pytest.approx(speed, rel=1e-6)
    assert bloch(cell, kappa).frequency[1] == pytest.approx(frequency, rel=1e-12)


@settings(max_examples=40)
@given(cells(), st.floats(0.3, 2.8))
def test_bloch_vectors_solve_the_problem_and_group_velocity_is_the_slope(cell, kappa):
    """Bloch waves solve K(kappa) u = omega^2 M u, are orthonormal in M, and have c_g = d omega/d kappa."""
    point = bloch(cell, kappa)
    m = np.diag(cell.masses)
    assert np.allclose(point.vectors.conj().T @ m @ point.vectors, np.eye(cell.dofs), atol=1e-9)
    residual = cell.stiffness_matrix(kappa) @ point.vectors - m @ point.vectors * point.frequency**2
    assert np.abs(residual).max() < 1e-8

    # Where branches meet, a difference quotient would take one value from each of two branches.
    squared = np.sort(point.frequency**2)
    is_apart = np.diff(squared).min() > 1e-2 and squared[0] > 1e-2
    if is_apart:
        h = 1e-5
        slope = (bloch(cell, kappa + h).frequency - bloch(cell, kappa - h).frequency) / (2 * h)
        assert np.allclose(point.group_velocity, slope, atol=1e-5)


@settings(max_examples=25)
@given(cells(), st.integers(3, 9))
def test_a_periodic_chain_has_the_bloch_frequencies(cell, n):
    """The modes of a ring of n cells are the Bloch waves of the wavenumbers 2 pi j/n."""
    chain = Chain(cell, n, "periodic")
    root = 1 / np.sqrt(chain.masses())
    squared = np.linalg.eigvalsh(chain.stiffness_matrix().toarray() * root[:, None] * root)
    # The wavenumbers that fit on a ring of n cells.
    expected = np.sort(bloch(cell, 2 * np.pi * np.arange(n) / n).frequency.ravel() ** 2)
    assert np.allclose(squared, expected, atol=1e-8)


@settings(max_examples=25)
@given(cells(), st.integers(2, 6))
def test_fixed_ends_are_free_ones_with_springs_to_walls(cell, n):
    """Fixed ends add to the free chain, on the diagonal, the springs to the next cell that end at walls."""
    fixed = Chain(cell, n, "fixed").stiffness_matrix().toarray()
    free = Chain(cell, n, "free").stiffness_matrix().toarray()
    assert np.array_equal(fixed, fixed.T)
    # A free chain that moves as a whole strains no spring.
    assert np.allclose(free.sum(axis=1), 0, atol=1e-9)

    walls = np.zeros(n * cell.dofs)
    for spring in cell.springs:
        if spring.offset:
            walls[spring.end] += spring.stiffness
            walls[-cell.dofs + spring.start] += spring.stiffness
    assert np.allclose(fixed - free, np.diag(walls), atol=1e-9)


def test_cell_problems_are_all_named():
    # The problems are a negative mass, a spring from a mass to itself, a spring of no stiffness to a mass that
    # does not exist, and a contact of a mass with itself.
    springs = (Spring(0, 0, 1.0), Spring(0, 5, 0.0))
    keys = {key for key, _ in cell_problems((1.0, -1.0), springs, 1, 1)}
    assert keys == {"masses[2]", "springs[1]", "springs[2].stiffness", "springs[2]", "contact"}
    assert cell_problems(diatomic().masses, diatomic().springs, 0, 1) == []


@pytest.mark.parametrize(("envelope", "peak"), [("paper", 2.0), ("hann", 1.0)])
def test_a_burst_begins_and_ends_at_rest_and_peaks(envelope, peak):
    """The paper's window 1 - cos has the peak 2, Hann's half of it."""
    burst = ToneBurst(3.0, 100.0, 30, envelope)
    # The burst has 30 cycles at 100 rad/s.
    assert burst.duration == pytest.approx(0.6 * np.pi)

    t = np.linspace(-0.1, burst.duration + 0.1, 200_001)
    force = burst.force(t)
    assert np.all(force[(t <= 0) | (t >= burst.duration)] == 0)
    # The oscillation need not have a crest where the window has its peak.
    assert np.abs(force).max() == pytest.approx(3 * peak, rel=5e-3)
    middle = 0.3 * burst.duration
    assert burst.force(middle) == pytest.approx(3 * peak / 2 * (1 - np.cos(2 * np.pi * 0.3)) * np.sin(100 * middle))


def test_the_scale_of_the_wave_is_that_of_the_mass_that_is_driven():
    """The scale is the peak force times the largest |Green's function| of the whole lattice for the driven mass."""
    burst = ToneBurst(2.0, 1206.34, 30)
    # A complex frequency gives the waves the length of the burst.
    omega = 1206.34 * (1 - 1j / 30)
    cell = four_band()
    for chain in (Chain(cell, 12), Chain(cell, 12, "free"), Chain(diatomic(), 12), Chain(cell, 13)):
        dynamic = chain.stiffness_matrix().toarray() - omega**2 * np.diag(chain.masses())
        green = np.abs(np.linalg.inv(dynamic)).reshape(chain.cells, chain.cell.dofs, -1)
        for driven, mass in ((0, 0), (0, 1), (5, 1), (11, 0)):
            expected = burst.peak * green[driven, mass].max()
            assert chain.wave_scale(burst, cell=driven, mass=mass) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("ends", ["fixed", "free"])
@pytest.mark.parametrize("driven", [0, 1, 199, 200, 300, 500, 700, 799, 800, 999])
def test_the_scale_of_the_wave_in_a_long_lattice_is_that_of_the_driven_cell(ends, driven, monkeypatch):
    """A lattice of 1000 cells is cut to 400 with the driven cell as far from its ends, wherever that cell is."""
    chain = Chain(four_band(), 1000, ends)
    # The waves of ten cycles decay within the 200 cells that the cut leaves to either side.
    burst = ToneBurst(1.0, 1206.34, 10)
    cut = chain.wave_scale(burst, cell=driven)
    monkeypatch.setattr("vipetsc.lattice.chain.LONGEST", chain.cells)
    assert cut == pytest.approx(chain.wave_scale(burst, cell=driven), rel=1e-9)


def test_a_fast_separation_pulls_unless_it_is_clipped_or_the_approach_has_a_floor():
    """g = 1 + c w'/w'_minus is negative at a fast separation, 0 if clipped, and bounded by a floor of w'_minus."""
    contact = Contact("hertz", 1e6, 0.7)
    assert contact.dissipation_factor(-1.0, 0.1) < 0
    assert Contact("hertz", 1e6, 0.7, adhesion="clip").dissipation_factor(-1.0, 0.1) == 0
    floored = Contact("hertz", 1e6, 0.7, approach_floor=0.5)
    # The floor of 0.5 m/s takes the sign of the approach: with the rate 1 m/s, g = 1 - c/0.5 and c = 0.45.
    assert floored.dissipation_factor(1.0, -1e-12) == pytest.approx(1 - 0.9)


@pytest.mark.parametrize("masses", [2, 3, 7, 40])
def test_a_chain_of_equal_masses_has_no_gaps_in_whatever_cells_it_is_counted(masses):
    """Bands of a cell of n equal masses are one folded band, omega = 2 sin(q/2), and touch where it is folded.

    Its waves have the speed cos(q/2) = (1 - omega^2/4)^(1/2) in masses/s, at the ends of the zone as elsewhere.
    """
    springs = [Spring(i, i + 1, 1.0) for i in range(masses - 1)]
    cell = UnitCell((1.0,) * masses, (*springs, Spring(masses - 1, 0, 1.0, offset=1)), 0, 1)
    bands = pass_bands(cell)
    assert gaps(bands) == []
    assert all(below.high == above.low for below, above in pairwise(bands))

    for kappa in (0.0, 1.0, np.pi, -1.0):
        point = bloch(cell, kappa)
        expected = np.sqrt(np.maximum(1 - point.frequency**2 / 4, 0)) / masses
        assert np.abs(point.group_velocity) == pytest.approx(expected, abs=1e-6)
        # Vectors of bands that touch still solve the problem, and still are orthogonal.
        moved = cell.stiffness_matrix(kappa) @ point.vectors
        assert moved == pytest.approx(point.vectors * point.frequency**2, abs=1e-12)
        assert point.vectors.conj().T @ point.vectors == pytest.approx(np.eye(masses), abs=1e-12)
    # Bands are in the order that they have next to the ends.
    inside = bloch(cell, [1e-3, np.pi - 1e-3]).group_velocity
    assert bloch(cell, [0.0, np.pi]).group_velocity == pytest.approx(inside, abs=2e-3)

    # At the fold, where the wave is of both bands, and a band's fastest waves.
    fold = 2 * np.sin(np.pi / (2 * masses))
    assert max(wave[2] for wave in waves_at(cell, bands[0].high)) == pytest.approx(np.sqrt(1 - fold**2 / 4) / masses)
    assert max_group_velocity(cell, 2)[2] == pytest.approx(np.sqrt(1 - fold**2 / 4) / masses, rel=1e-6)


@pytest.mark.parametrize("detuning", [1e-2, 1e-6, 2e-8])
def test_a_small_gap_is_a_gap(detuning):
    """Masses that differ a little open a gap from (2 k/m)^(1/2) to (2 k/M)^(1/2), however small."""
    springs = (Spring(0, 1, 1.0), Spring(1, 0, 1.0, offset=1))
    cell = UnitCell((1.0, 1.0 + detuning), springs, 0, 1)
    ((low, high),) = gaps(pass_bands(cell))
    assert high - low == pytest.approx(np.sqrt(2) - np.sqrt(2 / (1 + detuning)), rel=1e-4)
    # At the edges of a gap waves stand.
    assert bloch(cell, np.pi).group_velocity == pytest.approx([0, 0], abs=1e-8 / detuning)


@pytest.mark.parametrize("coupling", [10.0, 1e-2, 1e-6, 1e-9, 1e-13])
def test_cells_that_are_hardly_joined_have_slow_waves(coupling):
    """A rigid cell of two masses m has waves of sqrt(c/2m) cells/s, also where their omega^2 is rounding of others'."""
    springs = (Spring(0, 0, coupling, offset=1), Spring(0, 1, 1e4))
    cell = UnitCell((0.01, 0.01), springs, 0, 1)
    speed = np.sqrt(coupling / 0.02)
    assert abs(bloch(cell, 0.0).group_velocity[0]) == pytest.approx(speed, rel=2e-3)
    assert fastest_speed(cell) <= 1.1 * speed
