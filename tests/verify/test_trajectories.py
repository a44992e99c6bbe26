"""Trajectories against independent integrations, exact relations and symmetries."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import simpson, solve_ivp
from scipy.linalg import eigh

from tests.conftest import StopAt, assert_same_bits, datasets, run_of, simulated, small_case
from vipetsc.case import Case
from vipetsc.dynamics import simulate
from vipetsc.lattice import bloch
from vipetsc.spectra import fourier


class Reference:
    """A case in plain numpy, integrated by SciPy's DOP853 from one change of contact to the next."""

    def __init__(self, case: Case) -> None:
        self.model = case.model()
        chain = self.model.chain
        self.pull = -chain.stiffness_matrix().toarray()
        self.masses = chain.masses()
        self.clearance = np.array(chain.clearances)
        first = np.array(chain.sites) * chain.cell.dofs
        self.host = first + chain.cell.host
        self.resonator = first + chain.cell.resonator
        self.driven = self.model.drive_cell * chain.cell.dofs + self.model.drive_mass

        # The side +1 or -1 of a closed contact (0: open), and the relative velocity at its onset.
        self.side = np.zeros(len(first), int)
        self.approach = np.ones(len(first))

    def rate(self, t: float, y: np.ndarray) -> np.ndarray:
        """The time derivative of the state ``y``, displacements and velocities (2n,)."""
        u, v = y.reshape(2, -1)
        force = self.pull @ u
        if self.side.any():
            force += self.contact_forces(u, v)
        force[self.driven] += self.burst(t)
        return np.concatenate([v, force / self.masses])

    def burst(self, t: float) -> float:
        """The force of the drive in N at time ``t`` in s, by eq. (3) of the paper."""
        drive = self.model.drive
        if not 0 < t < drive.duration:
            return 0.0
        phase = drive.frequency * t
        return drive.window_amplitude * (1 - math.cos(phase / drive.cycles)) * math.sin(phase)

    def contact_forces(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Forces (mass,) in N of the closed contacts, by the case's law."""
        contact = self.model.contact
        w = u[self.resonator] - u[self.host]
        w_rate = v[self.resonator] - v[self.host]
        indentation = np.where(self.side != 0, np.maximum(self.side * w - self.clearance, 0), 0)
        elastic = contact.stiffness * indentation**contact.exponent
        push = self.side * elastic * contact.dissipation_factor(w_rate, self.approach)

        forces = np.zeros(len(u))
        forces[self.host] += push
        forces[self.resonator] -= push
        return forces

    def changes(self) -> list:
        """Events for SciPy: an open contact closes on either side, or a closed one opens."""
        events = []
        for site, closed in enumerate(self.side):
            for side in (closed,) if closed else (1, -1):
                event = self.change(site, side)
                event.terminal = True
                event.direction = -1 if closed else 1
                event.place = site, side
                events.append(event)
        return events

    def change(self, site: int, side: int):
        """The indentation in m of a ``site`` on one ``side``, as a function of time and state."""
        return lambda _, y: side * (y[self.resonator[site]] - y[self.host[site]]) - self.clearance[site]

    def integrate(self) -> tuple[np.ndarray, np.ndarray]:
        """Velocities (time, cell, dof) in m/s, and onsets as rows of time, site from 0 and approach velocity."""
        model = self.model
        n = len(self.masses)
        times = np.arange(model.samples) * model.sample_interval
        samples = np.empty((len(times), 2 * n))
        onsets = []
        t = 0.0
        y = np.zeros(2 * n)

        # The integration stops at the end of the burst as well, where the force has a kink.
        for end in sorted({min(model.drive.duration, times[-1]), times[-1]}):
            while t < end:
                events = self.changes()
                # Longer steps could pass over a contact.
                solved = solve_ivp(
                    self.rate,
                    (t, end),
                    y,
                    "DOP853",
                    dense_output=True,
                    events=events or None,
                    rtol=1e-12,
                    atol=1e-15 * model.scale,
                    max_step=8e-5,
                )
                inside = (times >= t) & (times <= solved.t[-1])
                if inside.any():
                    samples[inside] = solved.sol(times[inside]).T
                t = solved.t[-1]
                y = solved.y[:, -1]

                for event, found in zip(events, solved.t_events or [], strict=True):
                    if found.size == 0:
                        continue
                    site, side = event.place
                    if self.side[site]:
                        self.side[site] = 0
                    else:
                        self.side[site] = side
                        self.approach[site] = y[n + self.resonator[site]] - y[n + self.host[site]]
                        onsets.append((t, site, self.approach[site]))

        velocity = samples[:, n:].reshape(len(times), model.chain.cells, -1)
        return velocity, np.array(onsets).reshape(-1, 3)


def relative(difference: np.ndarray, whole: np.ndarray) -> float:
    """The Euclidean norm of a ``difference``, divided by that of the ``whole``."""
    return float(np.linalg.norm(difference) / np.linalg.norm(whole))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lattice", "contacts", "drive", "end"),
    [
        ({"reading": "printed"}, {"restitution": 0.4}, {"amplitude": 60.0}, 0.03),
        # This conservative lattice is chaotic, so that trajectories agree for a shorter time.
        ({"ends": "free"}, {"law": "bilinear", "restitution": 1.0}, {}, 0.025),
        ({"ends": "periodic"}, {}, {"cell": 3, "mass": 4}, 0.03),
    ],
)
def test_agrees_with_an_independent_integration(lattice, contacts, drive, end):
    """Velocities, and site, onset and approach velocity of every impact, are those of SciPy's integrator."""
    case = small_case(lattice=lattice, contacts=contacts, drive=drive, time={"end": end})
    velocity, onsets = Reference(case).integrate()

    run = run_of(case)

    assert len(onsets) > 5
    np.testing.assert_array_equal(run["impacts/site"], onsets[:, 1].astype(int) + 1)
    np.testing.assert_allclose(run["impacts/onset"], onsets[:, 0], atol=1e-8, rtol=0)
    np.testing.assert_allclose(run["impacts/approach_velocity"], onsets[:, 2], rtol=1e-5)
    assert relative(run["velocity"].values - velocity, velocity) < 1e-6


