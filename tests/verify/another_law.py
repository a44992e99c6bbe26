"""Comparisons for ``test_another_law`` of hardening stops in every part of the package with formulas of their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from vipetsc import Case, simulate
from vipetsc.cli.main import main
from vipetsc.contact.law import (
    create_contacts,
    elastic_energy,
    elastic_force,
    elastic_force_and_slope,
    elastic_records,
    impact_time,
)
from vipetsc.io.store import RunMemory
from vipetsc.lattice import Contact
from vipetsc.plugins import load

K = 2e5
B = 4e5
D = 1e-3


def force(x, k=K, b=B):
    """The force F = k x (1 + b x^2) in N at an indentation ``x`` in m."""
    return k * x * (1 + b * x**2)


def slope(x):
    """The stiffness dF/dx = k (1 + 3 b x^2) in N/m at an indentation ``x`` in m."""
    return K * (1 + 3 * B * x**2)


def energy(x):
    """The elastic energy k x^2/2 + k b x^4/4 in J, which is the integral of the force from 0 to ``x``."""
    return K * x**2 / 2 + K * B * x**4 / 4


def relative(a, b):
    """The largest absolute difference of ``a`` and ``b``, divided by the largest absolute value of ``b``."""
    return float(np.abs(np.subtract(a, b)).max() / np.abs(b).max())


def turning(t, y):
    """The velocity, which is zero where a mass in contact turns round: an event of ``solve_ivp``."""
    return y[1]


turning.terminal = True


def twins() -> dict:
    """Errors of the law on arrays and of its compiled twin, and those of the duration of an impact, as fractions."""
    law = Contact("hardening", K, parameters=(B,))
    x = np.linspace(1e-4, 2e-3, 7)
    on_arrays = [law.elastic_force(x), law.elastic_slope(x), law.elastic_energy(x)]

    (record,) = elastic_records([law])
    compiled = []
    for indentation in x:
        push, stiffness = elastic_force_and_slope(record, indentation)
        compiled.append([push, stiffness, elastic_energy(record, indentation), elastic_force(record, indentation)])

    expected = [force(x), slope(x), energy(x)]
    differences = [relative(ours, formula) for ours, formula in zip(on_arrays, expected, strict=True)]
    differences.append(relative(np.transpose(compiled), [*expected, force(x)]))

    # An impact without loss takes twice the time to its turning point.
    mass = 0.01
    speed = 2.0
    approach = solve_ivp(
        lambda t, y: [y[1], -force(y[0]) / mass], (0, 1), [0.0, speed], rtol=1e-11, atol=1e-14, events=turning
    )
    site = create_contacts(law, [D], mass)[0]
    durations = [law.impact_time(speed, mass), impact_time(site, speed)]
    return {"twins": max(differences), "duration": relative(durations, [2 * approach.t[-1]] * 2)}


PLUGINS = {"modules": ["stops.py"]}
LATTICE = {"preset": "four-band", "cells": 12}
STOPS = {"law": "hardening", "parameters": {"b": B}, "stiffness": K, "sites": [4, 6], "clearance": D}


def stopped_run(engine: str, contacts: dict) -> tuple[np.ndarray, dict]:
    """Velocities (time, cell, dof) in m/s and the statistics of a short run of a lattice with two contact sites."""
    table = {
        "plugins": PLUGINS,
        "lattice": LATTICE,
        "contacts": contacts | {"restitution": 0.6},
        "drive": {"amplitude": 300.0, "cycles": 5, "cell": 5},
        "time": {"end": 0.03, "engine": engine, "rtol": 1e-10},
    }
    memory = RunMemory()
    result = simulate(Case.from_table(table), memory)
    return memory.dataset["velocity"].values, result.statistics


def engines() -> dict:
    """Differences between runs by the two engines and with linear stops, the numbers of episodes, and ledger errors."""
    linear_stops = STOPS | {"law": "bilinear"}
    del linear_stops["parameters"]
    stepped, by_ts = stopped_run("ts", STOPS)
    exact, by_propagator = stopped_run("propagator", STOPS)
    linear, _ = stopped_run("propagator", linear_stops)
    return {
        "engines": relative(stepped, exact),
        "hardens": relative(linear, exact),
        "episodes": [by_ts["episodes"], by_propagator["episodes"]],
        "ledgers": [by_ts["ledger_error"], by_propagator["ledger_error"]],
    }


# One mass on a spring to ground, between two stops.
MASS = 1.3
SPRING = 4e4


def period(total: float) -> float:
    """The period in s of a mass on a spring between two stops at a ``total`` energy in J.

    It is four times the time from the middle to the farthest point, the integral of dx / sqrt(2 (E - V(x)) / m).
    """

    def potential(x):
        return SPRING * x**2 / 2 + energy(max(x - D, 0.0))

    farthest = brentq(lambda x: potential(x) - total, 0, 1, xtol=1e-16)

    # The substitution x = farthest sin(s) removes the singularity at the farthest point. The integrand dt/ds is then
    # smooth on either side of the stop.
    def slowness(s):
        x = farthest * np.sin(s)
        return farthest * np.cos(s) / np.sqrt(2 * (total - potential(x)) / MASS)

    touching = np.arcsin(min(D / farthest, 1.0))
    nodes, weights = np.polynomial.legendre.leggauss(60)
    quarter = 0.0
    for low, high in ((0.0, touching), (touching, np.pi / 2)):
        if low == high:
            continue
        phases = 0.5 * (low + high) + 0.5 * (high - low) * nodes
        quarter += 0.5 * (high - low) * sum(w * slowness(s) for s, w in zip(phases, weights, strict=True))
    return 4 * quarter


def normal_modes() -> dict:
    """Errors of the periods along a branch against the energy integral, and how far the branch reaches, by method."""
    touching = SPRING * D**2 / 2
    highest = 20 * touching
    case = f"""
[plugins]
modules = ["stops.py"]

[contacts]
law = "hardening"
parameters = {{ b = {B} }}
stiffness = {K}

[nnm]
system = "own"
modes = [1]
method = "METHOD"
energy = [0.0, {highest}]
start_energy = {0.9 * touching}
points = 60
truncation = 1e-4

[output]
figures = false

[nnm.own]
masses = [{MASS}]
springs = [{{ start = 0, end = 1, stiffness = {SPRING} }}]
contacts = [{{ host = 0, resonator = 1, clearance = {D} }}]
"""
    found: dict = {"periods": {}, "reached": {}}
    for method in ("shooting", "balance"):
        Path(f"{method}.toml").write_text(case.replace("METHOD", method))
        assert main(["nnm", f"{method}.toml", "--out", method, "--force"], {}) == 0
        (path,) = Path(method).glob("branch-*.csv")
        table = np.genfromtxt(path, delimiter=",", names=True, comments=None)
        expected = np.array([period(total) for total in table["energy"]])
        found["periods"][method] = relative(1 / table["frequency"], expected)
        found["reached"][method] = float(table["energy"].max() / highest)
    return found


def compare() -> dict:
    """The results of all comparisons by name; the current folder must contain the module ``stops.py``."""
    load(str(Path("stops.py").resolve()))
    return twins() | engines() | normal_modes()
