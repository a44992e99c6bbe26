"""Every phase has one fault, with kinds in turn: all ranks end, and the same command completes the results.

``scripts/campaign faults`` causes every kind of fault at every phase of every verb.
"""

from __future__ import annotations

import tomllib
from typing import get_args

import pytest

from tests.conftest import assert_same_bits, datasets
from tests.faults.campaign import KILLED, fault_table
from tests.faults.inject import KINDS
from tests.faults.phases import phases
from tests.faults.scenarios import SCENARIOS, prepare
from tests.faults.trials import ROOT, Crew, judge, last_words, matrix, processes_of, references
from vipetsc.case import Case
from vipetsc.case.nnm import NnmTable
from vipetsc.cli.verbs.verb_list import VERBS, study_verbs
from vipetsc.dynamics import simulate

# Names of scenarios that have faults here; together they reach all phases.
SHORT = [scenario.name for scenario in SCENARIOS.values() if scenario.is_short]
# The reduced system passes through the same phases as a system of one's own.
ONE_CELL = {"reduced"}
# The number of kills: each ends a worker, and a new one takes seconds.
KILLS = 2


def test_every_verb_that_leaves_results_meets_faults_and_kills():
    """Every verb with results has a scenario with faults in this module, and one with kills in the campaign."""
    leaving = {verb.name for verb in VERBS.values() if verb.results}
    assert {verb.name for verb in study_verbs()} < leaving
    assert {SCENARIOS[name].verb.name for name in SHORT} == leaving
    assert {SCENARIOS[name].verb.name for name in KILLED} == leaving


def test_every_verb_that_reads_or_writes_files_meets_faults():
    """Every verb that takes a case, a folder or a file has a scenario."""
    flags = {"case", "path", "--out"}
    with_files = {verb.name for verb in VERBS.values() if flags & {argument.flag for argument in verb.arguments}}
    assert with_files > {verb.name for verb in study_verbs()}
    assert {scenario.verb.name for scenario in SCENARIOS.values()} == with_files


def test_every_system_of_normal_modes_meets_faults():
    """The scenarios of nnm have every system of its case, except ``ONE_CELL``."""
    systems = set()
    for scenario in SCENARIOS.values():
        if scenario.verb.name == "nnm":
            systems.add(tomllib.loads(scenario.case)["nnm"].get("system", "reduced"))

    assert systems == {*get_args(NnmTable.model_fields["system"].annotation)} - ONE_CELL


@pytest.mark.mpirun
def test_a_fault_at_any_phase_ends_all_and_loses_nothing(tmp_path):
    """A fault at each phase ends all ranks with the right code; the same command then leaves undisturbed results."""
    found = {}
    rows = []
    with Crew(tmp_path, 2) as crew:
        unbroken = references(crew, SHORT)
        tasks = list(matrix(unbroken))
        assert phases() - {task["phase"] for task in tasks} == set(), "phases that no scenario reaches"

        for task, stages in crew.do(one_of_each(tasks, unbroken)):
            wrong = judge(task, stages, allowed=crew.patience)
            rows.append(task | {"ranks": crew.ranks, "wrong": wrong, "came": stages["ended"]["fired"]})
            if wrong:
                found[task["id"]] = (*wrong, last_words(stages))

    # Pytest shows the table if the test fails.
    print(fault_table(rows, KINDS, [crew.ranks]))
    assert found == {}
    assert processes_of(tmp_path) == []


def one_of_each(tasks, unbroken):
    """Choose one of ``tasks`` for every phase, with kinds in turn, and at most ``KILLS`` kills.

    The verb is the one that takes the least time: on one rank tests/verify/test_study_contract.py tries all verbs.
    """
    chosen = []
    kills = 0
    for turn, phase in enumerate(sorted({task["phase"] for task in tasks})):
        here = [task for task in tasks if task["phase"] == phase]
        if kills == KILLS:
            here = [task for task in here if task["kind"] != "sigkill"]

        # The kind whose turn it is may be missing, as kills are after ``KILLS`` of them.
        kind = KINDS[turn % len(KINDS)]
        of_kind = [task for task in here if task["kind"] == kind]
        task = min(of_kind or here, key=lambda task: unbroken[task["scenario"]]["seconds"])
        chosen.append(task)
        if task["kind"] == "sigkill":
            kills += 1
    return chosen


@pytest.mark.mpirun
def test_a_request_by_the_front_door(vipetsc, in_process, tmp_path):
    """A signal to one rank of a user's command ends it with 75; the same command then leaves the same bits."""
    case = prepare(SCENARIOS["run-ts"], tmp_path)
    whole = tmp_path / "whole"
    out = tmp_path / "out"
    simulate(Case.load(case), whole)

    # The command has processes of its own from beginning to end, which the trials of a worker do not have. The fault
    # meets rank 1 at its 60th step.
    words = ("step", "60", "1", "sigterm", "--", "run", case, "--out", out)
    fault = vipetsc(2, *words, module="tests.faults.inject", cwd=ROOT)
    assert fault.returncode == 75, fault.stderr
    assert "Traceback" not in fault.stderr
    assert not (out / "run.h5").exists()

    resumed = in_process("run", case, "--out", out)
    assert resumed.returncode == 0, resumed.stderr
    assert_same_bits(datasets(whole / "run.h5"), datasets(out / "run.h5"))
