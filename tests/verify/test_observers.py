"""Observers of a run: the threshold of the guard, the ledger over a checkpoint, and observers that a user writes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.conftest import StopAt, assert_same_bits, datasets, small_case
from vipetsc.dynamics import simulate
from vipetsc.dynamics.energies import Energies
from vipetsc.dynamics.observers import Guard, Ledger, Observer, RunawayError
from vipetsc.dynamics.samples import Block


def block(work: list[float], total: list[float], dissipated: float = 0.0) -> Block:
    """Samples one second apart with ``work`` done and ``total`` kinetic energy, both (sample,) in J."""
    none = np.zeros(len(work))
    energies = Energies(
        kinetic=np.array(total),
        spring=none,
        contact=none,
        work=np.array(work),
        dissipated=none + dissipated,
        dissipated_by_damping=none,
    )
    return Block(first=0, times=np.arange(len(work)) * 1.0, energies=energies, samples=None, state=None)


def damped_block(lost: list[float], powers: list[float], first: int = 0) -> Block:
    """Samples of a lattice at rest whose dashpots have ``lost`` so many J, at ``powers`` in J per sample."""
    begun_block = block(work=[10.0] * len(lost), total=[0.0] * len(lost))
    energies = replace(begun_block.energies, dissipated_by_damping=np.array(lost), damping=np.array(powers))
    return replace(begun_block, first=first, energies=replace(energies, kinetic=10.0 - np.array(lost)))


def begun(kind: type[Observer]) -> Observer:
    """An observer of the ``kind`` at the beginning of a run of an undamped lattice."""
    observer = kind()
    undamped = SimpleNamespace(chain=SimpleNamespace(is_damped=False))
    observer.begin(SimpleNamespace(meter=SimpleNamespace(largest=1e6, negligible=1e-6), model=undamped))
    return observer


def test_the_guard_allows_a_tenth_of_the_largest_work():
    guard = begun(Guard)
    guard.observe(block(work=[2.0], total=[1.81]))
    # The threshold is a tenth of the largest work so far, which is more than a tenth of the present work.
    guard.observe(block(work=[1.0], total=[1.19]))
    with pytest.raises(RunawayError, match=r"the energy diverges: 1.21 J in the lattice, 1 J of work done"):
        guard.observe(block(work=[1.0], total=[1.21]))

    resumed = begun(Guard)
    resumed.restore(guard.checkpoint())
    resumed.observe(block(work=[1.0], total=[1.19]))
    with pytest.raises(RunawayError, match="diverges"):
        begun(Guard).observe(block(work=[1.0], total=[1.19]))


def test_the_guard_names_the_first_bad_sample_of_a_block():
    work = [1.0, 2.0, 1.0, 1.0, np.nan, 9.0]
    total = [1.0, 2.0, 1.19, 1.21, 1.0, 9.0]
    with pytest.raises(RunawayError, match="diverges") as runs_away:
        begun(Guard).observe(block(work, total))
    assert runs_away.value.sample == 3

    del work[3]
    del total[3]
    with pytest.raises(RunawayError, match="not finite") as not_finite:
        begun(Guard).observe(block(work, total))
    assert not_finite.value.sample == 3


class Watch(Observer):
    """An observer that lists the samples it sees, one in a block, and keeps the largest velocity."""

    name = "test-watch"
    longest = 1
    calls: list

    def begin(self, setup):
        super().begin(setup)
        Watch.calls = ["begin"]
        self.fastest = 0.0
        self.seen = []

    def observe(self, block):
        half = self.setup.layout.dofs * self.setup.layout.owned
        assert len(block) == 1
        self.seen.append((block.first, float(block.times[0])))
        self.fastest = max(self.fastest, float(np.abs(block.state.array_r[half : 2 * half]).max()))

    def flush(self):
        Watch.calls.append("flush")

    def checkpoint(self):
        Watch.calls.append("checkpoint")
        return {"fastest": np.array(self.fastest)}

    def restore(self, state):
        assert state.keys() == {"fastest"}
        self.fastest = float(state["fastest"])
        Watch.calls.append("restore")

    def finish(self, stopped):
        Watch.calls.append("stopped" if stopped else "finish")

    def statistics(self):
        return {"fastest": self.fastest, "watched": self.seen}


def test_an_observer_is_given_and_goes_on_with_the_run(folder):
    case = small_case(time={"end": 0.04})
    straight = simulate(case, folder / "straight", observers=[Watch])
    # A run in a folder keeps its end, from which it can be extended.
    assert Watch.calls == ["begin", "flush", "checkpoint", "finish"]

    run = datasets(folder / "straight" / "run.h5")
    assert straight.statistics["fastest"] == np.abs(run["velocity"]).max()
    assert straight.statistics["watched"] == list(enumerate(run["time"].tolist()))

    stopped = simulate(case, folder / "stopped", stop=StopAt(150), observers=[Watch])
    assert Watch.calls == ["begin", "flush", "checkpoint", "stopped"]

    resumed = simulate(case, folder / "stopped", resume=True, observers=[Watch])
    assert Watch.calls == ["begin", "restore", "flush", "checkpoint", "finish"]
    assert stopped.statistics["watched"] + resumed.statistics["watched"] == straight.statistics["watched"]
    for name in ("fastest", "ledger_error", "work", "dissipated", "episodes", "samples", "steps", "switches", "grazes"):
        assert resumed.statistics[name] == straight.statistics[name], name
    assert_same_bits(run, datasets(folder / "stopped" / "run.h5"))


def test_a_loss_of_dashpots_that_falls_is_an_error_of_the_balance():
    """The largest fall below any earlier value counts, also across blocks and a checkpoint."""
    ledger = begun(Ledger)
    ledger.observe(damped_block([0.0, 3.0, 2.5], [0.0, 1.0, 1.0]))
    assert ledger.statistics()["ledger_error"] == pytest.approx(0.05)

    resumed = begun(Ledger)
    resumed.restore(ledger.checkpoint())
    resumed.observe(damped_block([2.0, 4.0], [1.0, 1.0], first=3))
    assert resumed.statistics()["ledger_error"] == pytest.approx(0.1)
