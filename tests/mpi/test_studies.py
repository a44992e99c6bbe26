"""Every study has the same bits on any number of ranks, after a stop of one of them, and after a failure on one."""

from __future__ import annotations

import tomllib
from errno import ENOSPC

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import StopAt, assert_same_bits, datasets
from tests.faults.inject import Injector
from tests.faults.scenarios import difference
from tests.identified import identify_table, lattice_table, measured_table
from tests.studies import STUDIES, compute
from vipetsc.case import CaseError, Sweep
from vipetsc.case.identify import IdentifyCase
from vipetsc.case.nnm import NnmCase
from vipetsc.io.records import RecordFile
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.parallel import StoppedError, StopRequest, on_root
from vipetsc.register import PartError
from vipetsc.studies import linear_run
from vipetsc.studies.ensemble import FAILED
from vipetsc.studies.identification import run_identification
from vipetsc.studies.recorded_runs import RecordedRuns
from vipetsc.studies.sweep import run_sweep

COMM = MPI.COMM_WORLD


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Return a function that gives, on all ranks, the folder of a study that rank 0 computes alone, once."""
    done = {}

    def call(name):
        if name not in done:
            done[name] = on_root(COMM, lambda: tmp_path_factory.mktemp(name) / "alone")
            on_root(COMM, lambda: compute(name, done[name]))
        return done[name]

    return call


def assert_as_alone(found, wanted):
    """Assert on all ranks that a folder has the files of another one, to the bit."""
    assert on_root(COMM, lambda: difference(wanted, found)) == ""


def assert_stops_and_goes_on(name, out, wanted):
    """Assert that a request of the last rank, at its first look, stops all, and that the next call completes."""
    stop = StopAt(0) if COMM.rank == COMM.size - 1 else StopRequest()
    with pytest.raises(StoppedError):
        compute(name, out, COMM, stop=stop)
    on_root(COMM, lambda: None)

    compute(name, out, COMM)
    assert_as_alone(out, wanted)


@pytest.mark.parallel([2])
@pytest.mark.parametrize("name", STUDIES)
def test_ranks_leave_what_one_leaves_and_one_that_is_asked_to_stop_stops_all(folder, alone, name):
    """Each study is computed in one go, or, if it looks at requests, in two."""
    if name == "design":
        compute(name, folder / "together", COMM)
        assert_as_alone(folder / "together", alone(name))
    else:
        assert_stops_and_goes_on(name, folder / "together", alone(name))


# A team of two leaves one rank of three; jobs do not divide by three.
@pytest.mark.parallel([3])
@pytest.mark.parametrize("name", ["sweep-team", "identify", "law"])
def test_three_ranks_leave_what_one_leaves(folder, alone, name):
    compute(name, folder / "together", COMM)
    assert_as_alone(folder / "together", alone(name))


@pytest.mark.parallel([2])
def test_ranks_divide_a_single_start_to_the_same_bits(folder):
    """Ranks that divide the derivatives by parameters and initial state of one start get the result of one rank."""

    def computed_alone() -> str:
        """Compute the fit on this rank, into a folder of its own; return its case, whose record rank 0 alone writes."""
        # Of two cells, since each coordinate of the initial state costs some fifty runs.
        table = lattice_table(
            lattice={"preset": "diatomic", "cells": 2},
            contacts={"sites": [1], "clearance": 1e-4},
            time={"end": 0.007},
            output={"points": [{"name": "a", "cell": 1, "mass": 2}, {"name": "b", "cell": 2, "mass": 1}]},
        )
        record = measured_table(folder, table, noise=0.01) | {"begin": 0.004, "initial": "estimate"}
        unknowns = [{"quantity": "clearance", "bounds": [5e-5, 4e-4], "start": 1.2e-4}]
        plan = IdentifyCase.from_table(identify_table(table, record, unknowns=unknowns, steps=1))
        run_identification(plan, folder / "alone", MPI.COMM_SELF)
        return plan.to_toml()

    plan = IdentifyCase.from_toml(on_root(COMM, computed_alone))
    run_identification(plan, folder / "together", COMM)
    assert_same_bits(datasets(folder / "together/identified.h5"), datasets(folder / "alone/identified.h5"))
    COMM.Barrier()


def three_cells(**nnm) -> NnmCase:
    """Branches from the two lowest modes of twelve degrees of freedom, into contact; ``nnm`` updates its section."""
    table = {
        "name": "cells",
        "lattice": {"preset": "four-band", "reading": "printed", "cells": 3},
        "contacts": {"law": "hertz", "sites": [1, 2, 3], "clearance": {"first": 10**-2.65, "last": 10**-2.75}},
        "nnm": {"system": "chain", "modes": [1, 2], "points": 60, "locate_grazing": False} | nnm,
    }
    return NnmCase.from_table(table)


@pytest.mark.parallel([2])
def test_a_branch_that_fails_keeps_its_points_and_the_others_go_on(folder):
    """A tight bound on the half-trace ends both branches at their first contact, with their points on disk."""
    case = three_cells(smallest_step=1e-3, guards={"half_trace": 1e-3})
    branches = follow_all(case, folder, COMM)
    COMM.Barrier()
    if COMM.rank:
        # Rank 0 collects the branches of all ranks.
        assert branches == []
        return

    assert [branch.name for branch in branches] == ["mode-1", "mode-2"]
    for branch in branches:
        assert branch.ended.sentence.startswith("failed: step below")
        assert "nnm.guards.half_trace" in branch.ended.sentence
        # The table has a row of names, and then one row for each point.
        rows = (folder / f"branch-{branch.name}.csv").read_text().splitlines()
        assert len(rows) == len(branch.points) + 1 > 2


@pytest.mark.parallel([2])
def test_an_error_of_one_rank_is_raised_on_all_when_the_others_have_finished(folder):
    """An error that is no failure of the method, here of a listener, is raised on all ranks after all branches."""

    def listener(branch, point):
        if branch.name == "mode-2":
            raise RuntimeError("of rank 1 alone")

    # Rank 1 follows mode-2.
    with pytest.raises(RuntimeError, match="of rank 1 alone"):
        follow_all(three_cells(points=3), folder, COMM, listener=listener)

    COMM.Barrier()
    if COMM.rank == 0:
        assert len(read_branch(folder / "branch-mode-1.h5").points) == 4


TABLE = """
name = "small"
[lattice]
preset = "four-band"
cells = 16
[contacts]
clearance = 2e-4
[drive]
cycles = 3
[time]
end = 0.04
rtol = 1e-8
sample_interval = 1e-4
[output]
stride = 2
[sweep.contacts]
sites = [[4], [4, 9]]
[sweep.drive]
amplitude = [0.1, 20.0, 40.0]
"""


@pytest.fixture(scope="module")
def injector():
    """The injector of faults at chosen phases; a process may have only one, because its hook cannot be removed."""
    return Injector()


def sweep(*changes: str) -> Sweep:
    """The sweep of ``TABLE``; ``changes`` are overrides of its case."""
    return Sweep.from_table(tomllib.loads(TABLE), list(changes))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The datasets of the ensemble that rank 0 computes alone; all ranks get them."""

    def swept() -> dict[str, np.ndarray]:
        folder = tmp_path_factory.mktemp("whole")
        run_sweep(sweep(), folder, MPI.COMM_SELF)
        return datasets(folder / "ensemble.h5")

    return on_root(COMM, swept)


