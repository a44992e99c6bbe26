"""The bench on a lattice of a few cells: rows, ratios, tables; and the rule by which times are compared."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import clean_environment, set_words

SCRIPTS = Path(__file__).parents[2] / "scripts"
# Few cells and a short burst, with a clearance so small that there are contacts.
TINY = (
    "lattice.cells=24",
    "contacts.sites=[6, 12]",
    "contacts.clearance=4e-4",
    "drive.cycles=3",
    "time.end=0.018",
)  # fmt: skip


def bench(*arguments: object) -> subprocess.CompletedProcess:
    """Call ``scripts/bench.py`` in a process of its own."""
    command = [sys.executable, SCRIPTS / "bench.py", *arguments]
    return subprocess.run(
        list(map(str, command)), capture_output=True, text=True, timeout=600, check=False, env=clean_environment()
    )


def test_every_solver_gains_accuracy_with_its_tolerance(tmp_path, monkeypatch, capsys):
    """The errors of every solver that is installed fall with its tolerance; the results leave a picture and a table."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    import bench_peers
    from bench import main

    # To optimise the peers takes longer than what they solve here.
    flags = tuple("-O1" if flag == "-O3" else flag for flag in bench_peers.FLAGS)
    monkeypatch.setattr(bench_peers, "FLAGS", flags)
    measuring = ["--quick", "--only", "precision", "--out", str(tmp_path), *set_words(*TINY)]
    assert main(measuring) == 0, capsys.readouterr().err

    found = json.loads((tmp_path / "latest.json").read_text())
    errors: dict[str, list[float]] = {}
    for row in found["rows"]:
        assert row["seconds"] > 0, row
        errors.setdefault(row["solver"], []).append(row["error"])

    # A machine may lack some solvers: those that it can run must be among the results.
    wanted = {"vipetsc ts", "DOP853 numba", "DOP853 numpy"}
    has_compiler = bool(shutil.which("c++"))
    if has_compiler and bench_peers.petsc_flags():
        wanted |= {"TSRK 5dp", "TSRK 8vr"}
    if has_compiler and Path("/usr/include/boost/numeric/odeint.hpp").exists():
        wanted |= {"odeint dopri5", "odeint fehlberg78"}
    if has_compiler and Path("/usr/include/arkode/arkode_erkstep.h").exists():
        wanted.add("ARKODE dopri5")
    if (SCRIPTS.parent / ".venv-diffrax" / "bin" / "python").exists():
        wanted.add("diffrax Dopri8")
    assert wanted <= errors.keys()

    for solver, falling in errors.items():
        # Fehlberg's error estimate overlooks some kinks of the force, and the error falls unevenly with the tolerance.
        fraction = 0.3 if solver == "odeint fehlberg78" else 1e-3
        # The propagator's linear steps are exact: its largest error is already about the reference's own.
        assert falling[-1] < max(fraction * falling[0], 1e-11), (solver, falling)
    assert max(found["reference"]["separation"].values()) < 1e-9
    assert min(found["ratios"].values()) > 0

    # An empty picture takes fewer bytes.
    assert (tmp_path / "work-precision.png").stat().st_size > 5000
    assert main(["--table", "--out", str(tmp_path)]) == 0
    assert "| DOP853 numpy |" in capsys.readouterr().out


