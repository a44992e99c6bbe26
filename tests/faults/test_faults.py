"""Every phase of every verb meets a fault once, of kinds and on ranks in turn: all end, and the command goes on."""

from __future__ import annotations

import pytest

from tests.faults.campaign import fault_table
from tests.faults.inject import KINDS
from tests.faults.phases import phases
from tests.faults.scenarios import SCENARIOS
from tests.faults.trials import Crew, judge, last_words, matrix, processes_of, references

KILLS = 4  # of a turn, those that end a worker: each costs seconds


@pytest.mark.mpirun
@pytest.mark.parametrize("ranks", [2, 3])
def test_a_fault_at_any_phase_ends_all_and_loses_nothing(tmp_path, ranks):
    crew = Crew(tmp_path, ranks)
    counts = references(crew, list(SCENARIOS))
    # A new phase has to come in a scenario.
    assert phases() <= {phase for by_rank in counts.values() for count in by_rank for phase in count}
    tasks = one_of_each(list(matrix(counts)), ranks)
    crew.do(tasks)
    wrong = {task["id"]: judge(task, crew.results[task["id"]], allowed=crew.patience) for task in tasks}
    rows = [task | {"ranks": ranks, "wrong": wrong[task["id"]]} for task in tasks]
    print(fault_table(rows, KINDS, [ranks]))
    found = {key: [*text, last_words(crew.results[key])] for key, text in wrong.items() if text}
    assert not found
    assert not processes_of(tmp_path)


def one_of_each(tasks, turn):
    """Of the trials one for every scenario and phase, the kinds in turn; few of them kills."""
    chosen, kills = [], KILLS
    for place in dict.fromkeys((task["scenario"], task["phase"]) for task in tasks):
        here = [task for task in tasks if (task["scenario"], task["phase"]) == place]
        for _ in here:
            task, turn = here[turn % len(here)], turn + 1
            if task["kind"] != "sigkill" or kills > 0:
                break
        kills -= task["kind"] == "sigkill"
        chosen.append(task)
    return chosen
