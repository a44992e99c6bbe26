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
VERBS = {2: ("run", "nnm", "design", "bands", "paper"), 3: ("run-ts", "run-resumed", "run-force", "sweep-team", "plot")}
KILLS = 2  # on each number of ranks: every one ends a worker and costs seconds


@pytest.mark.mpirun
def test_a_fault_at_any_phase_ends_all_and_loses_nothing(tmp_path):
    left, found, rows = phases(), {}, []
    for ranks, verbs in VERBS.items():
        crew = Crew(tmp_path / str(ranks), ranks)
        tasks = one_of_each(matrix(references(crew, verbs)), left, ranks)
        for task, stages in crew.do(tasks):
            wrong = judge(task, stages, allowed=crew.patience)
            rows.append(task | {"ranks": ranks, "wrong": wrong})
            if wrong:
                found[task["id"]] = *wrong, last_words(stages)
    print(fault_table(rows, KINDS, list(VERBS)))
    assert found == {}
    assert left == set(), "a phase that no verb here comes to"
    assert processes_of(tmp_path) == []


def one_of_each(tasks, left, turn):
    """Of the trials one for every phase that is ``left``, verbs and kinds in turn, few of them kills."""
    tasks, chosen, kills = list(tasks), [], KILLS
    for phase in sorted(left & {task["phase"] for task in tasks}):
        here = [task for task in tasks if task["phase"] == phase and (kills > 0 or task["kind"] != "sigkill")]
        turn += len(KINDS) + 1
        chosen.append(here[turn % len(here)])
        kills -= chosen[-1]["kind"] == "sigkill"
        left.remove(phase)
    return chosen


@pytest.mark.mpirun
@pytest.mark.parametrize(("kind", "code"), [("sigterm", 75), ("sigkill", 137)])
def test_a_fault_by_the_front_door(vipetsc, tmp_path, kind, code):
    """Real processes from their beginning to their end, as a user has them: exit codes, and the plain command again."""
    case, whole, out = prepare(SCENARIOS["run-ts"], tmp_path), tmp_path / "whole", tmp_path / "out"
    simulate(Case.load(case), whole)
    fault = vipetsc(2, "step", "60", "1", kind, "--", "run", case, "--out", out, module="tests.faults.inject", cwd=ROOT)
    assert fault.returncode == code, fault.stderr
    assert "Traceback" not in fault.stderr
    assert not (out / "run.h5").exists()
    again = vipetsc(2, "run", case, "--out", out)
    assert again.returncode == 0, again.stderr
    assert_same_bits(datasets(whole / "run.h5"), datasets(out / "run.h5"))
