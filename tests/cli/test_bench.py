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
def test_what_two_ranks_do_is_timed_beside_memory_and_files(monkeypatch):
    """Intervals on two ranks have times and memory; a build has its files and times."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    from bench_scaling import builds, on_ranks

    row = on_ranks(2, "intervals", engine="ts", cells=30, intervals=3)

    assert row["ranks"] == 2
    assert row["wall_ms"] > 0
    assert 0 < row["fraction_of_bandwidth_limit"] < 1
    assert 0.01 < row["peak_gib_a_rank"] < 4
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
