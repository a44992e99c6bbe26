"""Ranks that draw pictures for rank 0: the files are the same, and errors and requests to stop reach all ranks."""

from __future__ import annotations

import shutil
import time

from mpi4py import MPI

import pytest

from tests.conftest import small_case
from vipetsc.cli.drawing import draw_pictures, draw_unmeasured
from vipetsc.cli.helping_ranks import with_helping_ranks
from vipetsc.cli.verbs.run_verb import PICTURES
from vipetsc.dynamics import simulate
from vipetsc.figures import registry
from vipetsc.parallel import StopRequest, on_root
from vipetsc.studies.reanalysis import measure_run

COMM = MPI.COMM_WORLD
PATIENCE = 60.0  # s to wait for a request, which takes 0.1 s on an idle machine


@pytest.fixture
def run(folder):
    """The folder of a run that rank 0 has simulated; it has no measures yet."""
    case = small_case(time={"engine": "propagator", "end": 0.03}, output={"fields": ["velocity"]})
    on_root(COMM, lambda: simulate(case, folder / "run", MPI.COMM_SELF))
    return folder / "run"


def pictures_in(folder):
    """The bytes of each picture of a run, by its name."""
    return {path.name: path.read_bytes() for path in (folder / "figures").iterdir()}


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.parallel([2, 3])
def test_all_ranks_together_draw_what_one_draws(run, monkeypatch):
    """Every rank draws some of the pictures, each picture is drawn once, and the files are those of one rank."""
    drawn_here = []
    draw = registry.draw

    def watch(*arguments, **options):
        files = draw(*arguments, **options)
        drawn_here.extend(path.name for path in files)
        return files

    monkeypatch.setattr(registry, "draw", watch)

    def work(helpers):
        draw_unmeasured(PICTURES, run, helpers)
        assert helpers.requests
        measure_run(run)
        files = draw_pictures(PICTURES, [run], MPI.COMM_SELF, afresh=False, helper=helpers)
        assert not helpers.requests
        return files

    files = with_helping_ranks(COMM, StopRequest(), work)
    by_rank = COMM.allgather(drawn_here)
    # Pictures without measures are left to the helping ranks, which draw two or four each. The others are divided, and
    # rank 0 may come too late for any of them.
    assert all(by_rank[1:])
    drawn = sorted(name for names in by_rank for name in names)
    assert drawn == [path.name for path in files]
    assert len({*drawn}) == len(drawn) > len(PICTURES.unmeasured)

    monkeypatch.undo()
    if COMM.rank == 0:
        alone = shutil.copytree(run, run.parent / "alone", ignore=shutil.ignore_patterns("figures"))
        with monkeypatch.context() as context:
            from tests.coarse import coarse_pictures

            coarse_pictures(context.setattr)
            draw_pictures(PICTURES, [alone], MPI.COMM_SELF)
        assert pictures_in(run) == pictures_in(alone)


def fail(*arguments, **options):
    """Raise the error of a picture that cannot be drawn, with the number of the rank."""
    raise ValueError(f"rank {COMM.rank} cannot draw")


@pytest.mark.parallel([2, 3])
def test_what_a_helping_rank_raises_is_raised_on_all(run, monkeypatch):
    """An error of a helping rank is raised on all ranks, and the rank takes part in the next request."""
    if COMM.rank == COMM.size - 1:
        monkeypatch.setattr(registry, "draw", fail)

    def work(helpers):
        helpers.ask("run", [run], names=["unit_cell", "ledger"])
        return helpers.drawn().files

    with pytest.raises(ValueError, match=f"rank {COMM.size - 1} cannot draw"):
        with_helping_ranks(COMM, StopRequest(), work)

    # The rank that failed has drawn nothing, but takes part in the next request.
    monkeypatch.undo()
    files = with_helping_ranks(COMM, StopRequest(), work)
    assert {path.stem for path in files} == {"unit_cell", "ledger"}


@pytest.mark.parallel([2, 3])
def test_an_answer_has_the_pictures_of_the_requests_since_the_last_answer(run):
    """Rank 0, which waits twice, gets each picture once."""

    def work(helpers):
        helpers.ask("run", [run], names=["unit_cell"])
        first = helpers.drawn()
        helpers.ask("run", [run], names=["ledger"])
        return [path.stem for files, _ in (first, helpers.drawn()) for path in files]

    assert with_helping_ranks(COMM, StopRequest(), work) == ["unit_cell", "ledger"]


@pytest.mark.parallel([2, 3])
def test_what_rank_0_raises_is_raised_on_all(run):
    """If rank 0 fails before it receives an answer, that answer is not taken for the answer to a later request."""

    def work(helpers):
        helpers.ask("run", [run], names=["no figure"])
        raise RuntimeError(f"on rank {COMM.rank}")

    with pytest.raises(RuntimeError, match="on rank 0"):
        with_helping_ranks(COMM, StopRequest(), work)

    def work_again(helpers):
        helpers.ask("run", [run], names=["unit_cell"])
        return helpers.drawn().files

    # Rank 0 draws none of these pictures.
    (path,) = with_helping_ranks(COMM, StopRequest(), work_again)
    assert path.name == "unit_cell.png"


@pytest.mark.parallel([2, 3])
def test_a_request_to_stop_that_any_rank_gets_reaches_rank_0():
    """Rank 0 sees the request of another rank while it works; a later piece of work does not see it."""
    stop = StopRequest()
    stop.requested = COMM.rank == COMM.size - 1

    def work(helpers):
        deadline = time.monotonic() + PATIENCE
        while not stop.requested and time.monotonic() < deadline:
            time.sleep(0.01)
        return stop.requested

    assert with_helping_ranks(COMM, stop, work)

    stop = StopRequest()
    assert not with_helping_ranks(COMM, stop, lambda helpers: stop.requested)
    assert not stop.requested
