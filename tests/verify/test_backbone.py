"""The transfer beside the slope of a branch: alignment, divisor and exponents against closed forms."""

import h5py
import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from vipetsc.case import Case
from vipetsc.io.folder import FolderError
from vipetsc.io.netcdf import tabulated
from vipetsc.io.records import RecordFile
from vipetsc.studies.backbone import BRANCH, FEWEST, LAYOUT, align, initiation_of, read_slope, relate_folders
from vipetsc.studies.linear_run import LinearRun, linear_name

GRAZING = 0.03
EXPONENT = -0.9


def branch(exponent=EXPONENT, factor=500.0, count=120):
    """A branch that is linear up to GRAZING, has a peak of its slope behind it and then a power law."""
    energy = GRAZING * np.concatenate([np.geomspace(0.01, 1.0, 10), np.geomspace(1.001, 1e7, count)])
    region = np.select([energy <= GRAZING, energy < 2 * GRAZING, energy < 1e4 * GRAZING], [1, 2, 3], 4)
    slope = np.where(region == 1, 0.0, factor * energy**exponent)
    values = {"branch/energy": energy, "branch/slope": slope, "branch/region": region}
    about = {"law": "hertz", "reading": "printed", "grazing": GRAZING}
    return xr.Dataset(tabulated(LAYOUT, {"point": np.arange(len(energy))} | values), attrs=about)


def lattice(slope, divisor, floor, initiation, count=60):
    """The transfer that follows the branch exactly, over the work of the drive in the lattice's own energies."""
    work = initiation * np.geomspace(1e-3, 1e6, count)
    law = 500.0 * (work * GRAZING / initiation) ** EXPONENT / divisor + floor
    return work, np.where(work < initiation, floor, law)


def test_energies_align_at_grazing(tmp_path):
    slope = branch()
    envelope = np.zeros(20)
    envelope[[16, 8]] = 2e-4, 1e-4
    case = Case.load(overrides=["lattice.cells=20", "contacts.sites=[17, 9]", "contacts.clearance=[1.8e-3, 2e-3]"])
    linear = LinearRun(envelope, np.zeros(20), {"work": 1.5e-3}, {})
    RecordFile(tmp_path / "members-0.jsonl").append(linear.record(linear_name(case)))
    initiation = initiation_of(tmp_path, case)

    assert initiation.amplitude == pytest.approx(20.0, rel=1e-14)
    assert initiation.onset == pytest.approx(9.0, rel=1e-14)
    assert initiation.energy == pytest.approx(1.5e-3 * 400, rel=1e-14)

    amplitude = np.array([1.0, initiation.amplitude, 300.0])
    found = align(1.5e-3 * amplitude**2, np.array([1e-4, 0.3, 0.1]), initiation.energy, 1e-4, slope)
    assert found["energy"].values[1] == pytest.approx(GRAZING, rel=1e-14)
    np.testing.assert_allclose(found["energy"].values / found["energy"].values[0], amplitude**2, rtol=1e-13)


@settings(deadline=None, max_examples=25)
@given(st.floats(1e2, 1e6), st.floats(1e-3, 1e3), st.floats(-2.0, -0.3), st.integers(0, 99))
def test_power_laws_are_found(divisor, initiation, exponent, seed):
    """A transfer that is slope/divisor gives back divisor and exponent, whatever the lattice's energies and order."""
    slope = branch(exponent)
    work = np.random.default_rng(seed).permutation(initiation * np.geomspace(1e-2, 1e6, 50))
    transfer = np.where(work < initiation, 1e-30, (work * GRAZING / initiation) ** exponent * 500.0 / divisor)
    found = align(work, transfer, initiation, 0.0, slope)
    known = slope["branch/energy"].values[slope["branch/region"].values == 3]
    energy = found["energy"].values

    assert np.array_equal(found["fitted"].values, (energy >= known.min()) & (energy <= known.max()))
    assert found.attrs["divisor"] == pytest.approx(divisor, rel=1e-6)
    assert found.attrs["exponent"] == pytest.approx(exponent, abs=1e-9)
    assert found.attrs["slope_exponent"] == pytest.approx(exponent, abs=1e-9)
    assert found.attrs["r2_adjusted"] == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("floor", [0.0, 1e-4, 1e-2])
