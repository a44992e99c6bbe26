"""The verb identify as a user types it: files, pictures, the case that was found, refusals."""

from __future__ import annotations

import numpy as np
import pytest
import tomli_w

from tests.identified import identify_table, lattice_table, measured_table
from vipetsc.case import Case
from vipetsc.case.identify import IdentifyCase

FIGURES = {"record_and_model", "residual_correlations", "misfit_profiles", "parameter_correlation", "growing_windows"}

pytestmark = pytest.mark.usefixtures("plain_pictures")


@pytest.fixture
def case(tmp_path):
    """The path of a case that identifies the clearance of site 1 and that of sites 2 and 3 from one record."""
    table = lattice_table(time={"end": 0.009})
    unknowns = [
        {"quantity": "clearance", "of": [[1]], "bounds": [2e-4, 8e-4], "start": 6e-4},
        {"quantity": "clearance", "of": [[2, 3]], "bounds": [2e-4, 8e-4]},
    ]
    record = measured_table(tmp_path, table, noise=0.01)
    path = tmp_path / "lab.toml"
    path.write_text(tomli_w.dumps(identify_table(table, record, unknowns=unknowns, profile=3) | {"name": "lab"}))
    return path


def test_a_record_becomes_a_case(in_process, case, tmp_path):
    """An identification leaves its files and a table, and the identified case has the true clearance within 2 %."""
    checked = in_process("validate", case)
    assert checked.returncode == 0, checked.stderr
    assert "clearance 1, clearance 2+3; starts: 1" in checked.stdout
    assert not (tmp_path / "out").exists()

    out = tmp_path / "out"
    done = in_process("identify", case, "--out", out)
    assert done.returncode == 0, done.stderr
    names = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file() and path.name[0] != "."}
    files = {"case.toml", "identified.h5", "identified.toml", "identified-runs.jsonl"}
    assert names == files | {f"figures/{name}.png" for name in FIGURES}
    assert "90 % interval" in done.stdout

    found = Case.load(out / "identified.toml")
    assert found.name == "lab-identified"
    assert found.model().chain.sites[0].clearance == pytest.approx(5e-4, rel=0.02)
    again = in_process("identify", case, "--out", out)
    assert again.returncode == 0
    assert "clearance 1" in again.stdout
    assert in_process("plot", out, "--fig", "misfit_profiles").returncode == 0


def test_bad_data_write_nothing(in_process, case, tmp_path):
    """A record with a missing value is refused with the key of its column, exit code 2 and no folder."""
    data = next(tmp_path.glob("*.csv"))
    lines = data.read_text().splitlines()
    lines[5] = lines[5].rpartition(",")[0] + ",nan"
    data.write_text("\n".join(lines))
    ended = in_process("identify", case, "--out", tmp_path / "out")
    assert ended.returncode == 2
    assert "identify.records[1].sensors[3].column = nan: sample 5 of" in ended.stderr
    assert not (tmp_path / "out").exists()


def test_a_case_without_a_fit_is_one_sentence(in_process, tmp_path):
    """Where no start is a possible case, the command says so and leaves its records: exit code 1."""
    spring = {"start": 1, "end": 1, "stiffness": 1e4, "next_cell": True}
    wall = {"waveform": "harmonic", "end": "left", "amplitude": 1e-4, "frequency": 50.0}
    table = {"lattice": {"cells": 4, "cell": {"masses": [0.1], "springs": [spring], "contact": [1, 1]}}, "drive": wall}
    table["contacts"] = {"sites": []}
    times = 1e-3 * np.arange(40)
    np.savetxt(tmp_path / "r.csv", np.column_stack([times, np.sin(50 * times)]), delimiter=",")
    sensor = {"quantity": "velocity", "column": 2, "cell": 2}
    # A spring to a moved wall must be linear.
    unknowns = [{"quantity": "quadratic", "bounds": [1e4, 1e6]}]
    record = {"file": str(tmp_path / "r.csv"), "time": 1, "sensors": [sensor]}
    path = tmp_path / "none.toml"
    path.write_text(tomli_w.dumps(identify_table(table, record, unknowns=unknowns)))

    ended = in_process("identify", path, "--out", tmp_path / "out")
    assert ended.returncode == 1
    assert "vipetsc: no start leads to a fit" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert not (tmp_path / "out" / "identified.h5").exists()


def test_another_record_is_not_gone_on_with(in_process, case, tmp_path):
    """Results of a record with other values are refused: the hash of the data is part of the case."""
    stopped = tmp_path / "out"
    stopped.mkdir()
    (stopped / "case.toml").write_text(IdentifyCase.load(case).to_toml())
    (stopped / "identified-runs.jsonl").write_text("")
    data = next(tmp_path.glob("*.csv"))
    rows = np.loadtxt(data, delimiter=",", skiprows=1)
    rows[3, 1] += 1e-3
    np.savetxt(data, rows, delimiter=",", header="t,a,b,c", comments="")
    ended = in_process("identify", case, "--out", stopped)
    assert ended.returncode == 2
    assert "contains another identification: identify" in ended.stderr
