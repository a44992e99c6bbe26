"""Campaigns of many faults, with a report: ``scripts/campaign faults | kills | calls | cases``."""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from tests.faults import failing_calls, trials
from tests.faults.inject import KINDS
from tests.faults.phases import phases
from tests.faults.scenarios import SCENARIOS
from tests.faults.trials import Crew, judge, last_words, matrix, references
from vipetsc.case import Case

# A row of the report: a task and its outcome.
Row = dict[str, Any]
# Scenarios of verbs with results: after a kill the same command resumes them.
KILLED = [scenario.name for scenario in SCENARIOS.values() if scenario.verb.results]
# Scenarios with a folder of results, in which calls of the file system can fail.
WRITING = [scenario.name for scenario in SCENARIOS.values() if "{out}" in scenario.words]


def faults(options: argparse.Namespace) -> dict[str, Any]:
    """Cause every kind of fault at every phase of every verb, on 2 and on 3 ranks."""
    rows: list[Row] = []
    reached: set[str] = set()
    with tempfile.TemporaryDirectory(prefix="faults-") as work:
        for ranks in options.ranks:
            with Crew(Path(work) / str(ranks), ranks, options.patience) as crew:
                unbroken = references(crew, options.only or list(SCENARIOS))
                tasks = list(matrix(unbroken, options.kinds))
                if options.phases:
                    tasks = [task for task in tasks if task["phase"] in options.phases]
                # A phase counts as reached even if --every leaves out its trials.
                reached |= {task["phase"] for task in tasks}
                for task, stages in crew.do(tasks[:: options.every]):
                    rows.append(judged(task | {"ranks": ranks}, stages, options))

    # A part of the scenarios need not reach all phases.
    missed = [] if options.only else sorted(phases() - reached)
    print(fault_table(rows, options.kinds, options.ranks))
    if missed:
        print(f"phases that no case comes to: {', '.join(missed)}")
    bad = sum(bool(row["wrong"]) for row in rows)
    print(f"{len(rows)} faults, {bad} of them not as they should be")
    return {"rows": rows, "missed": missed, "bad": bad + len(missed)}


def kills(options: argparse.Namespace) -> dict[str, Any]:
    """Send signals at random times to whole calls and to single ranks; repeat the command, and compare its results."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="kills-") as work, ExitStack() as leaving:
        crews = {}
        for ranks in options.ranks:
            crews[ranks] = leaving.enter_context(Crew(Path(work) / str(ranks), ranks, options.patience))

        # The first call may compile kernels: the time of the second one is the time of a call.
        for _ in range(2):
            unbroken = {ranks: references(crew, options.only) for ranks, crew in crews.items()}
        seconds = {(name, ranks): unbroken[ranks][name]["seconds"] for ranks in crews for name in options.only}
        tasks = list(trials.kills(seconds, options.seed, options.count))
        for ranks, crew in crews.items():
            crew_tasks = [task for task in tasks if task["ranks"] == ranks]
            rows += [judged(task, stages, options) for task, stages in crew.do(crew_tasks)]

    return {"seed": options.seed, "rows": rows, "bad": summary(rows, options, "kills")}


def calls(options: argparse.Namespace) -> dict[str, Any]:
    """Let single calls of the file system fail, or end their process; repeat the command, and compare its results."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="calls-") as work, ExitStack() as leaving:
        library = failing_calls.build(Path(work))
        crews = {}
        for ranks in options.ranks:
            crew = Crew(Path(work) / str(ranks), ranks, options.patience, preload=library)
            crews[ranks] = leaving.enter_context(crew)

        unbroken = {ranks: references(crew, options.only) for ranks, crew in crews.items()}
        tasks = list(trials.failing_calls(unbroken, options.seed, options.count, options.kinds))
        for ranks, crew in crews.items():
            crew_tasks = [task for task in tasks if task["ranks"] == ranks]
            rows += [judged(task, stages, options) for task, stages in crew.do(crew_tasks)]
    return {"seed": options.seed, "rows": rows, "bad": summary(rows, options, "failing calls")}


def summary(rows: Sequence[Row], options: argparse.Namespace, noun: str) -> int:
    """Print how many trials each scenario had, how many met their fault, and how many went wrong; return the last."""
    bad = sum(bool(row["wrong"]) for row in rows)
    for name in options.only:
        named = [row for row in rows if row["scenario"] == name]
        in_time = sum(bool(row["came"]) for row in named)
        lost = sum(bool(row["wrong"]) for row in named)
        print(f"{name:<13}{len(named):>5} {noun}, {in_time:>4} before the end, {lost} not as they should be")
    print(f"seed {options.seed}: {len(rows)} {noun}, {bad} of them not as they should be")
    return bad


def judged(task: Row, stages: dict[str, Row], options: argparse.Namespace) -> Row:
    """Return a row of the report. A campaign takes hours: the defects of a trial are printed at once."""
    wrong = judge(task, stages, options.allowed)
    ended = stages.get("ended", {})
    if wrong:
        print(f"{task['id']}: {'; '.join(wrong)}\n    {last_words(stages)}", flush=True)
    return task | {"came": ended.get("fired"), "code": ended.get("code"), "since": ended.get("since"), "wrong": wrong}