@pytest.mark.parallel([2])
@pytest.mark.parametrize(
    ("team", "phase", "kind"),
    [(2, "analyse", "exception"), (2, "append", "full-disk"), (1, "append", "full-disk"), (1, "step", "memory")],
)
def test_a_member_that_fails_is_an_outcome_and_a_full_disk_an_end(folder, injector, whole, team, phase, kind):
    """An error within a member is recorded and the sweep goes on; a full disk ends the sweep."""
    plan = sweep(f"sweep.ranks={team}")
    # Rank 0 of a team measures and writes for the team. Without teams the fault meets rank 1.
    failing = 0 if team == 2 else 1
    if COMM.rank == failing:
        # The fault comes at the third record of rank 0, whose first one is that of the linear run, and at the first
        # record of rank 1, which gets few members where rank 0 is faster.
        time_of_fault = {"append": 1 if COMM.rank else 3, "step": 1, "analyse": 2}
        injector.arm(phase, time_of_fault[phase], kind)

    if kind == "full-disk":
        with pytest.raises(OSError, match="No space left"):
            run_sweep(plan, folder / "out", COMM)
    else:
        result = run_sweep(plan, folder / "out", COMM)
        (reason,) = {row["reason"] for row in result.failures}
        expected = {"exception": "a fault at analyse", "memory": "MemoryError: Unable to allocate"}
        assert expected[kind] in reason
        assert not result.complete
        assert not result.resumable
        # Without teams a rank fails in its linear run, and may take all members before the other rank takes one.
        assert 1 <= result.count(FAILED) < 6 + (team == 1)

    injector.disarm()
    COMM.Barrier()
    assert run_sweep(plan, folder / "out", COMM).complete
    assert_same_bits(datasets(folder / "out" / "ensemble.h5"), whole)
    COMM.Barrier()


@pytest.mark.parallel([2])
def test_a_linear_run_that_fails_on_one_rank_of_a_team_fails_on_all(folder, monkeypatch):
    """Where memory is short on the first rank alone, all members have the reason, and no rank waits for another."""

    def fail(*arguments):
        raise MemoryError("Unable to allocate 1.00 TiB")

    if COMM.rank == 0:
        monkeypatch.setattr(linear_run, "envelope_squares", fail)
    result = run_sweep(sweep("sweep.ranks=2"), folder / "out", COMM)
    assert result.count(FAILED) == 6
    assert {row["reason"] for row in result.failures} == {"MemoryError: Unable to allocate 1.00 TiB"}
    COMM.Barrier()


