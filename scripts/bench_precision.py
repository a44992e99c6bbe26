"""Work and precision: all solvers on one lattice, in turn, against a reference that an independent one confirms."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping
from itertools import product
from typing import Any

import numpy as np
from bench_peers import Solver

from vipetsc.case import Case

# A ratio at an error below this many separations of the references would measure the references.
MARGIN = 5
# From what a picture shows to what a convergence study needs.
ERRORS = (1e-5, 1e-6, 1e-7, 1e-8, 1e-9)


def lattice_case(overrides: Iterable[str] = ()) -> Case:
    """The compared case: four-band, A = 30 N, conservative; it ends while solvers still agree after first contact."""
    # Conservative, because the peers' laws are; up to 0.3 s, since rounding grows by every contact in a chaotic
    # motion.
    given = ("drive.amplitude=30.0", "contacts.restitution=1.0", "time.sample_interval=2e-4", "time.end=0.3")
    return Case.load(overrides=[*given, *overrides])


def at_tolerance(case: Case, rtol: float) -> Case:
    """A copy of ``case`` at the relative tolerance ``rtol``."""
    return case.model_copy(update={"time": case.time.model_copy(update={"rtol": rtol})})


def error(sampled: np.ndarray, exact: np.ndarray) -> float:
    """Relative l2 error of all samples."""
    return float(np.linalg.norm(sampled - exact) / np.linalg.norm(exact))


def reference(solvers: Mapping[str, Solver], case: Case) -> tuple[np.ndarray, dict[str, Any]]:
    """Velocities by our ``ts`` at 1e-13, and how far others at the edge of double precision lie from them."""
    # By ts, whose error falls with the tolerance down to rounding; the propagator shares no step with it.
    exact = solvers["vipetsc ts"](at_tolerance(case, 1e-13)).velocity
    tight = {"vipetsc ts": 3e-14}
    # A solver by others confirms the reference; where none was built, one of SciPy's does.
    if "odeint dopri5" in solvers:
        tight["odeint dopri5"] = 1e-14
    else:
        tight["DOP853 numba"] = 3e-14
    apart = {}
    for name, rtol in tight.items():
        apart[f"{name} at {rtol:g}"] = error(solvers[name](at_tolerance(case, rtol)).velocity, exact)
    return exact, {"solver": "vipetsc ts at 1e-13", "separation": apart, "end": case.time.end}


def work_precision(solvers: Mapping[str, Solver], case: Case, tolerances: Iterable[float], rounds: int) -> dict:
    """Rows (solver, rtol, error, seconds), ratios of CPU time at equal error, and what the reference is worth.

    Every round runs each solver at each tolerance once, in turn. ``seconds`` is the median over rounds.
    """
    exact, about = reference(solvers, case)
    # The first call of an engine loads what is compiled.
    solvers["vipetsc propagator"](case)
    rows: dict[tuple[str, float], dict] = {}
    for _ in range(rounds):
        for rtol in tolerances:
            # The solvers are inside the loop over tolerances: what disturbs the machine for a minute disturbs all of
            # them.
            for name, solver in solvers.items():
                row = rows.setdefault((name, rtol), {"solver": name, "rtol": rtol, "error": None, "all": []})
                try:
                    found = solver(at_tolerance(case, rtol))
                # A solver may fail at the loosest tolerance and be compared at the others.
                except RuntimeError as failure:
                    row["failure"] = str(failure)
                    continue
                row["error"] = error(found.velocity, exact)
                row["all"].append(found.seconds)

    for row in rows.values():
        row["seconds"] = statistics.median(row["all"]) if row["all"] else None
    # Sorted by tolerance, so that the points of a solver join to a curve.
    table = sorted(rows.values(), key=lambda row: (list(solvers).index(row["solver"]), -row["rtol"]))
    # Of all separations the largest: the reference is worth no more than the worst agreement.
    about["floor"] = MARGIN * max(about["separation"].values())
    ratios, spread = equal_error_ratios(table, [e for e in ERRORS if e >= about["floor"]])
    return {"reference": about, "rows": table, "ratios": ratios, "spread": spread}


def at_equal_error(points: Iterable[tuple[float, float]], wanted: float, bound: bool = False) -> float | None:
    """CPU seconds at the error ``wanted`` from ``points`` (error, seconds), interpolated in logarithms.

    Points that another one beats in both are left out, which favours a solver whose error falls unevenly. None where
    the points do not reach; with ``bound``, an error larger than all of them costs no more than the largest one.
    """
    front: list[tuple[float, float]] = []
    for e, s in sorted(points):
        # From the smallest error on, a point must cost less than the one before to stay.
        if not front or s < front[-1][1]:
            front.append((e, s))
    if not front or wanted < front[0][0] or (wanted > front[-1][0] and not bound):
        return None
    errors, seconds = np.log(np.array(front)).T
    return float(np.exp(np.interp(np.log(wanted), errors, seconds)))


def equal_error_ratios(rows: list[dict], wanted: list[float]) -> tuple[dict[str, float], dict[str, list[float]]]:
    """CPU time of each peer over that of each engine of ours, by name; median and extremes over the rounds."""
    names = list(dict.fromkeys(row["solver"] for row in rows))
    # A row with fewer failed in some round, and has no ratio for it.
    rounds = max(len(row["all"]) for row in rows)

    def seconds(name: str, turn: int, wanted_error: float) -> float | None:
        # An error of zero is the reference itself.
        complete = [row for row in rows if row["solver"] == name and len(row["all"]) == rounds and row["error"] > 0]
        points = [(row["error"], row["all"][turn]) for row in complete]
        # A bound counts against the solver to which it is applied: ours may have one, a peer may not.
        return at_equal_error(points, wanted_error, bound=name.startswith("vipetsc"))

    ratios = {}
    spread = {}
    engines = [name for name in names if name.startswith("vipetsc")]
    pairs = [(engine, peer) for engine in engines for peer in names if peer != engine]
    for (engine, peer), wanted_error in product(pairs, wanted):
        found = []
        for turn in range(rounds):
            theirs = seconds(peer, turn, wanted_error)
            ours = seconds(engine, turn, wanted_error)
            if theirs and ours:
                found.append(theirs / ours)
        if found:
            name = f"{peer} / {engine} at {wanted_error:g}"
            ratios[name] = statistics.median(found)
            spread[name] = [min(found), max(found)]
    return ratios, spread
