"""Runs that are stopped and resumed, or extended, have the bits of one long run, also on other numbers of ranks."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import InParts, StopAt, assert_same_bits, datasets, small_case
from tests.mpi.alike import COMM
from tests.mpi.test_same_bits import drives
from tests.verify.test_impacts import joined
from vipetsc.dynamics import simulate
from vipetsc.io.lock import FolderError
from vipetsc.parallel import on_root, wait_for_all


def sticking(engine: str):
    """Return a lattice whose rigid stops stick."""
    return joined(engine, [6, 12, 18], 0.0)


# The time stepper looks for a request to stop after every step, the propagator after every ten samples: these are
# looks while contacts are closed, or while sites stick.
@pytest.mark.parallel([2])
@pytest.mark.parametrize(
    ("create", "engine", "looks"),
    [(drives, "ts", 150), (drives, "propagator", 6), (sticking, "ts", 300), (sticking, "propagator", 19)],
)
def test_a_run_that_stopped_during_contacts_goes_on(folder, create, engine, looks):
    """A run that is resumed has the bits of a run without a stop."""
    case = create(engine)
    stopped = simulate(case, folder / "parts", stop=StopAt(looks), observers=[InParts])
    assert stopped.resumable, stopped.sentence
    assert simulate(case, folder / "parts", resume=True, observers=[InParts]).complete
    simulate(case, folder / "whole", observers=[InParts])

    def compare() -> None:
        parts = datasets(folder / "parts/run.h5")
        assert_same_bits(parts, datasets(folder / "whole/run.h5"))
        end = stopped.statistics["end"]
        is_closed = (parts["impacts/onset"] < end) & ~(parts["impacts/separation"] <= end)
        assert is_closed.any(), end

    on_root(COMM, compare)


@pytest.mark.parallel([3])
@pytest.mark.parametrize(
    ("engine", "looks", "damping"), [("ts", (500, 150), None), ("propagator", (14, 3), {"mass": 10.0})]
)
def test_a_stopped_run_goes_on_to_the_same_bits_on_any_number_of_ranks(folder, engine, looks, damping):
    """A run begins on one rank, continues on all and ends on all but one, with the bits of an uninterrupted run."""
    sections = {
        "lattice": {"damping": damping},
        "contacts": {"sites": [12, 8, 1, 13, 24], "restitution": 0.7},
        "output": {"window": [3, 20], "every": 2},
    }
    case = small_case(time={"end": 0.05, "engine": engine}, **sections)
    fewer = COMM.Split(int(COMM.rank == 0))
    if COMM.rank == 0:
        simulate(case, folder / "straight", MPI.COMM_SELF, observers=[InParts])
        begun = simulate(case, folder / "stopped", MPI.COMM_SELF, stop=StopAt(looks[0]), observers=[InParts])
        assert begun.resumable
    # Ranks that wait for others to simulate are asleep: in a barrier they would keep their cores busy.
    wait_for_all(COMM)

    gone_on = simulate(case, folder / "stopped", resume=True, stop=StopAt(looks[1]), observers=[InParts])
    assert gone_on.resumable
    COMM.Barrier()

    if COMM.rank:
        assert simulate(case, folder / "stopped", fewer, resume=True, observers=[InParts]).complete
    wait_for_all(COMM)
    fewer.Free()

    if COMM.rank == 0:
        straight = datasets(folder / "straight" / "run.h5")
        assert_same_bits(straight, datasets(folder / "stopped" / "run.h5"))
        assert len(straight["impacts/site"]) > 10


OUTPUT = {"points": [{"name": "site", "cell": 4}], "forces": True, "stride": 3}


def case_until(end: float, engine: str, **sections):
    """A case that ends at ``end`` in s, with all that a file may hold."""
    return small_case(time={"end": end, "engine": engine}, output=OUTPUT, **sections)


@pytest.mark.parallel([2])
@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_an_extended_run_has_the_bits_of_one_long_run(engine, folder):
    """Extends twice, first where sites are in contact; fields of every third sample, forces, points, losses and log."""
    long = simulate(case_until(0.06, engine), folder / "long")
    (site, *_) = on_root(COMM, lambda: _middles_of_contacts(folder / "long"))
    for end in (site, 0.05, 0.06):
        parts = simulate(case_until(end, engine), folder / "parts", extend=end != site)
    assert parts.statistics["episodes"] == long.statistics["episodes"] > 0
    if COMM.rank == 0:
        whole = datasets(folder / "long" / "run.h5")
        assert_same_bits(whole, datasets(folder / "parts" / "run.h5"))


def _middles_of_contacts(folder) -> list[float]:
    """Times in s of samples at which a site is in contact."""
    run = datasets(folder / "run.h5")
    inside = np.any(run["sites/force"] != 0, axis=1)
    return run["time"][inside].tolist()


@pytest.mark.parallel(1)
def test_what_cannot_go_on_is_refused(folder):
    """A later end names ``--extend``; another key, an earlier end, no run and a lost end-state are refused."""
    path = folder / "run"
    with pytest.raises(FolderError, match="no run to extend"):
        simulate(case_until(0.02, "ts"), path, extend=True)
    simulate(case_until(0.02, "ts"), path)
    with pytest.raises(FolderError, match=r"time\.end.*--extend"):
        simulate(case_until(0.03, "ts"), path)

    with pytest.raises(FolderError, match="another run") as refused:
        simulate(case_until(0.03, "ts", drive={"amplitude": 7.0}), path, extend=True)
    assert "--force" not in str(refused.value)
    with pytest.raises(FolderError, match=r"later time\.end"):
        simulate(case_until(0.01, "ts"), path, extend=True)

    (path / "end-state" / "source").unlink()
    with pytest.raises(FolderError, match="end-state"):
        simulate(case_until(0.03, "ts"), path, extend=True)
    # The run is as it was.
    assert simulate(case_until(0.02, "ts"), path).complete


@pytest.mark.parallel(1)
def test_an_extension_that_was_killed_goes_on_without_being_asked(folder):
    """A kill after the case was replaced, before any sample: the short run is not taken for the long one."""
    simulate(case_until(0.02, "ts"), folder / "run")
    longer = case_until(0.03, "ts")
    (folder / "run" / "case.toml").write_text(longer.to_toml())
    assert simulate(longer, folder / "run").statistics["end"] == pytest.approx(0.03, rel=1e-3)


@pytest.mark.parallel(1)
@pytest.mark.parametrize("end", [0.03, 0.06])
def test_an_extension_that_was_stopped_may_have_another_end(folder, end):
    """An extension to 0.05 s is given up for one to a sooner or a later end, and has the bits of one long run."""
    simulate(case_until(end, "ts"), folder / "long")
    simulate(case_until(0.02, "ts"), folder / "run")
    stopped = simulate(case_until(0.05, "ts"), folder / "run", extend=True, stop=StopAt(20))
    assert stopped.resumable
    with pytest.raises(FolderError, match=r"later time\.end"):
        simulate(case_until(0.015, "ts"), folder / "run", extend=True)
    assert simulate(case_until(end, "ts"), folder / "run", extend=True).complete
    assert_same_bits(datasets(folder / "long" / "run.h5"), datasets(folder / "run" / "run.h5"))
