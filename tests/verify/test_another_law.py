"""Hardening stops F = k x (1 + b x^2), the elastic law of a user's module in the manual, in runs and normal modes."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from tests.conftest import simulated
from tests.manual_modules import write_modules
from vipetsc.case import Case, NnmCase
from vipetsc.modes.branches.follow import follow_all

K = 2e5  # N/m
B = 4e5  # 1/m^2
GAP = 1e-3  # m
STOPS = {"law": "hardening", "parameters": {"b": B}, "stiffness": K, "sites": [4, 6], "clearance": GAP}
MASS = 1.3  # kg
SPRING = 4e4  # N/m


@pytest.fixture(scope="module")
def plugins(tmp_path_factory) -> dict[str, list[str]]:
    """The section [plugins] that names the module."""
    folder = tmp_path_factory.mktemp("another-law")
    write_modules(folder)
    return {"modules": [str(folder / "stops.py")]}


def test_both_engines_follow_the_same_trajectory(plugins):
    """They do to 1e-6 of the largest velocity, with closed ledgers; linear stops of the same stiffness differ."""
    linear = {key: value for key, value in STOPS.items() if key != "parameters"} | {"law": "bilinear"}
    velocities = []
    for engine, contacts in (("ts", STOPS), ("propagator", STOPS), ("propagator", linear)):
        table = {
            "plugins": plugins,
            "lattice": {"preset": "four-band", "cells": 12},
            "contacts": contacts | {"restitution": 0.6},
            "drive": {"amplitude": 300.0, "cycles": 5, "cell": 5},
            "time": {"end": 0.03, "engine": engine, "rtol": 1e-10},
        }
        run, result = simulated(Case.from_table(table))
        assert result.statistics["engine"] == engine
        assert result.statistics["episodes"] > 4
        assert result.statistics["ledger_error"] < 1e-7
        velocities.append(run["velocity"].values)
    stepped, exact, by_linear_stops = velocities
    largest = np.abs(exact).max()
    assert np.abs(stepped - exact).max() < 1e-6 * largest
    assert np.abs(by_linear_stops - exact).max() > 1e-3 * largest


def exact_period(energy: float) -> float:
    """The period in s of a mass on a spring between two stops: the integral of dx/sqrt(2 (E - V(x))/m)."""

    def potential(x: float) -> float:
        depth = max(x - GAP, 0.0)
        return SPRING * x**2 / 2 + K * depth**2 / 2 + K * B * depth**4 / 4

    farthest = brentq(lambda x: potential(x) - energy, 0, 1, xtol=1e-16)

    # With x = farthest sin(s) the integrand is smooth at the farthest point.
    def slowness(s: float) -> float:
        speed = np.sqrt(2 * max(energy - potential(farthest * np.sin(s)), 1e-300) / MASS)
        return farthest * np.cos(s) / speed

    touching = np.arcsin(min(GAP / farthest, 1.0))
    parts = [
        quad(slowness, low, high, epsabs=0, epsrel=1e-11)[0] for low, high in ((0, touching), (touching, np.pi / 2))
    ]
    return 4 * sum(parts)


# The condensed method may leave out harmonics of 1e-4 of the motion: its error is larger than that of shooting.
@pytest.mark.parametrize(("method", "error"), [("shooting", 1e-8), ("balance", 1e-5)])
def test_normal_modes_have_the_period_of_the_energy_integral(plugins, method, error):
    touching = SPRING * GAP**2 / 2
    own = {
        "masses": [MASS],
        "springs": [{"start": 0, "end": 1, "stiffness": SPRING}],
        "contacts": [{"host": 0, "resonator": 1, "clearance": GAP}],
    }
    nnm = {"system": "own", "own": own, "modes": [1], "method": method, "points": 60, "truncation": 1e-4}
    nnm |= {"energy": [0.0, 20 * touching], "start_energy": 0.9 * touching}
    contacts = {key: STOPS[key] for key in ("law", "parameters", "stiffness")}
    case = NnmCase.from_table({"plugins": plugins, "contacts": contacts, "nnm": nnm})
    (branch,) = follow_all(case, None, MPI.COMM_SELF)
    assert branch.points[-1].energy > 10 * touching
    for point in branch.points:
        assert point.period == pytest.approx(exact_period(point.energy), rel=error)
