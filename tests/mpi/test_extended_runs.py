"""A run that is extended has the bits of one long run, by both engines and on ranks; what cannot go on is refused."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import StopAt, assert_same_bits, datasets, small_case
from vipetsc.dynamics import simulate
from vipetsc.io.lock import FolderError
from vipetsc.parallel import on_root

COMM = MPI.COMM_WORLD
OUTPUT = {"points": [{"name": "site", "cell": 4}], "forces": True, "stride": 3}


def case_until(end: float, engine: str, **sections):
    """A case that ends at ``end`` in s, with all that a file may hold."""
    return small_case(time={"end": end, "engine": engine}, output=OUTPUT, **sections)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_an_extended_run_has_the_bits_of_one_long_run(engine, folder):
    """Extends twice, first where sites are in contact; fields of every third sample, forces, points, losses and log."""
    long = simulate(case_until(0.09, engine), folder / "long")
    (site, *_) = on_root(COMM, lambda: _middles_of_contacts(folder / "long"))
    for end in (site, 0.06, 0.09):
        case = case_until(end, engine)
        parts = simulate(case, folder / "parts", extend=end != site)
    assert parts.statistics["episodes"] == long.statistics["episodes"] > 0
    if COMM.rank == 0:
        whole = datasets(folder / "long" / "run.h5")
        assert np.isfinite(whole["impacts/onset"]).any()
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
    assert "changes nothing else" in str(refused.value)
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
@pytest.mark.parametrize("end", [0.04, 0.09])
def test_an_extension_that_was_stopped_may_have_another_end(folder, end):
    """An extension to 0.06 s is given up for one to a sooner or a later end, and has the bits of one long run."""
    long = simulate(case_until(end, "ts"), folder / "long")
    simulate(case_until(0.02, "ts"), folder / "run")
    stopped = simulate(case_until(0.06, "ts"), folder / "run", extend=True, stop=StopAt(20))
    assert stopped.resumable
    with pytest.raises(FolderError, match=r"later time\.end"):
        simulate(case_until(0.015, "ts"), folder / "run", extend=True)
    extended = simulate(case_until(end, "ts"), folder / "run", extend=True)
    assert extended.complete
    assert extended.statistics["end"] == long.statistics["end"]
    assert_same_bits(datasets(folder / "long" / "run.h5"), datasets(folder / "run" / "run.h5"))
