"""Impacts: restitution and loss, clipped forces, a floor on approach velocities, checkpoints and the energy balance."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import xarray as xr
from scipy.optimize import brentq

from tests.conftest import simulated, small_case
from vipetsc.case import Case
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.result import Result
from vipetsc.dynamics.ts.integrator import Integrator


def effective_restitution(r: float) -> float:
    """The restitution e of x'' = -k x^n (1 + c x'/v0) with c = 3 (1 - r)/2, by separation of x and v = x'.

    From v dv/(1 + c v/v0) = -k x^n dx, the integral of the left side from v0 to -e v0 is zero.
    """
    c = 1.5 * (1 - r)

    def imbalance(e: float) -> float:
        return 1 - np.log1p(c) / c + e + np.log1p(-c * e) / c

    return brentq(imbalance, 1e-9, min(1, 1 / c) - 1e-12)


@pytest.mark.parametrize("law", ["hertz", "bilinear"])
@pytest.mark.parametrize("restitution", [0.7, 0.3])
def test_an_isolated_impact_has_the_laws_own_restitution(law, restitution):
    """An isolated impact has the effective restitution e of its law, and the loss mu v^2 (1 - e^2)/2."""
    # The springs are so soft that they do not matter during one impact.
    soft = 1e-9
    springs = [{"start": 1, "end": 1, "stiffness": soft, "next_cell": True}, {"start": 1, "end": 2, "stiffness": soft}]
    masses = [0.01, 0.004]
    table = {
        "lattice": {"cells": 2, "ends": "free", "cell": {"masses": masses, "springs": springs, "contact": [1, 2]}},
        "contacts": {"law": law, "stiffness": 5e6, "restitution": restitution, "sites": [1], "clearance": 1e-3},
        "drive": {"amplitude": 1e-30, "frequency": 1e-3, "cycles": 1},
        "time": {"end": 1.0, "sample_interval": 0.1, "atol": 1e-13},
    }
    model = Case.from_table(table).model()
    layout = Layout(model, MPI.COMM_SELF)
    integrator = Integrator(model, layout)

    # The state holds displacements, then velocities, mass by mass. The resonator of cell 1 begins with 1 m/s.
    first_velocity = layout.dofs * layout.owned
    integrator.state.array[first_velocity + layout.owned] = 1.0
    integrator.step = 1e-5
    integrator.free_step = 1e-5
    integrator._first_step = 1e-5
    integrator.find_site_motion(integrator.tracker.before)
    # The impact is over after about 1.1 ms; after 3 ms the rebounding mass meets the stop on the other side.
    integrator.advance(0.0025)

    (episode,) = integrator.take_episodes()
    velocity = integrator.state.array_r[first_velocity:]
    rebound = -(velocity[layout.owned] - velocity[0])
    assert episode["approach_velocity"] == pytest.approx(1.0, abs=1e-9)
    assert episode["onset"] == pytest.approx(1e-3, abs=1e-9)
    assert rebound == pytest.approx(effective_restitution(restitution), abs=1e-8)
    # The law is derived for r near 1: its effective restitution differs from r by the order (1 - r)^2.
    assert abs(rebound - restitution) < (1 - restitution) ** 2

    reduced_mass = masses[0] * masses[1] / sum(masses)
    assert episode["loss"] == pytest.approx(0.5 * reduced_mass * (1 - rebound**2), rel=1e-7)


@pytest.fixture(scope="module", params=["ts", "propagator"])
def clipped_run(request) -> tuple[xr.Dataset, Result]:
    """A chain in which every cell has a clipped Hertzian contact; samples and the end fall into clipped phases."""
    springs = [{"start": 1, "end": 2, "stiffness": 1e4}, {"start": 2, "end": 1, "stiffness": 1e4, "next_cell": True}]
    contacts = {"law": "hertz", "stiffness": 1e7, "restitution": 0.0, "adhesion": "clip", "side": "plus"}
    return simulated(
        Case.from_table({
            "lattice": {"cells": 6, "cell": {"masses": [1e-3, 2e-3], "contact": [1, 2], "springs": springs}},
            "contacts": contacts | {"sites": list(range(1, 7)), "clearance": 1e-5},
            "drive": {"amplitude": 30.0, "cycles": 4, "frequency": 2500.0},
            "time": {"end": 0.00715, "sample_interval": 1e-5, "engine": request.param, "rtol": 1e-12},
            "output": {"forces": True},
        })
    )  # fmt: skip


def test_a_clipped_contact_loses_its_elastic_energy(clipped_run):
    """A contact that is clipped loses its elastic energy, so that the balance closes and no energy ever returns."""
    run, result = clipped_run
    force = run["sites/force"].values
    # In a clipped phase the masses are pressed together without a force.
    w = np.diff(run["displacement"].values, axis=2)[..., 0]
    clipped = (w > 1.0001e-5) & (force == 0)
    assert clipped[-1].any()

    # The elastic energy at the beginning of a clipped phase is lost. The kink there costs digits of the balance.
    assert result.statistics["clipped"] > 0
    assert result.statistics["ledger_error"] < 1e-9

    # No energy returns to a site, not even at the beginning or the end of a clipped phase.
    lost = run["energy/dissipated_by_site"].values
    assert np.diff(lost, axis=0).min() > -1e-15 * lost.max()
    by_episodes = np.bincount(run["impacts/site"].values - 1, run["impacts/loss"].values, minlength=6)
    np.testing.assert_allclose(by_episodes, lost[-1], rtol=1e-9, atol=1e-14 * lost.max())


def test_many_conservative_hertzian_contacts_keep_the_energy():
    """The energy error after some 400 onsets and separations of soft lossless stops, which adds up, is below 1e-8."""
    springs = [{"start": 1, "end": 2, "stiffness": 1e4}, {"start": 2, "end": 1, "stiffness": 1e4, "next_cell": True}]
    contacts = {"law": "hertz", "stiffness": 3.5e6, "restitution": 1.0, "side": "plus", "clearance": 5.2e-5}
    case = Case.from_table({
        "lattice": {"cells": 2, "cell": {"masses": [1e-3, 2e-3], "contact": [1, 2], "springs": springs}},
        "contacts": contacts | {"sites": [1, 2]},
        "drive": {"amplitude": 30.0, "cycles": 4, "frequency": 2500.0},
        "time": {"end": 0.1, "sample_interval": 1e-4, "engine": "ts"},
    })  # fmt: skip

    _, result = simulated(case)

    assert result.statistics["switches"] > 400
    # The error would be 3.2e-8 if the first step of each contact were taken in time and not in its square root.
    assert result.statistics["ledger_error"] < 1e-8


def test_a_checkpoint_at_an_onset_goes_on_to_the_same_bits():
    """A run restored from a checkpoint at an onset takes the contact's first step as the uninterrupted run does.

    That step is taken in the square root of time.
    """
    model = small_case(contacts={"law": "hertz", "sites": [5], "clearance": 1e-3}, time={"engine": "ts"}).model()
    layout = Layout(model, MPI.COMM_SELF)
    whole = Integrator(model, layout)
    # The resonator of the site is at its stop and moves towards it, so that a contact begins.
    cells = np.zeros((layout.cells, 2 * layout.dofs))
    resonator = model.chain.cell.resonator
    cells[4, resonator] = 1e-3
    cells[4, layout.dofs + resonator] = 1.0
    whole.set_motion(cells, np.array([[1e-3, 1.0]]), 0.0)

    parts = Integrator(model, layout)
    parts.restore([whole.checkpoint()])
    for engine in (whole, parts):
        engine.advance(1e-3)

    assert whole.tracker.contacts["mode"][0] != 0 or len(whole.take_episodes()) > 0
    np.testing.assert_array_equal(parts.state.array_r, whole.state.array_r)
    assert parts.counts == whole.counts


def test_checkpoints_under_a_drive_of_pieces_go_on_to_the_same_bits():
    """Runs restored at every sample under a drive of several pieces have the bits of the uninterrupted run.

    The drive acts on a mass of the contact site and therefore on w'', which the search for an onset in the first step
    uses.
    """
    case = Case.from_table({
        "lattice": {"preset": "four-band", "cells": 24},
        "contacts": {"sites": [5], "clearance": 2e-4},
        "drive": {"waveform": "harmonic", "amplitude": 20.0, "frequency": 1000.0, "cell": 5, "mass": 2},
        "time": {"end": 0.03, "engine": "ts"},
    })  # fmt: skip
    model = case.model()
    assert model.chain.cell.host == 1
    layout = Layout(model, MPI.COMM_SELF)
    whole = Integrator(model, layout)

    for number in range(1, model.samples):
        # Like a resumed run, each new engine begins with no piece of its drive selected.
        parts = Integrator(model, layout)
        parts.restore([whole.checkpoint()])
        for engine in (whole, parts):
            engine.advance(number * model.sample_interval)
        np.testing.assert_array_equal(parts.state.array_r, whole.state.array_r)
        np.testing.assert_array_equal(parts.tracker.before, whole.tracker.before)
        parts.destroy()

    assert len(whole.take_episodes()) > 5
    whole.destroy()