@pytest.mark.mpirun
def test_what_two_ranks_do_is_timed_beside_memory_messages_and_files(monkeypatch):
    """Intervals on two ranks have times, memory, messages and reductions; a build has its files and times."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    from bench_scaling import builds, on_ranks

    row = on_ranks(2, "intervals", engine="ts", cells=30, intervals=3)

    assert row["ranks"] == 2
    assert row["wall_ms"] > 0
    assert 0 < row["fraction_of_bandwidth_limit"] < 1
    assert 0.01 < row["peak_gib_a_rank"] < 4
    # A step sends one message for each of its 13 stages and one for its end, and has two reductions: PETSc's of the
    # error, and the package's of the earliest change of contact.
    steps = row["messages"] / 14
    assert steps in (1, 2, 3)
    assert row["reductions"] == 2 * steps
    # A message holds the ghosts of one cell: 4 displacements and 4 velocities of 8 bytes, or half of them.
    assert row["message_bytes"] / row["messages"] in (32, 64)
    # These times come from events of PETSc's log.
    assert row["TSStep_ms"] > row["ContactSearch_ms"] > 0

    alone, together = builds([(200, 3)])
    assert together["ranks"] == 2
    assert together["file_gb"] == pytest.approx(alone["file_gb"], rel=0.2)
    assert min(together["set_up_s"], together["write_s"], together["seconds"]["step"]) > 0


@pytest.mark.parametrize(
    "arguments", [("--table",), ("--set", "lattice.cels=3"), ("--set", "contacts.restitution=0.7")]
)
def test_what_cannot_be_measured_is_refused(tmp_path, monkeypatch, arguments):
    """A table without results, an unknown key and a case that the peers cannot solve end with 2 and write nothing."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    from bench import main

    assert main([*arguments, "--out", str(tmp_path / "none")]) == 2
    assert not (tmp_path / "none").exists()


def test_a_model_of_many_ranks_and_the_targets_read_the_same_rows(monkeypatch):
    """The model and the targets have the values that are computed by hand from four measured rows and a failed one."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    from bench_model import LATENCY, ScalingModel, model_tables
    from bench_targets import table, targets

    common = {"engine": "propagator", "messages": 1.0, "message_bytes": 0.0, "reductions": 1.0}
    rows = []
    for cells in (300, 10**5):
        for ranks in (1, 2):
            rows.append(common | {"cells": cells, "ranks": ranks, "wall_ms": 1e-5 * cells / ranks})
    short_alone, short_paired, long_alone, long_paired = rows
    short_paired.update(speedup=2.0, memory_speedup=2.0)
    long_paired.update(speedup=1.4, memory_speedup=2.0)
    long_alone.update(fraction_of_bandwidth_limit=0.4)
    rows.append({"engine": "ts", "cells": 300, "ranks": 0, "failure": "no memory"})

    model = ScalingModel(rows, "propagator")
    # 2000 cells a rank take 1e-8 s each; a message to each of two neighbours, and log2(1024) = 10 messages one after
    # the other for the reduction, take the latency each.
    assert model.total(1024 * 2000, 1024) == pytest.approx(2e-5 + 12 * LATENCY)
    assert model.total(10**6, 1) == pytest.approx(1e-2)
    assert model_tables(rows).count("| propagator |") == 3
    # The engine whose rows all failed has no model.
    assert "| ts |" not in model_tables(rows)

    # No target concerns the bandwidth of so few cells: this row must change nothing.
    short_alone.update(fraction_of_bandwidth_limit=0.1)
    found = {
        "scaling": rows,
        "ratios": {"odeint dopri5 / vipetsc propagator at 1e-08": 21.0},
        "members": {"diatomic": 1.0},
    }
    met = {target.name: target.met for target in targets(found)}
    # Measured and wanted: 21 and 20 times as fast as odeint; 0.4 and 0.3 of the bandwidth limit; 1.4/2 and 0.9 of the
    # speedup of memory on two ranks; 2 and 1 times as fast on two ranks; 1 s and at most 0.25 s a member.
    assert list(met.values()) == [True, True, False, True, False]
    assert table(found).count("| yes |") == 3


def test_programs_run_beside_an_earlier_version(tmp_path, monkeypatch):
    """A call of two versions gives positive times and their ratio; a call that fails, and no such commit, are named."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    import bench_programs

    # The test makes a repository of its own, because these sources may come from an archive without history.
    sources = tmp_path / "sources"
    shutil.copytree(SCRIPTS.parent / "vipetsc", sources / "vipetsc", ignore=shutil.ignore_patterns("__pycache__"))
    git = ["git", "-C", str(sources), "-c", "user.name=bench", "-c", "user.email=bench@example.org"]
    for words in (["init", "--quiet"], ["add", "vipetsc"], ["commit", "--quiet", "--message", "earlier"]):
        subprocess.run([*git, *words], check=True)
    (sources / "vipetsc" / "added_since.py").touch()
    monkeypatch.setattr(bench_programs, "ROOT", sources)

    calls = {"help": bench_programs.Program("--help"), "none": bench_programs.Program("validate {folder}/none.toml")}
    monkeypatch.setattr(bench_programs, "PROGRAMS", calls)
    helped, failed = bench_programs.programs(tmp_path, rounds=1, commit="HEAD", names=calls)

    assert min(helped["wall_now"], helped["cpu_now"], helped["cpu_before"]) > 0.02
    assert helped["wall_ratio"] == pytest.approx(helped["wall_now"] / helped["wall_before"])
    assert "none.toml" in failed["failure"]
    # The package of the commit was unpacked, not the present one.
    unpacked = tmp_path / "baseline" / "HEAD" / "vipetsc"
    assert (unpacked / "__init__.py").exists()
    assert not (unpacked / "added_since.py").exists()

    table = bench_programs.programs_table([helped, failed])
    assert "| help | 1 | " in table
    assert "| none | 1 | failed |" in table
    with pytest.raises(RuntimeError, match="not a valid object name"):
        bench_programs.programs(tmp_path, rounds=1, commit="nocommit", names=calls)