def cases(options: argparse.Namespace) -> dict[str, Any]:
    """Read randomly changed case files as every verb does: each must soon be valid or refused, without a traceback."""
    from tests.faults import mutations

    rows: list[Row] = []
    endings: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="cases-") as work:
        for mutation in itertools.islice(mutations.mutations(options.seed), options.count):
            verdict = mutations.judge(mutation, Path(work) / "case.toml", options.seconds)
            defect = verdict.defect

            # To simulate a case takes much longer than to read it: only every N-th valid one is simulated.
            runs = [case for case in verdict.cases if isinstance(case, Case)]
            if runs and endings["valid"] % options.every == 0:
                defect = mutations.run_shortly(runs[0], options.seconds)

            endings["valid" if verdict.cases else "refused"] += 1
            if defect:
                rows.append({"parent": mutation.parent, "changes": mutation.changes, "defect": defect})
                print(f"{mutation.parent}, {'; '.join(mutation.changes)}: {defect}", flush=True)

    counts = f"{endings['valid']} of them valid, {len(rows)} with a traceback or longer than {options.seconds} s"
    print(f"seed {options.seed}: {options.count} cases, {counts}")
    return {"seed": options.seed, "count": options.count, **endings, "rows": rows, "bad": len(rows)}


def fault_table(rows: Sequence[dict[str, Any]], kinds: Sequence[str], ranks: Sequence[int]) -> str:
    """Return the table of phases against kinds of faults and ranks: "." passed, "x" failed, "-" met no fault."""
    marks = {}
    for row in rows:
        mark = "." if row["came"] else "-"
        if row["wrong"]:
            mark = "x"
        marks[row["scenario"], row["phase"], row["kind"], row["ranks"]] = mark

    columns = [(kind, count) for kind in kinds for count in ranks]
    titles = [f"{kind} {count}" for kind, count in columns]
    lines = [f"{'verb':<13}{'phase':<12}" + "".join(f"{title:>13}" for title in titles)]
    for name, phase in dict.fromkeys((row["scenario"], row["phase"]) for row in rows):
        shown = [marks.get((name, phase, kind, count), "") for kind, count in columns]
        lines.append(f"{name:<13}{phase:<12}" + "".join(f"{mark:>13}" for mark in shown))
    return "\n".join(lines)


def main() -> int:
    """Run one campaign; returns 1 if any outcome is not as it should be, otherwise 0."""
    parser = argparse.ArgumentParser(prog="scripts/campaign", description=__doc__)
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--patience", type=float, default=40.0, metavar="S", help="time in which a call has to end")
    common.add_argument("--allowed", type=float, default=10.0, metavar="S", help="time from a fault to the end of all")
    common.add_argument("--report", type=Path, metavar="FILE", help="leave all results there as JSON")
    kinds = parser.add_subparsers(required=True, metavar="KIND")

    part = kinds.add_parser("faults", parents=[common], help=faults.__doc__, description=faults.__doc__)
    part.add_argument("--only", nargs="+", choices=SCENARIOS, help="scenarios; all if left out")
    part.add_argument("--phases", nargs="+", help="phases; all if left out")
    part.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    part.add_argument("--every", type=int, default=1, metavar="N", help="every N-th fault only")
    part.add_argument("--ranks", nargs="+", type=int, default=[2, 3])
    part.set_defaults(function=faults)

    part = kinds.add_parser("kills", parents=[common], help=kills.__doc__, description=kills.__doc__)
    part.add_argument("--seed", type=int, default=1)
    part.add_argument("--count", type=int, default=200)
    part.add_argument("--only", nargs="+", choices=SCENARIOS, default=KILLED)
    part.add_argument("--ranks", nargs="+", type=int, default=[1, 2, 3])
    part.set_defaults(function=kills)

    part = kinds.add_parser("calls", parents=[common], help=calls.__doc__, description=calls.__doc__)
    part.add_argument("--seed", type=int, default=1)
    part.add_argument("--count", type=int, default=300)
    part.add_argument("--only", nargs="+", choices=SCENARIOS, default=WRITING)
    part.add_argument("--kinds", nargs="+", choices=failing_calls.KINDS, default=failing_calls.KINDS)
    part.add_argument("--ranks", nargs="+", type=int, default=[1, 2])
    part.set_defaults(function=calls)

    part = kinds.add_parser("cases", parents=[common], help=cases.__doc__, description=cases.__doc__)
    part.add_argument("--seed", type=int, default=1)
    part.add_argument("--count", type=int, default=2000)
    part.add_argument("--seconds", type=int, default=20, metavar="S", help="time that a case may take")
    part.add_argument("--every", type=int, default=10, metavar="N", help="simulate every N-th valid case for a while")
    part.set_defaults(function=cases)

    options = parser.parse_args()
    begin = time.monotonic()
    report = options.function(options)
    print(f"{time.monotonic() - begin:.0f} s")
    if options.report:
        options.report.write_text(json.dumps(report, indent=1) + "\n")
    return 1 if report["bad"] else 0


if __name__ == "__main__":
    sys.exit(main())
