"""Runs in which nothing is wrong, although energies, steps or landings are far from the usual ones."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import simulated
from tests.unit.propagator_parts import mass_on_stop
from vipetsc.case import Case
from vipetsc.dynamics.propagator.advance import _control_length

ENGINES = pytest.mark.parametrize("engine", ["ts", "propagator"])


def flat_band(engine: str, periods: int, damping: float = 0.0, coupling: float = 10.0) -> Case:
    """Three cells of a host and a resonator, hardly coupled, driven at the resonance of the middle one."""
    k = 1e4
    omega = float(np.sqrt(2 * k / 0.01))
    springs = [
        {"start": 1, "end": 1, "stiffness": coupling, "next_cell": True},
        {"start": 1, "end": 2, "stiffness": k, "damping": damping},
    ]
    cell = {"masses": [0.01, 0.01], "springs": springs, "contact": [1, 2]}
    period = 2 * np.pi / omega
    drive = {"waveform": "harmonic", "amplitude": 1e-3, "cell": 2, "mass": 1, "frequency": omega, "ramp": 2 * period}
    return Case.from_table(
        {
            "name": "flat",
            "lattice": {"cells": 3, "ends": "fixed", "cell": cell},
            "contacts": {"sites": 0},
            "drive": drive,
            "time": {"end": periods * period, "engine": engine},
            "output": {"figures": False},
        }
    )


@ENGINES
@pytest.mark.parametrize("coupling", [1.0, 10.0])
def test_an_undamped_resonance_grows_as_long_as_it_is_driven(engine, coupling):
    """The amplitude grows with the time, the energy with its square, far beyond that of the forced wave."""
    run, result = simulated(flat_band(engine, 400, coupling=coupling))
    energy = run["energy/kinetic"].values + run["energy/spring"].values
    half = len(energy) // 2
    # Not exactly: the host's springs to its neighbours detune it by their part of the stiffness.
    assert energy[-1] / energy[half] == pytest.approx(4.0, rel=0.35)
    assert result.statistics["ledger_error"] < 1e-8


@ENGINES
def test_what_dashpots_dissipate_may_exceed_the_energy_by_far(engine):
    """At a steady amplitude the loss grows by the same amount in each period, over 600 of them."""
    run, result = simulated(flat_band(engine, 600, damping=0.05))
    lost = run["energy/dissipated_by_damping"].values
    per_sixth = np.diff(lost[:: len(lost) // 6])
    assert per_sixth[3:] == pytest.approx(per_sixth[-1], rel=0.01)
    assert result.statistics["ledger_error"] < 1e-8


@pytest.mark.parametrize("clearance", [0.141421356237, 0.14142135623, 0.1414213562373, 0.14142135623731])
def test_a_mode_that_begins_at_a_turning_point_on_the_stop_goes_on(clearance):
    """The pair of two masses begins at rest within 1e-10 of the stop, with |w| = 2^1/2/10 of its second mode."""
    springs = [{"start": 1, "end": 1, "stiffness": 1.0, "next_cell": True}, {"start": 1, "end": 2, "stiffness": 1.0}]
    case = Case.from_table(
        {
            "lattice": {"cells": 1, "cell": {"masses": [1.0, 1.0], "springs": springs, "contact": [1, 2]}},
            "contacts": {"law": "bilinear", "stiffness": 100.0, "sites": [1], "clearance": clearance},
            "initial": {"kind": "mode", "number": 2, "amplitude": 0.1},
            "time": {"end": 20.0, "samples": 101, "engine": "ts"},
        }
    )
    run, result = simulated(case)
    # The stop is reached with hardly any velocity, if at all: the mode goes on, u_1 = 0.1 cos(omega t) up to a factor.
    u = run.displacement.values[:, 0]
    k = np.array([[3.0, -1.0], [-1.0, 1.0]])
    omega = np.sqrt(np.linalg.eigvalsh(k)[1])
    expected = u[0] * np.cos(omega * run.time.values)[:, None]
    np.testing.assert_allclose(u, expected, atol=1e-5)
    assert result.statistics["ledger_error"] < 1e-9


@pytest.mark.parametrize(("length", "forced"), [(1e-10, 1), (1e-3, 0)])
def test_substeps_that_are_taken_in_spite_of_their_error_are_counted(length, forced):
    """Of a force that is not smooth the shortest substep is taken and counted; a longer one is rejected."""
    cluster = mass_on_stop()
    cluster.trial.force[:] = np.random.default_rng(1).normal(size=cluster.trial.force.shape) * 1e12
    taken = _control_length(cluster, cluster.trial, length, False)
    assert bool(taken) == bool(forced)
    assert cluster.state["forced"].tolist() == [forced]
    assert cluster.state["rejected"].tolist() == [1 - forced]


SHORTS = pytest.mark.parametrize("short", [1e-4, 1e-9, 1e-14])


def creeping(cells: int, coupling: float, ground: float, short: float) -> tuple[Case, float]:
    """A case in which a constant force pulls the middle mass of a chain on dashpots slowly to its stop.

    The stop is nearer than the position of equilibrium by the fraction ``short`` of this position, which is returned.
    """
    middle = cells // 2
    stiffness = coupling * (2 * np.eye(cells) - np.eye(cells, k=1) - np.eye(cells, k=-1))
    rest = np.linalg.inv(stiffness)[middle, middle]
    springs = [{"start": 1, "end": 1, "stiffness": coupling, "next_cell": True}]
    law = {"law": "bilinear", "stiffness": 1e4, "restitution": 0.5}
    # The rate at which the slowest mode decays.
    lowest = np.linalg.eigvalsh(stiffness)[0]
    rate = ground / 2 - np.sqrt(ground**2 / 4 - lowest)
    end = np.ceil(100.0 - np.log(short) / rate)
    case = Case.from_table(
        {
            "lattice": {"cells": cells, "cell": {"masses": [1.0], "springs": springs, "grounding": [ground]}},
            "contacts": law
            | {"sites": [middle + 1], "pair": [0, 1], "side": "plus", "clearance": rest * (1.0 - short)},
            "drive": {"waveform": "step", "amplitude": 1.0, "ramp": 0.1, "frequency": 1.0, "cell": middle + 1},
            "time": {"end": end, "samples": int(10 * end) + 1, "engine": "propagator" if cells > 1 else "ts"},
            "output": {"figures": False},
        }
    )
    return case, rest


@SHORTS
@pytest.mark.parametrize(("cells", "coupling", "ground"), [(1, 0.5, 3.0), (7, 2.0, 6.0)])
def test_a_mass_that_creeps_onto_a_stop_comes_to_rest_on_it(cells, coupling, ground, short):
    """The force presses the mass onto its stop in the end, by either engine, however little is left to press.

    Impacts that are not resolved beside the clearance took steps of microseconds for ever: the damping of an impact is
    divided by its speed, and contacts less deep than the tolerance of a landing opened and closed without an end.
    """
    case, rest = creeping(cells, coupling, ground, short)
    run, result = simulated(case)
    statistics = result.statistics
    assert result.complete
    assert statistics["engine"] == case.time.engine
    assert statistics["rejected"] + statistics.get("substeps", statistics["steps"]) < 100_000
    assert statistics["missed"] == statistics["floored"] == 0
    assert statistics["ledger_error"] < 1e-11
    # The error in the end is what is allowed to a step; in equilibrium the contact is pressed by 1e-4 of ``short``.
    final = run["displacement"].values[-1, cells // 2, 0]
    assert final == pytest.approx(rest * (1.0 - short), abs=rest * (2e-4 * short + 1e-11))