def test_floor_is_part_of_the_divisors_fit(floor):
    slope = branch()
    divisor = 4e3
    work, transfer = lattice(slope, divisor, floor, initiation=0.6)
    assert align(work, transfer, 0.6, floor, slope).attrs["divisor"] == pytest.approx(divisor, rel=1e-6)


def test_divisor_is_the_least_squares_one():
    slope = branch()
    floor = 1e-3
    work, transfer = lattice(slope, 4e3, floor, initiation=0.6)
    transfer = transfer * np.exp(0.2 * np.sin(np.arange(len(transfer))))
    found = align(work, transfer, 0.6, floor, slope)
    fitted = found["fitted"].values == 1
    best = found.attrs["divisor"]
    energy = found["energy"].values[fitted]
    seen = np.log(found["ibtet"].values[fitted])

    def misfit(divisor):
        return np.sum((np.log(500.0 * energy**EXPONENT / divisor + floor) - seen) ** 2)

    assert misfit(best) < min(misfit(best * 1.01), misfit(best / 1.01))


def test_failed_members_and_points_before_the_peak_are_left_out():
    slope = branch()
    work, transfer = lattice(slope, 4e3, 1e-4, initiation=0.6)
    transfer[5] = np.nan
    late = int(np.argmin(np.abs(work * GRAZING / 0.6 - 20 * GRAZING)))
    transfer[late] = 2 * np.nanmax(transfer)
    found = align(work, transfer, 0.6, 1e-4, slope)
    energy = found["energy"].values
    fitted = found["fitted"].values == 1

    assert len(energy) == len(work) - 1
    assert energy[fitted].min() == pytest.approx(work[late] * GRAZING / 0.6)


def test_too_few_points_have_no_law_and_no_region_three_is_an_error():
    slope = branch()
    work = 0.6 * np.array([0.1, 3.0, 30.0])
    found = align(work, np.array([1e-4, 0.3, 0.1]), 0.6, 1e-4, slope)
    assert found["fitted"].values.sum() < FEWEST
    assert not found.attrs

    short = slope.isel(point=slope["branch/energy"].values < 1.5 * GRAZING)
    with pytest.raises(ValueError, match="region III"):
        align(work, np.array([1e-4, 0.3, 0.1]), 0.6, 1e-4, short)


def write_branch(folder, slope, kinds=None):
    """``branch-out-of-phase.h5`` with what the comparison reads of it."""
    folder.mkdir(exist_ok=True)
    with h5py.File(folder / BRANCH, "w") as file:
        for name in ("energy", "slope", "region"):
            file[name] = slope[f"branch/{name}"].values
        file["contacts"] = (slope["branch/region"].values > 1).astype(int)
        file["kind"] = np.zeros(slope.sizes["point"], np.int8) if kinds is None else kinds
        file.attrs["case"] = '[lattice]\nreading = "{reading}"\n[contacts]\nlaw = "{law}"\n'.format(**slope.attrs)
    return folder / BRANCH


def test_branch_is_read_at_its_regular_points(tmp_path):
    slope = branch()
    kinds = np.zeros(slope.sizes["point"], np.int8)
    kinds[9] = 6  # the located grazing point is not one of the continuation's own
    found = read_slope(write_branch(tmp_path / "b", slope, kinds))

    assert found.attrs.pop("grazing") == pytest.approx(GRAZING, rel=1e-12)
    assert found.sizes["point"] == slope.sizes["point"] - 1
    assert found.attrs == {"law": "hertz", "reading": "printed"}


def test_folders_without_the_branch_are_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(FolderError, match=BRANCH):
        relate_folders([tmp_path / "empty"])