def test_the_goal_of_a_program_is_compared_with_its_ratio(monkeypatch):
    """A goal of wall time is compared with the ratio of wall times, one of CPU time with that of CPU times."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    from bench_targets import targets

    ratios = {"baseline": "b03848f", "wall_ratio": 0.4, "cpu_ratio": 0.6}
    rows = [ratios | {"program": name} for name in ("validate", "sweep of six", "help")]
    rows.append({"program": "plot", "failure": "no memory"})

    met = {target.name.split(",")[0]: target.met for target in targets({"programs": rows})}
    assert met == {"validate": True, "sweep of six": False}


def test_the_chapter_takes_the_tables_that_were_measured(monkeypatch):
    """A table with the titles of a measured one is replaced, all else remains; one without a place is returned."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    from bench_chapter import CHAPTER, with_tables

    chapter = (
        "# Speed\n\n| engine | cells | ms |\n|---|---|---|\n| ts | 3 | 1 |\n\nText.\n\n| engine | model |\n|---|---|\n"
    )
    measured = "| engine | cells | s |\n|---|---|---|\n| ts | 3 | 7 |\n\n| goal | met |\n|---|---|\n"
    written, left = with_tables(chapter, measured)
    assert written == chapter.replace("| ms |", "| s |").replace("| 1 |", "| 7 |")
    assert left == ["goal|met"]

    # In the table of goals, rows that were measured are replaced or added, and the others stay.
    goals = "| goal | measured |\n|---|---|\n| ts | 1 |\n| plot | 2 |\n"
    written, _ = with_tables(goals, "| goal | measured |\n|---|---|\n| plot | 3 |\n| run | 4 |\n")
    assert written == goals.replace("| 2 |", "| 3 |") + "| run | 4 |\n"

    # The real chapter stays as it is if every measured table equals the one that it has.
    text = CHAPTER.read_text(encoding="utf-8")
    assert with_tables(text, text) == (text, [])


def test_equal_error_is_interpolated_in_logarithms_and_never_beyond_the_points(monkeypatch):
    """The time at an error is a power law between measured points; beyond them there is none, or a bound on request."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    from bench_precision import at_equal_error

    # Pairs of error and time: a tenth of the error takes twice the time.
    power_law = [(10.0**-k, 2.0**k) for k in range(4, 9)]

    assert at_equal_error(power_law, 10**-5.5) == pytest.approx(2**5.5)
    assert at_equal_error(power_law, 1e-3) is None
    assert at_equal_error(power_law, 1e-9) is None

    # The time at the largest measured error bounds that at any larger error; nothing bounds that at a smaller error.
    assert at_equal_error(power_law, 1e-3, bound=True) == pytest.approx(2**4)
    assert at_equal_error(power_law, 1e-9, bound=True) is None
    assert at_equal_error([], 1e-5, bound=True) is None

    # A point that is slower and less accurate than another one does not change the result.
    assert at_equal_error([*power_law, (3e-6, 1e4)], 3e-6) == pytest.approx(at_equal_error(power_law, 3e-6))
