"""The bench on a lattice of a few cells: rows, ratios, tables; and the rule by which times are compared."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.conftest import set_words

SCRIPTS = Path(__file__).parents[2] / "scripts"
# Few cells and a short burst, with a clearance so small that there are contacts.
TINY = (
    "lattice.cells=24",
    "contacts.sites=[6, 12]",
    "contacts.clearance=4e-4",
    "drive.cycles=3",
    "time.end=0.018",
)  # fmt: skip


def test_every_solver_gains_accuracy_with_its_tolerance(tmp_path, monkeypatch, capsys):
    """The errors of every solver that is installed fall with its tolerance; the results leave a picture and a table."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    import bench_peers
    from bench import main

    # Compilers take most of the time. One peer in C++ stands for all: odeint's templates take longest.
    monkeypatch.setattr(bench_peers, "BOOST", tmp_path / "none")
    flags = tuple("-O1" if flag == "-O3" else flag for flag in bench_peers.FLAGS)
    monkeypatch.setattr(bench_peers, "FLAGS", flags)
    measuring = ["--quick", "--only", "precision", "--out", str(tmp_path), *set_words(*TINY)]
    assert main(measuring) == 0, capsys.readouterr().err

    found = json.loads((tmp_path / "latest.json").read_text())
    errors: dict[str, list[float]] = {}
    for row in found["rows"]:
        assert row["seconds"] > 0, row
        errors.setdefault(row["solver"], []).append(row["error"])

    # Which peers there are depends on the machine.
    assert {"vipetsc ts", "DOP853 numba", "DOP853 numpy"} <= errors.keys()

    for solver, falling in errors.items():
        # The propagator's linear steps are exact: its largest error is already about the reference's own.
        assert falling[-1] < max(1e-3 * falling[0], 1e-11), (solver, falling)
    assert max(found["reference"]["separation"].values()) < 1e-9
    assert min(found["ratios"].values()) > 0

    assert main(["--table", "--out", str(tmp_path)]) == 0
    assert "| DOP853 numpy |" in capsys.readouterr().out


@pytest.mark.mpirun
def test_what_two_ranks_do_is_timed_beside_memory(monkeypatch):
    """Intervals on two ranks have times and memory."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    from bench_scaling import on_ranks

    row = on_ranks(2, "intervals", engine="ts", cells=30, intervals=3)

    assert row["ranks"] == 2
    assert row["wall_ms"] > 0
    assert 0 < row["fraction_of_bandwidth_limit"] < 1
    assert 0.01 < row["peak_gib_a_rank"] < 4
    # These times come from events of PETSc's log.
    assert row["TSStep_ms"] > row["ContactSearch_ms"] > 0


@pytest.mark.parametrize(
    "arguments", [("--table",), ("--set", "lattice.cels=3"), ("--set", "contacts.restitution=0.7")]
)
def test_what_cannot_be_measured_is_refused(tmp_path, monkeypatch, arguments):
    """A table without results, an unknown key and a case that the peers cannot solve end with 2 and write nothing."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    from bench import main

    assert main([*arguments, "--out", str(tmp_path / "none")]) == 2
    assert not (tmp_path / "none").exists()


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
