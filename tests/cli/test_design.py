"""The verb design as a user types it: files, table, a search without a good cell."""

from __future__ import annotations

import numpy as np
import pytest
import xarray

from tests.conftest import datasets, set_words
from vipetsc.case.design import DesignCase
from vipetsc.lattice import bloch, four_band

CASE = """
[design]
lambda = { first = 0.1, last = 1.0, count = 4 }
eta = { count = 10 }
wavenumbers = 21
"""
FIGURES = {"deflections", "cost_maps", "dispersion_against_lambda", "dispersion_against_eta"}


pytestmark = pytest.mark.usefixtures("plain_pictures")


@pytest.fixture
def case(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(CASE)
    return path


def numbers(path):
    """Return the datasets of ``path`` that hold numbers, and not those that hold texts."""
    return {name: values for name, values in datasets(path).items() if values.dtype != object}


def test_search_leaves_its_file_its_pictures_and_a_table(in_process, case, tmp_path):
    """The search leaves its files; the recorded bands of the best cell are those of Bloch's theorem for that cell."""
    out = tmp_path / "out"
    done = in_process("design", case, "--out", out)
    assert done.returncode == 0, done.stderr

    rows = {tuple(line.split()[:2]): line.split()[2:] for line in done.stdout.splitlines()}
    # Both readings have the best cell at the same lambda and eta.
    assert rows["printed", "weighted"][:2] == rows["calibrated", "weighted"][:2] == ["0.1", "0.5"]
    names = {str(p.relative_to(out)) for p in out.rglob("*") if p.is_file()}
    assert names == {"case.toml", "design.h5", *(f"figures/{name}.png" for name in FIGURES)}

    with xarray.open_dataset(out / "design.h5", engine="h5netcdf") as file:
        assert list(file.reading.values) == ["printed", "calibrated"]
        assert file["weighted"].dims == ("reading", "lambda", "eta")
        # The value eta = 1 is left out: it would leave the host without mass.
        assert file.eta.values[-1] == 0.9
        assert "eta = 1" in file.attrs["left_out"]
        assert file.attrs["vipetsc_version"]

        best = file.sel(reading="calibrated", cost="weighted")
        place = {"lambda": best.optimum_lambda.item(), "eta": best.optimum_eta.item()}
        assert best.out_of_phase.sel(place).item() == 1
        assert best["weighted"].sel(place).item() == best.optimum_value.item() == best.paper_value.item()
        assert best.frequency.attrs["units"] == "rad/s"

        cell = four_band("calibrated", place["lambda"], place["eta"])
        expected = bloch(cell, file.wavenumber.values).frequency
        # The first band begins at zero frequency, where a relative tolerance alone may not be met.
        np.testing.assert_allclose(best.frequency.sel(place).values, expected, atol=1e-9)

        second = best.optimum_deflection.sel(band=2)
        np.testing.assert_allclose(second, best.signed_deflection.sel(place), atol=1e-12)
        np.testing.assert_allclose((best.optimum_amplitude**2).sum("dof"), 1)
    assert DesignCase.load(out / "case.toml").to_toml() == (out / "case.toml").read_text()


def test_a_grid_without_a_good_cell_says_so(in_process, case, tmp_path):
    """A search without a cell whose masses move out of phase ends with 0, says so and has no optimum."""
    # The resonators' springs are at least fifty times as stiff as the paper's. Each cell that is left is refined.
    stiff = set_words(
        "design.lambda.first=5.0", "design.lambda.last=6.0", "design.lambda.count=2", "design.eta.count=3"
    )

    done = in_process("design", case, "--out", tmp_path / "out", *stiff)
    assert done.returncode == 0, done.stderr
    # There are three costs in each of two readings.
    assert done.stdout.count("none is out of phase") == 6
    assert np.isnan(datasets(tmp_path / "out" / "design.h5")["optimum_lambda"]).all()
