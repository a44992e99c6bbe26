"""Every phase meets a fault once, of kinds and in verbs in turn: all end, the same command goes on to the same bits.

``scripts/campaign faults`` does all of them.
"""

from __future__ import annotations

import pytest

from tests.conftest import assert_same_bits, datasets
from tests.faults.campaign import fault_table
from tests.faults.inject import KINDS
from tests.faults.phases import phases
from tests.faults.scenarios import SCENARIOS, prepare
from tests.faults.trials import ROOT, Crew, judge, last_words, matrix, processes_of, references
from vipetsc.case import Case
from vipetsc.dynamics import simulate

# The verbs on each number of ranks, all phases among them.
VERBS = {2: ("run-ts", "run-force", "nnm", "design", "paper", "law", "predict"), 3: ("run", "sweep-team", "optimise")}
KILLS = 2  # every one ends a worker and costs seconds


@pytest.mark.mpirun
def test_a_fault_at_any_phase_ends_all_and_loses_nothing(tmp_path):
    crews = {ranks: Crew(tmp_path / str(ranks), ranks) for ranks in VERBS}
    tasks = [
        task | {"ranks": ranks} for ranks, crew in crews.items() for task in matrix(references(crew, VERBS[ranks]))
    ]
    assert phases() - {task["phase"] for task in tasks} == set(), "phases that no verb here comes to"
    chosen, found, rows = one_of_each(tasks), {}, []
    for ranks, crew in crews.items():
        for task, stages in crew.do([task for task in chosen if task["ranks"] == ranks]):
            wrong, came = judge(task, stages, allowed=crew.patience), stages["ended"]["fired"]
            rows.append(task | {"wrong": wrong, "came": came})
            if wrong:
                found[task["id"]] = *wrong, last_words(stages)
    print(fault_table(rows, KINDS, list(VERBS)))
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
