"""The propagator, compared with the time stepper, with exact solutions, and with itself after a stop."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.conftest import simulated, small_case
from tests.models import THREE_MASS_CELL
from vipetsc.case import Case
from vipetsc.contact.law import create_contacts
from vipetsc.dynamics.propagator.taylor import first_onset
from vipetsc.lattice import Contact


def with_engine(case: Case, engine: str, **time) -> Case:
    """The same case with an ``engine``; ``time`` updates the table [time]."""
    return case.model_copy(update={"time": case.time.model_copy(update={"engine": engine} | time)})


def relative(difference: np.ndarray, whole: np.ndarray) -> float:
    """The Euclidean norm of a ``difference``, divided by that of the ``whole``."""
    return float(np.linalg.norm(difference) / np.linalg.norm(whole))


def response_to_tone(omega: np.ndarray, tone: float, t: float) -> tuple[np.ndarray, np.ndarray]:
    """The solution x(t), x'(t) of x'' + omega^2 x = sin(tone t) from rest for each ``omega``; 0 is a rigid motion."""
    x = np.zeros_like(omega)
    v = np.zeros_like(omega)
    moving = omega > 0
    w = omega[moving]
    gap = w**2 - tone**2

    x[moving] = (np.sin(tone * t) - tone / w * np.sin(w * t)) / gap
    v[moving] = tone * (np.cos(tone * t) - np.cos(w * t)) / gap
    x[~moving] = t / tone - np.sin(tone * t) / tone**2
    v[~moving] = (1 - np.cos(tone * t)) / tone
    return x, v


def exact_linear(case: Case) -> np.ndarray:
    """Velocities (time, cell, dof) in m/s by the modes of the whole lattice and the drive's three sinusoids."""
    model = case.model()
    drive = model.drive
    root = 1 / np.sqrt(model.chain.masses())
    squared, modes = np.linalg.eigh(model.chain.stiffness_matrix().toarray() * root[:, None] * root)
    omega = np.sqrt(np.maximum(squared, 0))
    # Rounding gives a rigid motion a small frequency, by which the solution would be divided.
    omega[omega < 1e-6 * omega.max()] = 0.0
    driven_dof = model.drive_cell * model.chain.cell.dofs + model.drive_mass
    # The force's projection on each mode.
    push = modes[driven_dof] * root[driven_dof] * drive.window_amplitude

    # [1 - cos(Om t/Nc)] sin(Om t) is a tone of frequency Om less half of each of two tones at Om (1 +- 1/Nc).
    tones = [(1.0, drive.frequency)]
    for sign in (1, -1):
        tones.append((-0.5, drive.frequency * (1 + sign / drive.cycles)))

    def driven(t: float) -> np.ndarray:
        """Displacements and velocities (2, mode) while the drive acts."""
        return sum(weight * push * np.array(response_to_tone(omega, tone, t)) for weight, tone in tones)

    # Every mode swings freely from its state at the end of the drive.
    x_end, v_end = driven(drive.duration)
    velocities = []
    for t in np.arange(model.samples) * model.sample_interval:
        free = t - drive.duration
        v = v_end * np.cos(omega * free) - omega * x_end * np.sin(omega * free)
        if free < 0:
            v = driven(t)[1]
        velocities.append(modes @ v * root)
    return np.reshape(velocities, (model.samples, model.chain.cells, -1))


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
@pytest.mark.parametrize(
    ("lattice", "drive", "time"),
    [
        ({"preset": "four-band"}, {"amplitude": 1.0, "cycles": 6}, {}),
        ({"preset": "diatomic"}, {"amplitude": 1.0, "cycles": 8, "cell": 25, "mass": 2}, {"sample_interval": 1e-3}),
        ({"cell": THREE_MASS_CELL}, {"frequency": 700.0, "cycles": 5, "cell": 3}, {"sample_interval": 4e-4}),
    ],
)
def test_a_linear_run_is_the_modal_solution(ends, lattice, drive, time):
    """A linear run is the superposition of modes under the drive's three sinusoids, to 1e-11."""
    table = {
        "lattice": {"cells": 50, "ends": ends} | lattice,
        "contacts": {"sites": []},
        "drive": drive,
        "time": {"end": 0.1, "engine": "propagator", "rtol": 1e-12} | time,
    }
    case = Case.from_table(table)
    exact = exact_linear(case)

    run, result = simulated(case)

    # The eigenvalues of 200 masses have errors of about this size.
    assert relative(run["velocity"].values - exact, exact) < 1e-11
    assert result.statistics["engine"] == "propagator"
    # The truncation is a bound on the dropped terms, which is not zero.
    assert 0 < result.statistics["truncation"] < 1e-14
    assert result.statistics["ledger_error"] < 1e-12


