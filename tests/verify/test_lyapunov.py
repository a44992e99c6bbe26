"""The largest Lyapunov exponent against closed forms, published values, and an independent computation."""

from __future__ import annotations

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
from scipy.optimize import brentq

from tests.conftest import StopAt
from tests.verify.test_sections import IMPACT, RESTITUTION
from vipetsc import Case, analyse, simulate
from vipetsc.dynamics.lyapunov import LargestExponent

EXPONENT = {"lyapunov": True}


def exponent(table: dict) -> tuple[float, float]:
    """Return the exponent and its error in 1/s of the case of a ``table``."""
    statistics = simulate(Case.from_table(table | {"output": EXPONENT})).statistics
    return statistics["lyapunov"], statistics["lyapunov_error"]


@pytest.mark.parametrize("engine", ["ts", "propagator"])
@pytest.mark.parametrize("rate", [0.05, 0.3])
def test_a_linear_lattice_has_the_exponent_of_its_damping(engine, rate):
    """With C = 2 rate M every mode falls as exp(-rate t), whatever its frequency; no amplitude plays a part."""
    table = {
        "lattice": {"cells": 12, "damping": {"mass": 2 * rate}, "cell": {"masses": [0.5], "springs": [
            {"start": 1, "end": 1, "stiffness": 2.0, "next_cell": True}]}},
        "contacts": {"sites": 0},
        "drive": {"waveform": "harmonic", "amplitude": 3.0, "frequency": 1.5},
        "time": {"samples_per_period": 12, "end": 400.0, "engine": engine},
    }  # fmt: skip
    found, _ = exponent(table)
    assert found == pytest.approx(-rate, abs=4e-3)


def test_the_oscillator_of_ueda_has_its_published_exponent():
    """x'' + 0.05 x' + x^3 = 7.5 cos t: 0.1034 (Sprott, Chaos and Time-Series Analysis, Oxford 2003, app. A.5.3)."""
    # Both ends of the spring of a single cell are fixed, so that it acts twice. A stiffness must be positive.
    spring = {"start": 1, "end": 1, "stiffness": 1e-6, "cubic": 0.5, "damping": 0.025, "next_cell": True}
    found, error = exponent(
        {
            "lattice": {"cells": 1, "cell": {"masses": [1.0], "springs": [spring]}},
            "contacts": {"sites": 0},
            "drive": {"waveform": "harmonic", "amplitude": 7.5, "frequency": 1.0},
            "time": {"samples_per_period": 20, "end": 4000.0},
        }
    )
    assert error < 0.005
    assert found == pytest.approx(0.1034, abs=0.012)


def impacting(omega: float, end: float) -> dict:
    """Return the table of the impact oscillator x'' + x = sin(omega t), with a stiff stop at x = 0, up to ``end``."""
    return IMPACT | {"drive": IMPACT["drive"] | {"frequency": omega}, "time": IMPACT["time"] | {"end": end}}


@pytest.mark.parametrize("omega", [2.0, 2.3])
def test_one_impact_a_period_has_the_exponent_of_its_multipliers(omega):
    """The map from impact to impact has the determinant r^2 (Shaw and Holmes 1983); here |multipliers| = r, each."""
    found, _ = exponent(impacting(omega, 600.0))
    assert found == pytest.approx(np.log(RESTITUTION) * omega / (2 * np.pi), rel=0.04)


def rigid_exponent(omega: float, impacts: int) -> float:
    """Return the exponent in 1/s of the impact oscillator with a rigid stop, from its flights in closed form.

    The deviation turns in each flight, and an impact at the speed v and the force a = sin(omega t) changes it to
    -r dx, -r dv + (1 + r) (a/v) dx (Mueller, Chaos, Solitons and Fractals 5 (1995) 1671).
    """
    force = 1 / (1 - omega**2)
    time = 0.3
    speed = -0.5
    deviation = np.array([1.0, 0.3])
    total = 0.0
    begin = 0.0
    for number in range(impacts):
        if number == impacts // 10:
            total = 0.0
            begin = time
        a = -force * np.sin(omega * time)
        b = speed - force * omega * np.cos(omega * time)

        def x(s: float, time: float = time, a: float = a, b: float = b) -> float:
            return a * np.cos(s) + b * np.sin(s) + force * np.sin(omega * (time + s))

        s = np.linspace(1e-6, 40.0, 40_000)
        first = int(np.argmax(x(s) > 0))
        flight = brentq(x, s[first - 1], s[first], xtol=1e-13)
        time += flight
        before = -a * np.sin(flight) + b * np.cos(flight) + force * omega * np.cos(omega * time)
        turn = np.array([[np.cos(flight), np.sin(flight)], [-np.sin(flight), np.cos(flight)]])
        ratio = np.sin(omega * time) / before
        jump = np.array([[-RESTITUTION, 0.0], [(1 + RESTITUTION) * ratio, -RESTITUTION]])
        deviation = jump @ turn @ deviation
        speed = -RESTITUTION * before
        size = float(np.linalg.norm(deviation))
        total += np.log(size)
        deviation /= size
    return total / (time - begin)


