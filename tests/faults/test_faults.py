"""Every phase meets a fault once, of kinds and in verbs in turn: all end, the same command goes on to the same bits.

``scripts/campaign faults`` does all of them.
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

# Names of scenarios by the number of ranks on which each meets faults here; all phases are among them.
ON_RANKS: dict[int, list[str]] = {}
for scenario in SCENARIOS.values():
    if scenario.ranks:
        ON_RANKS.setdefault(scenario.ranks, []).append(scenario.name)
ONE_CELL = {"reduced"}  # a system of one's own, as far as faults are concerned
KILLS = 2  # every one ends a worker and costs seconds


def test_every_verb_that_leaves_results_meets_faults_and_kills():
    leaving = {verb.name for verb in VERBS.values() if verb.results}
    assert {verb.name for verb in study_verbs()} < leaving
    assert {scenario.verb.name for scenario in SCENARIOS.values() if scenario.ranks} == leaving
    assert {SCENARIOS[name].verb.name for name in KILLED} == leaving


def test_every_verb_that_reads_or_writes_files_meets_faults():
    """A new verb cannot be left out: what takes a case, a folder or a file needs a scenario."""
    flags = {"case", "path", "--out"}
    with_files = {verb.name for verb in VERBS.values() if flags & {argument.flag for argument in verb.arguments}}
    assert with_files > {verb.name for verb in study_verbs()}
    assert {scenario.verb.name for scenario in SCENARIOS.values()} == with_files


def test_every_system_of_normal_modes_meets_faults():
    systems = {tomllib.loads(scenario.case)["nnm"].get("system", "reduced")
               for scenario in SCENARIOS.values() if scenario.verb.name == "nnm"}  # fmt: skip
    assert systems == {*get_args(NnmTable.model_fields["system"].annotation)} - ONE_CELL


@pytest.mark.mpirun
def test_a_fault_at_any_phase_ends_all_and_loses_nothing(tmp_path):
    crews = {ranks: Crew(tmp_path / str(ranks), ranks) for ranks in ON_RANKS}
    tasks = []
    for ranks, crew in crews.items():
        tasks += [task | {"ranks": ranks} for task in matrix(references(crew, ON_RANKS[ranks]))]
    assert phases() - {task["phase"] for task in tasks} == set(), "phases that no verb here comes to"

    chosen = one_of_each(tasks)
    found, rows = {}, []
    for ranks, crew in crews.items():
        for task, stages in crew.do([task for task in chosen if task["ranks"] == ranks]):
            wrong = judge(task, stages, allowed=crew.patience)
            rows.append(task | {"wrong": wrong, "came": stages["ended"]["fired"]})
            if wrong:
                found[task["id"]] = *wrong, last_words(stages)
    print(fault_table(rows, KINDS, list(ON_RANKS)))
    assert found == {}
    assert processes_of(tmp_path) == []


def one_of_each(tasks):
    """Of the trials one for every phase: ranks, verbs and kinds in turn, few of them kills."""
    chosen, kills = [], KILLS
    for turn, phase in enumerate(sorted({task["phase"] for task in tasks})):
        here = [task for task in tasks if task["phase"] == phase and (kills > 0 or task["kind"] != "sigkill")]
        numbers = sorted({task["ranks"] for task in here})
        here = [task for task in here if task["ranks"] == numbers[turn % len(numbers)]]
        kind = KINDS[turn % len(KINDS)]
        chosen.append(next((t for t in here[turn % len(here) :] if t["kind"] == kind), here[turn % len(here)]))
        kills -= chosen[-1]["kind"] == "sigkill"
    return chosen


@pytest.mark.mpirun
@pytest.mark.parametrize(("kind", "code"), [("sigterm", 75), ("sigkill", 137)])
def test_a_fault_by_the_front_door(vipetsc, in_process, tmp_path, kind, code):
    """Real processes from their beginning to their end, as a user has them: exit codes; and the plain command again."""
    case, whole, out = prepare(SCENARIOS["run-ts"], tmp_path), tmp_path / "whole", tmp_path / "out"
    simulate(Case.load(case), whole)
    fault = vipetsc(2, "step", "60", "1", kind, "--", "run", case, "--out", out, module="tests.faults.inject", cwd=ROOT)
    assert fault.returncode == code, fault.stderr
    assert "Traceback" not in fault.stderr
    assert not (out / "run.h5").exists()
    again = in_process("run", case, "--out", out)
    assert again.returncode == 0, again.stderr
    assert_same_bits(datasets(whole / "run.h5"), datasets(out / "run.h5"))