@pytest.mark.slow
def test_diatomic_agrees_with_an_independent_integration():
    """Velocities and the number of impacts of a diatomic lattice are those of SciPy's integrator."""
    table = {
        "lattice": {"preset": "diatomic", "cells": 30},
        "contacts": {"sites": [8, 15], "clearance": 4e-5},
        "drive": {"amplitude": 3.0, "cycles": 10},
        "time": {"end": 0.05},
    }
    case = Case.from_table(table)
    velocity, onsets = Reference(case).integrate()

    run = run_of(case)

    assert len(onsets) > 5
    assert len(run["impacts/onset"]) == len(onsets)
    assert relative(run["velocity"].values - velocity, velocity) < 1e-6


@pytest.mark.slow
def test_work_of_the_linear_diatomic_case():
    """The work on a linear lattice is the energy that the burst leaves in its modes.

    The force F on a mass leaves a mode of frequency omega, which moves the mass by phi, with phi^2/2 |F^(omega)|^2,
    where F^ is the Fourier integral of F over the burst.
    """
    table = {
        "lattice": {"preset": "diatomic", "reading": "printed"},
        "contacts": {"sites": 0},
        "drive": {"amplitude": 0.1},
        "time": {"end": 0.05},
    }
    case = Case.from_table(table)
    _, result = simulated(case)

    reference = Reference(case)
    squared, modes = eigh(-reference.pull, np.diag(reference.masses))
    times = np.linspace(0, reference.model.drive.duration, 2001)
    force = np.array([reference.burst(t) for t in times])
    turns = np.exp(-1j * np.outer(np.sqrt(np.maximum(squared, 0)), times))
    left = modes[reference.driven] ** 2 / 2 * np.abs(simpson(force * turns, x=times)) ** 2
    assert result.statistics["work"] == pytest.approx(left.sum(), rel=1e-6)


