"""Engines against exact solutions; their tolerances, methods, PETSc options and limits."""

from __future__ import annotations

import json

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.conftest import StopAt, run_of, simulated, small_case
from tests.models import THREE_MASS_CELL
from vipetsc.case import Case, CaseError
from vipetsc.cli.main import main
from vipetsc.contact.law import create_contacts
from vipetsc.dynamics import simulate
from vipetsc.dynamics.propagator.taylor import first_onset
from vipetsc.io.store import RunMemory
from vipetsc.lattice import Contact


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


@pytest.mark.parametrize(
    ("engine", "bounds"), [("propagator", {1e-6: 1e-5, 1e-8: 1e-7}), ("ts", {1e-8: 1e-4, 1e-10: 1e-6})]
)
def test_tolerance_keeps_its_promise(engine, bounds):
    """The relative error of velocities is below a bound that falls with the tolerance."""
    velocity = {}
    for rtol in (*bounds, 1e-12):
        velocity[rtol] = run_of(small_case(time={"rtol": rtol, "engine": engine}))["velocity"].values
    for rtol, bound in bounds.items():
        assert relative(velocity[rtol] - velocity[1e-12], velocity[1e-12]) < bound


@pytest.mark.parametrize(
    ("sections", "reason"),
    [
        ({"lattice": {"cells": 2}, "contacts": {"sites": [1, 2]}}, "the lattice has 2 cells, fewer"),
        ({"lattice": {"cells": 40}, "contacts": {"sites": list(range(3, 39))}}, "36 sites between cells 3 and 38"),
        ({"drive": {"frequency": 1e6}}, "is too long for 1.1667e+06 rad/s, of the drive or the lattice"),
        ({"lattice": {"profiles": {"springs[1].cubic": [3e11] * 24}}}, "24 nonlinear springs"),
        ({"petsc": {"ts_rk_type": "5dp"}}, "PETSc options"),
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


def test_a_run_that_stalls_ends_with_its_last_sample_and_the_contact_of_the_stall():
    """The energies of the last sample before a stall balance: they leave out the work of forces in the stalled step."""
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


@pytest.fixture(scope="module")
def exact():
    """Velocities of the small case by the default method, at a tolerance a hundred times lower than the others'."""
    return run_of(small_case(time={"end": 0.04, "rtol": 1e-11}))["velocity"].values


# The third-order pair would need very many steps at 1e-9.
@pytest.mark.parametrize(("method", "rtol"), [("3bs", 1e-6), ("7vr", 1e-9)])
def test_every_method_samples_exactly(exact, method, rtol):
    """Every Runge-Kutta method ends steps on samples, where its error is that of its steps alone."""
    run = run_of(small_case(time={"end": 0.04, "method": method, "rtol": rtol}))
    assert relative(run["velocity"].values - exact, exact) < 1e4 * rtol


def test_fixed_steps_converge_with_the_order_of_the_method(petsc_options):
    """With fixed steps (-ts_adapt_type none -ts_dt H) halving H divides the error of the method 3bs by about 2^3."""
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


SHORT = {"time": {"end": 0.01}}


def test_options_are_stored_and_go_with_the_case(folder):
    """A run with options has them after it is resumed, and the next run of the same process has none of them."""
    case = small_case(**SHORT, petsc={"ts_rk_type": "5dp", "ts_adapt_clip": "0.2,5"})
    assert Case.from_toml(case.to_toml()) == case

    assert simulate(case, folder / "run", stop=StopAt(20)).resumable
    assert simulate(case, folder / "run", resume=True).statistics["method"] == "5dp"
    summary = json.loads((folder / "run" / "summary.json").read_text())
    assert summary["case"]["petsc"]["ts_rk_type"] == "5dp"

    assert not {name for name in PETSc.Options().getAll() if name.startswith("ts_")}
    assert simulate(small_case(**SHORT), folder / "plain").statistics["method"] == "8vr"


def test_options_in_the_database_become_part_of_the_case(folder, petsc_options):
    """Options in PETSc's database are stored in the case, except those that only show something."""
    petsc_options(ts_rk_type="3bs", ts_monitor_draw="")

    simulate(small_case(**SHORT), folder / "run")

    assert Case.from_toml((folder / "run" / "case.toml").read_text()).petsc.model_dump() == {"ts_rk_type": "3bs"}


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("mat_type", "aij", "no such option"),
        # The command line reads an option without a value as "true".
        ("log_veiw", "true", "no such option"),
        ("ts_adapt_type", "foo", "PETSc refuses it"),
        ("ts_rtol", "much", "PETSc refuses it"),
        ("ts_type", "beuler", "stepped by"),
        ("ts_dt", "nan", "must be positive"),
    ],
)
def test_what_petsc_does_not_know_is_refused_before_anything_is_written(folder, capsys, name, value, reason):
    assert main(["run", "--out", str(folder / "out")], {"ts_adapt_clip": "0.1,5", name: value}) == 2
    message = capsys.readouterr().err
    assert f"petsc.{name} = '{value}'" in message.lower()
    assert reason in message
    assert message.count("petsc.") == 1
    assert not (folder / "out").exists()
    with pytest.raises(CaseError):
        simulate(small_case(petsc={name: value}), folder / "out")