def test_the_chaos_of_the_impact_oscillator_has_the_exponent_of_a_rigid_stop():
    """A stop of 1e8 N/m, by engines and a second run, against closed flights and derivatives at a rigid stop."""
    found, error = exponent(impacting(2.85, 1500.0))
    expected = rigid_exponent(2.85, 3000)
    assert error < 0.03
    assert expected > 0.1
    assert found == pytest.approx(expected, abs=0.06)


EXPONENT_OF_CHAIN = {
    "lattice": {"cells": 12},
    "contacts": {"sites": [6], "clearance": 1e-4},
    "drive": {"waveform": "harmonic", "amplitude": 20.0, "frequency": 700.0},
    "time": {"samples_per_period": 16, "end": 0.5},
    "output": EXPONENT,
}


# After the companion has begun: ``ts`` looks at requests to stop in each sample, the propagator in each block of 16.
@pytest.mark.parametrize(("engine", "looks"), [("ts", 301), ("propagator", 30)])
def test_a_stopped_run_goes_on_to_the_same_exponent(tmp_path, engine, looks):
    """Wherever it is stopped, and if it is extended; the run itself has the same bits without the exponent."""
    case = Case.from_table(EXPONENT_OF_CHAIN | {"time": EXPONENT_OF_CHAIN["time"] | {"engine": engine}})
    straight = simulate(case)
    assert straight.statistics["engine"] == engine
    assert straight.statistics["episodes"] > 5
    without = simulate(case.varied(without=["output"]))
    assert np.array_equal(straight.dataset["velocity"], without.dataset["velocity"])

    assert simulate(case, tmp_path / "run", stop=StopAt(looks)).resumable
    again = simulate(case, tmp_path / "run")
    assert again.complete
    assert again.statistics["lyapunov"] == straight.statistics["lyapunov"]

    shorter = EXPONENT_OF_CHAIN["time"] | {"engine": engine, "end": 0.2}
    assert simulate(Case.from_table(EXPONENT_OF_CHAIN | {"time": shorter}), tmp_path / "extended").complete
    extended = simulate(case, tmp_path / "extended", extend=True)
    assert extended.statistics["lyapunov"] == straight.statistics["lyapunov"]
    measured = analyse(straight.dataset, ["motion"])
    assert float(measured["lyapunov"]) == straight.statistics["lyapunov"]


class Stopped:
    """An engine of one mass that stands where it is: its ``cells`` (1, 2), and of a contact the mode and approach."""

    def __init__(self, cells: list[float], mode: int, approach: float) -> None:
        self.state = {
            "cells": np.array([cells]),
            "sites": np.array([(mode, approach)], [("mode", "i4"), ("approach", "f8")]),
        }

    def checkpoint(self) -> dict:
        """Return a copy of the state."""
        return {key: value.copy() for key, value in self.state.items()}

    def restore(self, parts: list) -> None:
        """Take the state of the only rank."""
        (self.state,) = parts


def compared(run: Stopped, companion: Stopped) -> LargestExponent:
    """Return the observer after it has compared a ``companion`` with the ``run`` at 2 s, with the growth 0.5 before."""
    observer = LargestExponent()
    layout = SimpleNamespace(comm=MPI.COMM_SELF, cells=1, start=0, stop=1)
    observer.setup = SimpleNamespace(engine=run, layout=layout)
    observer.growth, observer.largest, observer.size, observer.last = [(1.0, 1.0, 0.5)], 1.0, 1e-6, 1.0
    observer._frequency, observer._companion = 1.0, companion
    observer._compare(run.checkpoint()["cells"], 2.0)
    return observer


def test_runs_are_compared_where_they_have_the_same_contacts_closed():
    """Else the companion goes on as it is, and the growth is taken later."""
    companion = Stopped([0.0, 1.5], 0, 0.0)
    observer = compared(Stopped([0.0, 1.0], 1, 1.2), companion)
    assert observer.growth == [(1.0, 1.0, 0.5)]
    assert companion.state["cells"].tolist() == [[0.0, 1.5]]


def test_a_closed_contact_has_its_approach_as_a_part_of_the_state():
    """It is brought back with the state: 4e-6 beside a deviation of 8e-6 becomes 5e-7 beside one of 1e-6."""
    companion = Stopped([0.0, 1.0 + 8e-6], 1, 1.2 + 4e-6)
    observer = compared(Stopped([0.0, 1.0], 1, 1.2), companion)
    assert observer.growth[-1] == pytest.approx((2.0, 1.0, np.log(8.0)), rel=1e-9)
    assert companion.state["cells"][0, 1] - 1.0 == pytest.approx(1e-6, rel=1e-6)
    assert companion.state["sites"]["approach"][0] - 1.2 == pytest.approx(5e-7, rel=1e-6)
