"""The engines at their limits: without contacts, with contacts too stiff to follow, and with ten thousand sites."""

import re

from mpi4py import MPI

import numpy as np

from tests.conftest import small_case
from tests.unrecorded import unrecorded_samples
from vipetsc.dynamics import simulate
from vipetsc.dynamics.engine import FillResult
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.engine import Propagator
from vipetsc.dynamics.propagator.step_choice import refusal
from vipetsc.io.store import RunMemory


def test_contacts_that_cannot_be_followed_end_the_run():
    """A contact of 1e45 N/m ends a run with a sentence that names it, in the state of the last sample before it."""
    model = small_case(contacts={"sites": [1, 6], "law": "bilinear", "stiffness": 1e45}).model()
    layout = Layout(model, MPI.COMM_SELF)
    engine = Propagator(model, layout)

    # In the first samples the driven cell moves by less than the clearance.
    assert engine.fill(unrecorded_samples(engine.lattice, goal=3)) == FillResult(0)
    assert engine.steps == 3
    assert engine.time == 3 * model.sample_interval

    stalled = engine.fill(unrecorded_samples(engine.lattice, goal=model.samples - 1)).stalled
    assert re.match(r"the contacts of sites 1 at 0.0\d+ s", stalled)
    # The engine's state is that of the last sample before the stall.
    assert engine.time == engine.steps * model.sample_interval
    time_of_stall = float(stalled.split()[-2])
    assert 0 < time_of_stall - engine.time < model.sample_interval
    engine.destroy()


def test_a_run_that_stalls_ends_with_its_last_sample_and_the_contact_of_the_stall():
    """The energies of the last sample before a stall balance: they leave out the work of forces in the stalled step.

    The log has the contact that begins in that step.
    """
    case = small_case(contacts={"sites": [1, 6], "law": "bilinear", "stiffness": 1e45}, time={"engine": "propagator"})
    memory = RunMemory(MPI.COMM_SELF)
    result = simulate(case, memory)
    assert "stalled" in result.sentence
    assert result.statistics["engine"] == "propagator"

    run = memory.dataset
    assert run is not None
    work = run["energy/work"].values
    held = sum(run[f"energy/{name}"].values for name in ("kinetic", "spring", "contact", "dissipated"))
    assert work[-1] > 0
    assert np.abs(work - held).max() < 1e-9 * np.abs(work).max()

    # The contact that cannot be followed begins in the stalled step, after the last sample: it is recorded.
    last = run["time"].values[-1]
    assert run["impacts/site"].values.tolist() == [1]
    assert last < run["impacts/onset"].values[0] < last + case.model().sample_interval


def test_ten_thousand_sites_are_set_up_and_restored():
    """An engine for 10 000 sites is restored from the checkpoint of another one to the same checkpoint."""
    sites = {"first": 5, "spacing": 10, "count": 10_000}
    case = small_case(lattice={"cells": 100_100}, contacts={"sites": sites}, time={"sample_interval": 1e-4})
    model = case.model()
    assert refusal(model) is None
    layout = Layout(model, MPI.COMM_SELF)
    engine = Propagator(model, layout)
    assert engine.fill(unrecorded_samples(engine.lattice, goal=1)) == FillResult(0)

    state = engine.checkpoint()
    other = Propagator(model, layout)
    other.restore([state])
    restored = other.checkpoint()

    assert len(state["sites"]) == 10_000
    assert len(state["losses"]) == 10_000
    for name, table in state.items():
        # Texts are compared because NaN differs from itself as a number.
        assert repr(table.tolist()) == repr(restored[name].tolist()), name
    engine.destroy()
    other.destroy()
