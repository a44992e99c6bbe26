"""Transfers compared with the slope of a branch: alignment, divisor and exponents against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.conftest import record_of_linear
from vipetsc.case import Case
from vipetsc.io.netcdf import tabulated
from vipetsc.io.records import RecordFile
from vipetsc.studies.backbone import LAYOUT, align, initiation_of
from vipetsc.studies.linear_run import LinearRun, linear_name

GRAZING = 0.03
EXPONENT = -0.9
FACTOR = 500.0
INITIATION = 0.6


def branch(exponent: float = EXPONENT, count: int = 120) -> xr.Dataset:
    """A branch that is linear up to the energy GRAZING; its slope is FACTOR energy^``exponent`` beyond."""
    energy = GRAZING * np.concatenate([np.geomspace(0.01, 1.0, 10), np.geomspace(1.001, 1e7, count)])
    region = np.select([energy <= GRAZING, energy < 2 * GRAZING, energy < 1e4 * GRAZING], [1, 2, 3], 4)
    slope = np.where(region == 1, 0.0, FACTOR * energy**exponent)

    values = {"branch/energy": energy, "branch/slope": slope, "branch/region": region}
    attributes = {"law": "hertz", "reading": "printed", "grazing": GRAZING}
    return xr.Dataset(tabulated(LAYOUT, {"point": np.arange(len(energy))} | values), attrs=attributes)


def exact_transfer(divisor: float, floor: float, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """The work of the drive (J) and the transfer slope/``divisor`` + ``floor``, which follows the branch exactly.

    The work is an energy of the lattice: the branch grazes at GRAZING, the lattice touches at the work INITIATION.
    """
    work = INITIATION * np.geomspace(1e-3, 1e6, count)
    transfer = FACTOR * (work * GRAZING / INITIATION) ** EXPONENT / divisor + floor
    return work, np.where(work < INITIATION, floor, transfer)


def test_energies_align_at_grazing(tmp_path):
    """The work at which the site nearest to the drive first touches corresponds to the energy of the grazing branch."""
    envelope = np.zeros(20)
    envelope[16] = 2e-4
    envelope[8] = 1e-4
    case = Case.load(overrides=["lattice.cells=20", "contacts.sites=[17, 9]", "contacts.clearance=[1.8e-3, 2e-3]"])
    linear = LinearRun(envelope, np.zeros(20), {"work": 1.5e-3}, {})
    RecordFile(tmp_path / "members-0.jsonl").append(record_of_linear(linear, linear_name(case)))

    initiation = initiation_of(tmp_path, case)

    # A force of 1 N moves cell 17 by a ninth of its clearance and cell 9 by a twentieth: contact begins at 9 N. The
    # initiation is at 20 N, where the site that the wave meets first, cell 9, is touched.
    assert initiation.amplitude == pytest.approx(20.0, rel=1e-14)
    assert initiation.onset == pytest.approx(9.0, rel=1e-14)
    assert initiation.energy == pytest.approx(1.5e-3 * 20**2, rel=1e-14)

    amplitude = np.array([1.0, initiation.amplitude, 300.0])
    aligned = align(1.5e-3 * amplitude**2, np.array([1e-4, 0.3, 0.1]), initiation.energy, 1e-4, branch())
    energy = aligned["energy"].values
    assert energy[1] == pytest.approx(GRAZING, rel=1e-14)
    np.testing.assert_allclose(energy / energy[0], amplitude**2, rtol=1e-13)


@settings(deadline=None, max_examples=25)
@given(st.floats(1e2, 1e6), st.floats(1e-3, 1e3), st.floats(-2.0, -0.3), st.integers(0, 99))
def test_power_laws_are_found(divisor, initiation, exponent, seed):
    """The fit to a transfer slope/divisor finds divisor and exponent, for any initiation energy and order of points."""
    slope = branch(exponent)
    work = np.random.default_rng(seed).permutation(initiation * np.geomspace(1e-2, 1e6, 50))
    law = (work * GRAZING / initiation) ** exponent * FACTOR / divisor
    transfer = np.where(work < initiation, 1e-30, law)

    found = align(work, transfer, initiation, 0.0, slope)

    region_three = slope["branch/energy"].values[slope["branch/region"].values == 3]
    energy = found["energy"].values
    assert np.array_equal(found["fitted"].values, (energy >= region_three.min()) & (energy <= region_three.max()))
    assert found.attrs["divisor"] == pytest.approx(divisor, rel=1e-6)
    assert found.attrs["exponent"] == pytest.approx(exponent, abs=1e-9)
    assert found.attrs["slope_exponent"] == pytest.approx(exponent, abs=1e-9)
    assert found.attrs["r2_adjusted"] == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("floor", [0.5, 5.0, 1e3])
def test_a_floor_above_the_transfers_has_no_divisor(floor):
    """Where most transfers lie below the floor, the divisor would grow without a limit: there is a reason instead."""
    work, transfer = exact_transfer(1e3, 1e-3)
    with pytest.raises(ValueError, match="no divisor"):
        align(work, transfer, INITIATION, floor, branch())
    # The misfit of a divisor that exists says how well it fits.
    assert align(work, transfer, INITIATION, 1e-3, branch()).attrs["misfit"] < 1e-6
    assert align(work, transfer, INITIATION, 2e-3, branch()).attrs["misfit"] > 1e-3


def test_divisor_is_the_least_squares_one():
    """The fitted divisor has the least sum of squares of logarithms: 1 % more or less gives a larger one."""
    slope = branch()
    floor = 1e-3
    work, transfer = exact_transfer(4e3, floor)
    # The points are moved off the law, so that no divisor fits all of them.
    transfer = transfer * np.exp(0.2 * np.sin(np.arange(len(transfer))))

    found = align(work, transfer, INITIATION, floor, slope)
    fitted = found["fitted"].values == 1
    energy = found["energy"].values[fitted]
    measured = np.log(found["ibtet"].values[fitted])

    def misfit(divisor):
        return np.sum((np.log(FACTOR * energy**EXPONENT / divisor + floor) - measured) ** 2)

    best = found.attrs["divisor"]
    assert misfit(best) < min(misfit(best * 1.01), misfit(best / 1.01))