@pytest.mark.parallel([2])
@pytest.mark.parametrize("study", ["sweep", "runs"])
def test_records_that_one_rank_cannot_close_end_all_ranks(folder, monkeypatch, study):
    """A network file system may say only on closing that the disk is full; then every rank raises."""

    def fail(self):
        raise OSError(ENOSPC, "No space left on device")

    if COMM.rank == 1:
        monkeypatch.setattr(RecordFile, "close", fail)
    with pytest.raises(OSError, match="No space left"):
        if study == "sweep":
            run_sweep(sweep(), folder / "out", COMM)
        else:
            RecordedRuns("some-runs", folder, COMM, StopRequest()).make([1.0, 2.0], lambda key: {"value": key})


@pytest.mark.parallel([2])
def test_a_sweep_without_a_folder_is_on_rank_0(folder):
    """Samples do not depend on the order of their seeds; fields without a folder are refused on every rank."""
    table = tomllib.loads(TABLE) | {"contacts": {"sites": [4, 9], "clearance": 2e-4}}
    table |= {"disorder": {"clearance": {"relative": 0.05}}, "sweep": {"disorder": {"seed": {"count": 3}}}}
    table["drive"] = table["drive"] | {"amplitude": 20.0}

    together = run_sweep(Sweep.from_table(table), folder / "all", COMM)
    turned = run_sweep(Sweep.from_table(table, ["sweep.disorder.seed=[2, 0, 1]"]))
    assert together.complete
    assert turned.folder is None
    assert (turned.dataset is None) == (COMM.rank > 0)
    if COMM.rank == 0:
        values = together.dataset["ibtet"].values
        assert len({*values.tolist()}) == 3
        assert turned.dataset["ibtet"].values.tolist() == values[[2, 0, 1]].tolist()
        # Only clearances are scattered, and the lattice is the same: one linear run serves all samples.
        assert (folder / "all" / "members.jsonl").read_bytes().count(b'"envelope"') == 1
    COMM.Barrier()
    with pytest.raises(CaseError, match="give a folder"):
        run_sweep(sweep("sweep.fields=true"))


MEASURE = """
from vipetsc import register


@register.measure("mine-{number}", unit="1", text="a number")
def mine(record):
    return {returned}
"""


def with_measure(folder, number, returned, ranks):
    """Return a sweep of four runs with a user's measure, of which the second one alone has contacts."""
    if COMM.rank == 0:
        (folder / "part.py").write_text(MEASURE.format(number=number, returned=returned))
    COMM.Barrier()
    sections = {
        "lattice": {"preset": "four-band", "cells": 12},
        "contacts": {"sites": [4]},
        "drive": {"cycles": 2},
        "time": {"end": 0.01, "engine": "propagator"},
        "plugins": {"modules": [str(folder / "part.py")]},
        "sweep": {"measures": ["motion"], "ranks": ranks, "drive": {"amplitude": [1.0, 1e3, 2.0, 3.0]}},
    }
    return Sweep.from_table(sections)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize(
    ("number", "returned", "telling"),
    [(0, "record.run['no such variable']", "KeyError"), (1, "undefined", "NameError"), (2, "[1.0, 2.0]", "returns")],
)
def test_a_measure_with_a_mistake_ends_a_sweep_at_once(folder, number, returned, telling):
    """A mistake in a function would fail every member: the first ends the sweep and names the part and its file."""
    plan = with_measure(folder, number, returned, ranks=COMM.size if number else 1)
    with pytest.raises(PartError, match=f"'mine-{number}' of .*part.py .*{telling}"):
        run_sweep(plan, folder / "out", COMM)

    COMM.Barrier()
    records = [path.read_text() for path in (folder / "out").glob("members*.jsonl")]
    assert not any('"failed"' in text for text in records)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("ranks", [1, 2])
def test_a_measure_that_fails_for_some_runs_fails_these_members(folder, ranks, capfd):
    """A function that fails for the numbers of one run fails this member alone, also in a team of ranks.

    Rank 0 names it before any rank calls it, since another one may never come back from it.
    """
    number = 9 + ranks
    returned = "[][0] if record.run.sizes['episode'] else 1.0"
    plan = with_measure(folder, number, returned, ranks=min(ranks, COMM.size))
    result = run_sweep(plan, folder / "out", COMM)

    assert result.count(FAILED) == 1
    named = f"ranks call the measure 'mine-{number}' of {folder / 'part.py'}"
    assert (named in capfd.readouterr().err) == (COMM.size > 1 and COMM.rank == 0)
    assert "IndexError" in result.failures[0]["reason"]