def test_the_builtin_run_takes_the_steps_it_needs():
    """The built-in run takes one step from each sample to the next, and few substeps."""
    _, result = simulated(with_engine(Case.load(), "propagator"))
    statistics = result.statistics

    # This number is that of both engines at all tight tolerances.
    assert statistics["episodes"] == 181
    assert statistics["steps"] == statistics["samples"] - 1
    assert statistics["bandwidth"] == 2
    # The run needs 6064 substeps. It would need more without special nodes for substeps at onsets and separations.
    assert statistics["substeps"] < 6200


def test_tolerance_keeps_its_promise():
    """The relative error of velocities is less than ten times the tolerance."""
    velocity = {}
    for rtol in (1e-6, 1e-8, 1e-12):
        run, _ = simulated(small_case(time={"rtol": rtol, "engine": "propagator"}))
        velocity[rtol] = run["velocity"].values

    for rtol in (1e-6, 1e-8):
        assert relative(velocity[rtol] - velocity[1e-12], velocity[1e-12]) < 10 * rtol


@pytest.mark.parametrize(
    ("sections", "reason"),
    [
        ({"lattice": {"cells": 2}, "contacts": {"sites": [1, 2]}}, "the lattice has 2 cells, fewer"),
        ({"lattice": {"cells": 40}, "contacts": {"sites": list(range(3, 39))}}, "36 sites between cells 3 and 38"),
        ({"drive": {"frequency": 1e6}}, "is too long for 1.1667e+06 rad/s, of the drive or the lattice"),
    ],
)
@pytest.mark.parametrize("engine", ["auto", "propagator"])
def test_what_does_not_suit_it_is_stepped_and_noted(sections, reason, engine):
    """A case that the propagator refuses is run by ``ts``, and a note gives the reason."""
    _, result = simulated(small_case(**sections, time={"end": 0.002, "engine": engine}))

    assert result.statistics["engine"] == "ts"
    assert reason in result.statistics["engine_note"]


@settings(max_examples=60)
@given(st.lists(st.floats(-1, 1), min_size=4, max_size=12), st.floats(0.1, 1.0), st.floats(0.05, 2.0))
def test_no_onset_is_missed(coefficients, length, clearance):
    """Before the first onset that is found for a polynomial w, or in the whole step, |w| is below the clearance."""
    jet = np.array(coefficients)
    s = np.linspace(0, length, 4001)
    w = np.abs(np.polynomial.polynomial.polyval(s, jet))
    # An open contact begins clear of its stop.
    assume(w[0] < clearance * 0.999)

    onset = first_onset(jet, create_contacts(Contact("hertz", 1.0), [clearance])[0], length)

    # Onsets are located up to rounding errors of the polynomial.
    limit = clearance * (1 + 1e-9)
    if onset > length:
        assert w.max() <= limit
    else:
        assert np.all(w[s < onset] <= limit)
        at_onset = abs(np.polynomial.polynomial.polyval(onset, jet))
        assert at_onset == pytest.approx(clearance, rel=1e-9)
