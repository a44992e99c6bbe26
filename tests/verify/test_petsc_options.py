"""PETSc options are part of a case: stored, compared when a run is resumed, and checked before anything is written."""

from __future__ import annotations

import json

from petsc4py import PETSc

import pytest

from tests.conftest import StopAt, simulated, small_case
from vipetsc.case import Case, CaseError
from vipetsc.cli.main import main
from vipetsc.dynamics import simulate
from vipetsc.dynamics.ts.time_stepper import TimeStepper
from vipetsc.io.folder import FolderError

SHORT = {"time": {"end": 0.01}}


def test_options_are_stored_and_go_with_the_case(folder):
    """A run with options has them after it is resumed, and the next run of the same process has none of them."""
    case = small_case(**SHORT, petsc={"ts_rk_type": "5dp", "ts_adapt_clip": "0.2,5"})
    assert Case.from_toml(case.to_toml()) == case

    assert simulate(case, folder / "run", stop=StopAt(20)).resumable
    assert simulate(case, folder / "run", resume=True).statistics["method"] == "5dp"
    summary = json.loads((folder / "run" / "summary.json").read_text())
    assert summary["case"]["petsc"]["ts_rk_type"] == "5dp"

    assert not {name for name in PETSc.Options().getAll() if name.startswith("ts_")}
    assert simulate(small_case(**SHORT), folder / "plain").statistics["method"] == "8vr"


def test_a_run_does_not_go_on_with_other_options(folder):
    case = small_case(**SHORT, petsc={"ts_rk_type": "5dp"})
    assert simulate(case, folder / "run", stop=StopAt(20)).resumable

    with pytest.raises(FolderError, match="ts_rk_type = 5dp there, nothing here"):
        simulate(small_case(**SHORT), folder / "run", resume=True)


def test_options_in_the_database_become_part_of_the_case(folder, petsc_options):
    """Options in PETSc's database are stored in the case, except those that only show something."""
    petsc_options(ts_rk_type="3bs", ts_monitor_draw="")

    simulate(small_case(**SHORT), folder / "run")

    assert Case.from_toml((folder / "run" / "case.toml").read_text()).petsc.model_dump() == {"ts_rk_type": "3bs"}


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("ts_rk_tpye", "5dp", "no such option"),
        ("mat_type", "aij", "no such option"),
        ("log_veiw", "", "no such option"),
        ("ts_rk_type", "foo", "PETSc refuses it"),
        ("ts_adapt_type", "foo", "PETSc refuses it"),
        ("ts_rtol", "much", "PETSc refuses it"),
        ("ts_type", "beuler", "stepped by"),
        ("ts_dt", "0", "must be positive"),
        ("ts_dt", "nan", "must be positive"),
    ],
)
def test_what_petsc_does_not_know_is_refused_before_anything_is_written(folder, capsys, name, value, reason):
    out = folder / "out"
    # The command line reads an option without a value as "true".
    value = value or "true"

    code = main(["run", "--out", str(out)], {"ts_adapt_clip": "0.1,5", name: value})

    assert code == 2
    message = capsys.readouterr().err
    assert f"petsc.{name} = '{value}': ".lower() in message.lower()
    assert reason in message
    assert message.count("petsc.") == 1
    assert not out.exists()

    assert main(["validate", "--set", f"petsc.{name}={value}"]) == 2
    with pytest.raises(CaseError):
        simulate(small_case(petsc={name: value}), out)


def test_a_case_with_options_is_stepped():
    """A case that asks for the propagator and for PETSc options is run by ``ts``, which obeys them, with a note."""
    case = small_case(time={"end": 0.01, "engine": "propagator"}, petsc={"ts_rk_type": "5dp"})

    _, result = simulated(case)

    assert result.statistics["engine"] == "ts"
    assert "PETSc options" in result.statistics["engine_note"]


def test_no_fixed_step_is_longer_than_the_one_asked_for(petsc_options, monkeypatch):
    """No fixed step is longer than asked for, also where one that is a little longer would reach the next sample."""
    lengths = []
    try_step = TimeStepper.try_step

    def note_length(self, time, h, after_onset):
        lengths.append(h)
        return try_step(self, time, h, after_onset)

    monkeypatch.setattr(TimeStepper, "try_step", note_length)
    case = small_case(**SHORT, contacts={"sites": []})
    interval = case.model().sample_interval
    for step, count in ((interval / 1.05, 2), (interval / 3, 3)):
        lengths.clear()
        petsc_options(ts_rk_type="3bs", ts_adapt_type="none", ts_dt=step)
        simulated(case)
        # As few steps to each sample as the length allows, all equal; those at the beginning are shorter.
        assert max(lengths) == pytest.approx(interval / count, rel=1e-6)
        assert min(lengths[len(lengths) // 2 :]) == pytest.approx(interval / count, rel=1e-6)
