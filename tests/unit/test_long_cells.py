"""Cells of many masses: edges and speeds of their bands in closed form, at a cost that goes with the cube of masses."""

from __future__ import annotations

import numpy as np
import pytest

from vipetsc.lattice import Spring, UnitCell, bands, fastest_speed, pass_bands


def folded(masses: int) -> UnitCell:
    """Return the cell of a chain of equal masses and springs that takes ``masses`` of them as one cell."""
    springs = tuple(Spring(i, (i + 1) % masses, 1e4, offset=int(i == masses - 1)) for i in range(masses))
    return UnitCell(masses=(0.01,) * masses, springs=springs, host=0, resonator=1)


@pytest.mark.parametrize("masses", [8, 40])
def test_bands_of_a_folded_chain(masses):
    """A folded chain of n masses a cell has band edges 2 (k/m)^(1/2) sin(j pi/(2 n)); its long waves are fastest."""
    top = 2 * np.sqrt(1e4 / 0.01)
    edges = top * np.sin(np.arange(masses + 1) * np.pi / masses / 2)
    found = pass_bands(folded(masses))
    assert [band.low for band in found] == pytest.approx(edges[:-1].tolist(), rel=1e-6, abs=1e-2)
    assert [band.high for band in found] == pytest.approx(edges[1:].tolist(), rel=1e-6, abs=1e-2)
    assert fastest_speed(folded(masses)) == pytest.approx(top / 2 / masses, rel=1e-3)


def test_the_fastest_speed_does_not_cost_a_grid_a_band(monkeypatch):
    """The fastest speed needs solutions at fewer wavenumbers than three grids, for 41 bands."""
    solved = []
    original = bands.bloch
    monkeypatch.setattr(bands, "bloch", lambda cell, kappa: solved.append(np.size(kappa)) or original(cell, kappa))
    fastest_speed(folded(41))
    assert sum(solved) < 3 * len(bands.GRID)


def graded(masses: int) -> UnitCell:
    """Return a cell whose masses grow along it, so that no two bands touch."""
    springs = tuple(Spring(i, (i + 1) % masses, 1e4, offset=int(i == masses - 1)) for i in range(masses))
    return UnitCell(masses=tuple(np.linspace(0.01, 0.02, masses)), springs=springs, host=0, resonator=1)


@pytest.mark.parametrize("kappa", [0.0, 1e-4, 0.7, np.pi])
def test_one_band_of_a_long_cell_is_that_of_all_bands(kappa):
    """Frequency and speed of one band of a long cell are those of the solution for all bands."""
    cell = graded(bands.MANY_MASSES + 3)
    every = bands.bloch(cell, kappa)
    for band in (1, 2, 17, cell.dofs):
        assert bands._frequency(cell, band, kappa) == pytest.approx(every.frequency[band - 1], rel=1e-9, abs=1e-2)
        speed = abs(every.group_velocity[band - 1])
        assert bands._speed(cell, band, kappa) == pytest.approx(speed, rel=1e-6, abs=1e-6)


def test_extremes_of_bands_that_are_flat_to_rounding_are_not_refined(monkeypatch):
    """Bands without width, of cells that springs of 1e-12 of the inner stiffness join, are not refined."""
    masses = bands.MANY_MASSES + 3
    within = tuple(Spring(i, i + 1, 1e4) for i in range(masses - 1))
    between = Spring(masses - 1, 0, 1e-8, offset=1)
    cell = UnitCell(masses=(0.01,) * masses, springs=(*within, between), host=0, resonator=1)

    refined = set()
    original = bands._frequency

    def record(cell: UnitCell, band: int, kappa: float, sign: int = 1) -> float:
        refined.add(band)
        return original(cell, band, kappa, sign)

    monkeypatch.setattr(bands, "_frequency", record)
    found = pass_bands(cell)
    assert len(found) == masses
    # The lowest band, near zero, is the square root of rounding errors and may be refined.
    assert refined <= {1}
