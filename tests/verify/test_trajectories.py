"""Trajectories against independent integrations, exact relations and symmetries."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from tests.conftest import StopAt, assert_same_bits, datasets, small_case
from vipetsc.case import Case
from vipetsc.dynamics import simulate
from vipetsc.io.store import RunMemory


def reference(case: Case):
    """The same case by SciPy's DOP853 in plain numpy, stopped at every contact change.

    Returns velocities (time, cell, dof) and the onsets as (time, site, approach velocity).
    """
    model = case.model()
    chain, contact = model.chain, model.contact
    pull, masses, dofs = -chain.stiffness_matrix().toarray(), chain.masses(), chain.cell.dofs
    n = masses.size
    host = np.array([c * dofs + chain.cell.host for c in chain.sites])
    resonator = np.array([c * dofs + chain.cell.resonator for c in chain.sites])
    clearance = np.array(chain.clearances)
    side, approach = np.zeros(len(host)), np.ones(len(host))

    def slope(t, y):
        u, v = y[:n], y[n:]
        force = pull @ u
        if side.any():
            w, rate = u[resonator] - u[host], v[resonator] - v[host]
            x = np.where(side != 0, np.maximum(side * w - clearance, 0), 0)
            push = side * contact.stiffness * x**contact.exponent * contact.dissipation_factor(rate, approach)
            force[host] += push
            force[resonator] -= push
        force[model.drive_cell * dofs + model.drive_mass] += model.drive.force(t)
        return np.concatenate([v, force / masses])

    def change(site, sign):
        def event(t, y):
            return sign * (y[resonator[site]] - y[host[site]]) - clearance[site]

        event.terminal = True
        event.direction = -1 if side[site] == sign else 1
        return event

    times = np.arange(model.samples) * model.sample_interval
    y, t, onsets = np.zeros(2 * n), 0.0, []
    samples = np.empty((len(times), 2 * n))
    # The burst's end is a kink: stop there too.
    for end in sorted({min(model.drive.duration, times[-1]), times[-1]}):
        while t < end:
            events = [change(s, sign) for s in range(len(host)) for sign in ((side[s],) if side[s] else (1, -1))]
            scale = model.scale * 1e-3
            found = solve_ivp(
                slope, (t, end), y, "DOP853", dense_output=True, events=events or None, rtol=1e-12, atol=1e-12 * scale,
                max_step=4e-5,
            )  # fmt: skip
            inside = (times >= t) & (times <= found.t[-1])
            if inside.any():
                samples[inside] = found.sol(times[inside]).T
            t, y = found.t[-1], found.y[:, -1]
            if found.status == 1:
                hit = next(i for i, at in enumerate(found.t_events) if at.size)
                event_sites = [(s, g) for s in range(len(host)) for g in ((side[s],) if side[s] else (1, -1))]
                site, sign = event_sites[hit]
                if side[site]:
                    side[site] = 0
                else:
                    side[site] = sign
                    approach[site] = y[n + resonator[site]] - y[n + host[site]]
                    onsets.append((t, site, approach[site]))
    return samples[:, n:].reshape(len(times), chain.cells, dofs), np.array(onsets).reshape(-1, 3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lattice", "contacts", "drive", "end"),
    [
        ({"reading": "printed"}, {"restitution": 0.4}, {"amplitude": 60.0}, 0.04),
        # Conservative or free, the lattice is chaotic: pointwise agreement ends early.
        ({"ends": "free"}, {"law": "bilinear", "restitution": 1.0}, {}, 0.025),
        ({"ends": "periodic"}, {}, {"cell": 3, "mass": 4}, 0.04),
    ],
)
def test_agrees_with_an_independent_integration(folder, lattice, contacts, drive, end):
    case = small_case(lattice=lattice, contacts=contacts, drive=drive, time={"end": end})
    velocity, onsets = reference(case)
    simulate(case, folder / "run")
    ours = datasets(folder / "run" / "run.h5")
    assert len(onsets) > 5
    np.testing.assert_array_equal(ours["impacts/site"], onsets[:, 1].astype(int) + 1)
    np.testing.assert_allclose(ours["impacts/onset"], onsets[:, 0], atol=1e-8, rtol=0)
    np.testing.assert_allclose(ours["impacts/approach_velocity"], onsets[:, 2], rtol=1e-5)
    assert np.linalg.norm(ours["velocity"] - velocity) < 1e-6 * np.linalg.norm(velocity)


@pytest.mark.slow
def test_diatomic_agrees_with_an_independent_integration(folder):
    case = Case.from_table(
        {
            "lattice": {"preset": "diatomic", "cells": 30},
            "contacts": {"sites": [8, 15], "clearance": 4e-5},
            "drive": {"amplitude": 3.0, "cycles": 10},
            "time": {"end": 0.05},
        }
    )
    velocity, onsets = reference(case)
    simulate(case, folder / "run")
    ours = datasets(folder / "run" / "run.h5")
    assert len(onsets) > 5
    assert len(ours["impacts/onset"]) == len(onsets)
    assert np.linalg.norm(ours["velocity"] - velocity) < 1e-6 * np.linalg.norm(velocity)


def test_work_of_the_linear_diatomic_case(folder):
    table = {
        "lattice": {"preset": "diatomic", "reading": "printed"},
        "contacts": {"sites": 0},
        "drive": {"amplitude": 0.1},
        "time": {"end": 0.05},
    }
    result = simulate(Case.from_table(table), folder / "run")
    assert result.statistics["work"] == pytest.approx(1.542815e-5, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["hertz", "bilinear"])
@pytest.mark.parametrize("restitution", [1.0, 0.7])
@pytest.mark.parametrize(
    ("preset", "amplitude"), [("four-band", 1e-3), ("four-band", 30), ("four-band", 1000), ("diatomic", 200)]
)
def test_ledger_closes(folder, preset, amplitude, law, restitution):
    clearance, end = (2e-3, 0.07) if preset == "four-band" else (2e-4, 0.06)
    table = {
        "lattice": {"preset": preset, "cells": 40},
        "contacts": {"sites": [10, 20], "clearance": clearance, "law": law, "restitution": restitution},
        "drive": {"amplitude": amplitude, "cycles": 8},
        "time": {"end": end},
    }
    result = simulate(Case.from_table(table), folder / "run")
    energy = {k.split("/")[1]: v for k, v in datasets(folder / "run" / "run.h5").items() if k.startswith("energy/")}
    held = energy["kinetic"] + energy["spring"] + energy["contact"]
    residual = energy["work"] - energy["dissipated"] - held
    assert np.abs(residual).max() <= 1e-8 * energy["work"].max()
    assert (np.abs(residual[1:]) <= 1e-8 * energy["work"][1:]).mean() > 0.99
    assert (result.statistics["episodes"] == 0) == (amplitude < 1)
    assert (energy["dissipated"][-1] == 0) == (restitution == 1 or amplitude < 1)
    assert restitution < 1 or result.statistics["pulled"] == 0
    np.testing.assert_allclose(energy["dissipated_by_site"].sum(axis=1), energy["dissipated"], rtol=1e-12, atol=1e-300)


def test_tolerance_keeps_its_promise(folder):
    velocity = {}
    for rtol in (1e-8, 1e-10, 1e-12):
        simulate(small_case(time={"rtol": rtol}), folder / f"{rtol}")
        velocity[rtol] = datasets(folder / f"{rtol}" / "run.h5")["velocity"]
    errors = [np.linalg.norm(velocity[r] - velocity[1e-12]) / np.linalg.norm(velocity[1e-12]) for r in (1e-8, 1e-10)]
    assert errors[0] < 1e-4
    assert errors[1] < 1e-6
    assert errors[1] < errors[0] / 10


@pytest.fixture(scope="module")
def exact():
    """Velocity of the small case by the default method, hundred times as exact as the others are asked to be."""
    memory = RunMemory(MPI.COMM_SELF)
    simulate(small_case(time={"end": 0.04, "rtol": 1e-11}), memory, MPI.COMM_SELF)
    return memory.dataset["velocity"].values


@pytest.mark.parametrize("method", ["5dp", "3bs", "5bs", "6vr", "7vr"])
def test_every_method_samples_exactly(folder, exact, method):
    """Landing on samples is exact for every Runge-Kutta type; dense output is not."""
    rtol = 1e-6 if method == "3bs" else 1e-9
    case = small_case(time={"end": 0.04, "method": method, "rtol": rtol})
    simulate(case, folder / method)
    velocity = datasets(folder / method / "run.h5")["velocity"]
    assert np.linalg.norm(velocity - exact) < 1e4 * rtol * np.linalg.norm(exact)
    # A pair whose last stage is the next step's first must not show where a run was stopped.
    assert simulate(case, folder / "stopped", stop=StopAt(150)).resumable
    assert simulate(case, folder / "stopped").complete
    assert_same_bits(*(datasets(folder / name / "run.h5") for name in (method, "stopped")))


def test_doubling_the_amplitude_doubles_a_linear_run_bit_for_bit(folder):
    fields = []
    for amplitude in (0.001, 0.002):
        simulate(small_case(drive={"amplitude": amplitude}), folder / f"{amplitude}")
        fields.append(datasets(folder / f"{amplitude}" / "run.h5"))
    assert len(fields[0]["impacts/site"]) == 0
    # The front's tail is below the normal numbers, where doubling rounds.
    np.testing.assert_allclose(2 * fields[0]["velocity"], fields[1]["velocity"], rtol=0, atol=1e-300)
    np.testing.assert_array_equal(4 * fields[0]["energy/work"], fields[1]["energy/work"])


def test_a_mirrored_lattice_gives_the_mirrored_answer(folder):
    springs = [(4, 1, 2e4, True), (1, 2, 1e4, False), (2, 4, 1e4, False), (2, 3, 1e3, False)]
    masses = [0.005, 0.0025, 0.003, 0.004]
    cells, dofs = 20, 4

    def case(mirrored: bool) -> Case:
        def place(mass):
            return dofs + 1 - mass if mirrored else mass

        tables = []
        for start, end, stiffness, following in springs:
            a, b = (end, start) if mirrored and following else (start, end)
            tables.append({"start": place(a), "end": place(b), "stiffness": stiffness, "next_cell": following})
        sites, clearance = [5, 11], [1.0e-4, 1.5e-4]
        if mirrored:
            sites, clearance = [cells + 1 - s for s in reversed(sites)], clearance[::-1]
        return Case.from_table(
            {
                "lattice": {
                    "cells": cells,
                    "cell": {
                        "masses": masses[::-1] if mirrored else masses,
                        "springs": tables,
                        "contact": [place(2), place(3)],
                    },
                },
                "contacts": {"stiffness": 5e6, "restitution": 0.7, "sites": sites, "clearance": clearance},
                "drive": {
                    "amplitude": 20.0, "cycles": 6, "frequency": 1000.0, "cell": cells if mirrored else 1,
                    "mass": place(1),
                },
                "time": {"end": 0.05},
            }
        )  # fmt: skip

    for mirrored in (False, True):
        simulate(case(mirrored), folder / str(mirrored))
    straight, mirror = (datasets(folder / str(m) / "run.h5") for m in (False, True))
    assert len(straight["impacts/site"]) > 5
    difference = straight["velocity"] - mirror["velocity"][:, ::-1, ::-1]
    assert np.linalg.norm(difference) < 1e-7 * np.linalg.norm(straight["velocity"])


def effective_restitution(r: float) -> float:
    """Restitution of x'' = -k x^n (1 + c x'/v0), c = 3 (1 - r)/2: from v dv / (1 + c v/v0) on both ways."""
    c = 1.5 * (1 - r)
    return brentq(lambda e: 1 - np.log1p(c) / c + e + np.log1p(-c * e) / c, 1e-9, min(1, 1 / c) - 1e-12)


@pytest.mark.parametrize("law", ["hertz", "bilinear"])
@pytest.mark.parametrize("restitution", [0.95, 0.7, 0.3])
def test_an_isolated_impact_has_the_laws_own_restitution(law, restitution):
    from vipetsc.dynamics.layout import Layout
    from vipetsc.dynamics.ts.integrator import Integrator

    # Springs so soft that they do nothing during one impact.
    soft = 1e-9
    springs = [{"start": 1, "end": 1, "stiffness": soft, "next_cell": True}, {"start": 1, "end": 2, "stiffness": soft}]
    case = Case.from_table(
        {
            "lattice": {"cells": 2, "ends": "free",
                        "cell": {"masses": [0.01, 0.004], "springs": springs, "contact": [1, 2]}},
            "contacts": {"law": law, "stiffness": 5e6, "restitution": restitution, "sites": [1], "clearance": 1e-3},
            "drive": {"amplitude": 1e-30, "frequency": 1e-3, "cycles": 1},
            "time": {"end": 1.0, "sample_interval": 0.1, "atol": 1e-13},
        }
    )  # fmt: skip
    model = case.model()
    layout = Layout(model, MPI.COMM_SELF)
    integrator = Integrator(model, layout)
    tracker = integrator.tracker
    # Velocities lie behind the displacements, mass by mass: host and resonator of cell 1.
    integrator.state.array[layout.dofs * layout.owned + layout.owned] = 1.0
    integrator.step = integrator.free_step = 1e-5
    integrator.observe(tracker.start)
    integrator._first_step = 1e-5
    integrator.advance(0.0025)  # before the rebound meets the other side
    (episode,) = integrator.take_episodes()
    velocity = integrator.state.array_r[layout.dofs * layout.owned :]
    rebound = -(velocity[layout.owned] - velocity[0])
    assert episode["approach_velocity"] == pytest.approx(1.0, abs=1e-9)
    assert episode["onset"] == pytest.approx(1e-3, abs=1e-9)
    assert rebound == pytest.approx(effective_restitution(restitution), abs=1e-8)
    # The law is made for r near 1: its own error is of second order in 1 - r.
    assert abs(rebound - restitution) < (1 - restitution) ** 2
    reduced = 0.01 * 0.004 / 0.014
    assert episode["loss"] == pytest.approx(0.5 * reduced * (1 - rebound**2), rel=1e-7)


@pytest.mark.slow
def test_the_linear_ridge_lies_on_the_bloch_branch(folder):
    from vipetsc.lattice import bloch
    from vipetsc.spectra import fourier

    case = Case.from_table(
        {"lattice": {"preset": "diatomic", "reading": "printed"}, "contacts": {"sites": 0}, "drive": {"amplitude": 0.1}}
    )
    simulate(case, folder / "run")
    data = datasets(folder / "run" / "run.h5")
    spectrum = fourier.dispersion(data["velocity"], case.lattice.unit_cell().masses, case.model().sample_interval)
    wavenumbers, ridge = fourier.ridge(spectrum)
    branch = bloch(case.lattice.unit_cell(), np.abs(wavenumbers)).frequency[:, 1]
    assert len(wavenumbers) > 10
    assert np.max(np.abs(ridge / branch - 1)) < 1e-3


def test_clipped_contacts_never_pull(folder):
    """With restitution 0 the law pulls late in an impact; clipping holds the force at zero there instead."""
    outcome = {}
    for adhesion in ("allow", "clip"):
        case = small_case(contacts={"restitution": 0.0, "adhesion": adhesion})
        outcome[adhesion] = simulate(case, folder / adhesion).statistics
    assert outcome["allow"]["pulled"] > 0
    assert outcome["allow"]["clipped"] == 0
    assert outcome["clip"]["pulled"] == 0
    assert outcome["clip"]["clipped"] > 0
    assert max(s["ledger_error"] for s in outcome.values()) < 1e-8


def test_a_floor_on_the_approach_velocity_is_counted(folder):
    counted = simulate(small_case(contacts={"approach_floor": 0.3}), folder / "run").statistics
    log = datasets(folder / "run" / "run.h5")["impacts/approach_velocity"]
    assert counted["floored"] == np.sum(np.abs(log) < 0.3) > 0


@pytest.mark.slow
def test_fixed_steps_converge_with_the_order_of_the_method(folder, petsc_options):
    """-ts_adapt_type none -ts_dt H: halving H divides the error of 3bs by 2^3, with bilinear contacts in the run."""
    simulate(small_case(contacts={"law": "bilinear"}, time={"rtol": 1e-13, "end": 0.03}), folder / "exact")
    exact = datasets(folder / "exact" / "run.h5")
    errors = []
    for step in (4e-6, 2e-6, 1e-6):
        petsc_options(ts_rk_type="3bs", ts_adapt_type="none", ts_dt=step)
        simulate(small_case(contacts={"law": "bilinear"}, time={"end": 0.03}), folder / f"{step}")
        run = datasets(folder / f"{step}" / "run.h5")
        assert len(run["impacts/onset"]) == len(exact["impacts/onset"]) > 0
        errors.append(np.linalg.norm(run["velocity"] - exact["velocity"]) / np.linalg.norm(exact["velocity"]))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(orders > 2.5), orders
