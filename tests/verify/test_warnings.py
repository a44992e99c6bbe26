"""Warnings of a run are in the result of ``simulate``, in the summary and in the file."""

from __future__ import annotations

import json

import h5py
import pytest

from tests.conftest import small_case
from vipetsc.cli.main import main
from vipetsc.dynamics import simulate
from vipetsc.dynamics.result import Result

HALF = {"time": {"end": 0.04}}


def warnings_of(result: Result) -> list[str]:
    """The warnings of a result; asserts that its files have the same."""
    summary = json.loads((result.folder / "summary.json").read_text())
    with h5py.File(result.folder / "run.h5") as file:
        assert json.loads(file.attrs["warnings"]) == summary["warnings"] == result.warnings
    return result.warnings


@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_sites_that_nothing_reaches(folder, engine):
    case = small_case(drive={"amplitude": 0.1}, time={"end": 0.04, "engine": engine})
    expected, found = warnings_of(simulate(case, folder / "run"))
    assert "no contact closes" in expected
    assert found == "no contact: nothing reached any of the 3 sites"


def test_indentations_beyond_the_radius(folder):
    """A run warns of indentations beyond the radius, where Hertz's law does not hold, but not with a bilinear law."""

    def warnings(name, **contacts):
        case = small_case(**HALF, drive={"amplitude": 400.0}, contacts={"modulus": 1e5} | contacts)
        # That a wave is large beside its clearance is told too.
        return [text for text in warnings_of(simulate(case, folder / name)) if "times the clearance" not in text]

    (warning,) = warnings("soft")
    assert "exceeds the contacts' radius of 0.005 m: Hertz" in warning
    assert warnings("larger", radius=1.0) == []
    assert warnings("bilinear", law="bilinear") == []


def test_an_energy_balance_that_does_not_close(folder, petsc_options, capsys):
    """Fixed steps too long for the energy balance to close give a warning, from Python and from the command line."""
    petsc_options(ts_rk_type="3bs", ts_adapt_type="none", ts_dt=1e-4)
    result = simulate(small_case(**HALF), folder / "run")
    assert result.complete

    (warning,) = (text for text in warnings_of(result) if text.startswith("the error of the energy balance is "))
    assert f"{result.statistics['ledger_error']:.2g} of the work, above 1e-08" in warning

    words = ["run", "--out", str(folder / "out")]
    for override in ("lattice.cells=24", "contacts.sites=[6]", "time.end=0.02", "output.figures=false"):
        words += ["--set", override]
    assert main(words) == 0
    assert "vipetsc: warning: the error of the energy balance is" in capsys.readouterr().err


def test_a_record_that_ends_early(folder, petsc_options):
    """A run that becomes unstable, by Euler's method with steps of a sample, keeps the samples before it diverges."""
    petsc_options(ts_rk_type="1fe", ts_adapt_type="none")
    result = simulate(small_case(contacts={"sites": []}), folder / "run")
    assert not result.complete
    warning = warnings_of(result)[-1]
    assert warning.startswith(f"the record ends at sample {result.statistics['samples']} of 251: the energy diverges")