@pytest.mark.slow
def test_tolerance_keeps_its_promise():
    """A hundredth of the tolerance lowers the error by ten or more; 1e-10 leaves less than 1e-6."""
    velocity = {rtol: run_of(small_case(time={"rtol": rtol}))["velocity"].values for rtol in (1e-8, 1e-10, 1e-12)}
    coarse = relative(velocity[1e-8] - velocity[1e-12], velocity[1e-12])
    fine = relative(velocity[1e-10] - velocity[1e-12], velocity[1e-12])

    assert coarse < 1e-4
    assert fine < 1e-6
    assert fine < coarse / 10


@pytest.fixture(scope="module")
def exact():
    """Velocities of the small case by the default method, at a tolerance a hundred times lower than the others'."""
    return run_of(small_case(time={"end": 0.04, "rtol": 1e-11}))["velocity"].values


# The third-order pair would need very many steps at 1e-9.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "rtol"), [("5dp", 1e-9), ("3bs", 1e-6), ("5bs", 1e-9), ("6vr", 1e-9), ("7vr", 1e-9)]
)
def test_every_method_samples_exactly(folder, exact, method, rtol):
    """Every Runge-Kutta method ends steps on samples, where its error is that of its steps alone.

    Dense output between steps would add errors. A run that is stopped and resumed has the same bits.
    """
    case = small_case(time={"end": 0.04, "method": method, "rtol": rtol})

    simulate(case, folder / "straight")

    straight = datasets(folder / "straight" / "run.h5")
    assert relative(straight["velocity"] - exact, exact) < 1e4 * rtol

    # Some pairs use the last stage of a step as the first of the next one, which must not depend on a stop.
    assert simulate(case, folder / "stopped", stop=StopAt(150)).resumable
    assert simulate(case, folder / "stopped").complete
    assert_same_bits(straight, datasets(folder / "stopped" / "run.h5"))


@pytest.mark.slow
def test_the_linear_ridge_lies_on_the_bloch_branch():
    """The largest response at each wavenumber has the frequency of the optical branch, without contacts."""
    table = {
        "lattice": {"preset": "diatomic", "reading": "printed"},
        "contacts": {"sites": 0},
        "drive": {"amplitude": 0.1},
        "time": {"engine": "propagator", "rtol": 1e-8},
    }
    case = Case.from_table(table)
    cell = case.lattice.unit_cell()
    run = run_of(case)

    spectrum = fourier.dispersion(run["velocity"].values, cell.masses, case.model().sample_interval)
    wavenumbers, ridge = fourier.ridge(spectrum)
    branch = bloch(cell, np.abs(wavenumbers)).frequency[:, 1]
    assert len(wavenumbers) > 10
    assert np.max(np.abs(ridge / branch - 1)) < 1e-3


@pytest.mark.slow
def test_fixed_steps_converge_with_the_order_of_the_method(petsc_options):
    """With fixed steps (-ts_adapt_type none -ts_dt H) halving H divides the error of the method 3bs by about 2^3.

    The run has bilinear contacts.
    """
    exact = run_of(small_case(contacts={"law": "bilinear"}, time={"rtol": 1e-13, "end": 0.022}))
    velocity = exact["velocity"].values

    errors = []
    for step in (4e-6, 2e-6, 1e-6):
        petsc_options(ts_rk_type="3bs", ts_adapt_type="none", ts_dt=step)
        run = run_of(small_case(contacts={"law": "bilinear"}, time={"end": 0.022}))
        assert len(run["impacts/onset"]) == len(exact["impacts/onset"]) > 0
        errors.append(relative(run["velocity"].values - velocity, velocity))

    # The measured order is a little below 3, as changes of contact are located to a tolerance only.
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(orders > 2.5), orders
