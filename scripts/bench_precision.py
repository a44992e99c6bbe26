"""Work and precision: all solvers on one lattice, in turn, against a reference that an independent solver confirms."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping
from itertools import product
from typing import Any

import numpy as np
from bench_peers import Solver

from vipetsc.case import Case

# Solvers are compared at errors of at least this many times the distance between references: at smaller ones the bench
# would measure the references.
MARGIN = 5
# Errors at which solvers are compared, from what a picture shows to what a study of convergence needs.
ERRORS = (1e-5, 1e-6, 1e-7, 1e-8, 1e-9)


def lattice_case(overrides: Iterable[str] = ()) -> Case:
    """Return the case of all solvers, with ``overrides``: the four-band lattice, A = 30 N, conservative, to 0.3 s."""
    # Conservative, because the peers' laws are. It ends early after the first contacts: each further one multiplies
    # rounding errors, by which solvers would soon differ more than by their own errors.
    given = ("drive.amplitude=30.0", "contacts.restitution=1.0", "time.sample_interval=2e-4", "time.end=0.3")
    return Case.load(overrides=[*given, *overrides])


def at_tolerance(case: Case, rtol: float) -> Case:
    """Return a copy of ``case`` at the relative tolerance ``rtol``."""
    return case.model_copy(update={"time": case.time.model_copy(update={"rtol": rtol})})


def error(sampled: np.ndarray, exact: np.ndarray) -> float:
    """Return relative l2 error of all samples ``sampled`` (sample, mass)."""
    return float(np.linalg.norm(sampled - exact) / np.linalg.norm(exact))


def reference(solvers: Mapping[str, Solver], case: Case) -> tuple[np.ndarray, dict[str, Any]]:
    """Return velocities by ``ts`` at the tolerance 1e-13, and the distances from them of other tight solutions."""
    # The reference is by ts, whose error falls with the tolerance down to rounding errors. The propagator takes other
    # steps, and is compared with the reference as the peers are.
    exact = solvers["vipetsc ts"](at_tolerance(case, 1e-13)).velocity
    tight = {"vipetsc ts": 3e-14}
    # A solver by others confirms the reference: odeint, or SciPy's where that was not built.
    if "odeint dopri5" in solvers:
        tight["odeint dopri5"] = 1e-14
    else:
        tight["DOP853 numba"] = 3e-14
    apart = {}
    for name, rtol in tight.items():
        apart[f"{name} at {rtol:g}"] = error(solvers[name](at_tolerance(case, rtol)).velocity, exact)
    return exact, {"solver": "vipetsc ts at 1e-13", "separation": apart, "end": case.time.end}


def work_precision(solvers: Mapping[str, Solver], case: Case, tolerances: Iterable[float], rounds: int) -> dict:
    """Solve ``case`` by all ``solvers`` at all ``tolerances``; returns tables of ``latest.json``.

    ``rows`` are solver, rtol, error and CPU ``seconds``, the median over the rounds; ``ratios`` are those of CPU times
    at equal error, with their ``spread`` over the rounds; ``reference`` says how exact the reference is. Every round
    runs each solver at each tolerance once, in turn.
    """
    exact, about = reference(solvers, case)
    # The first call of an engine loads what is compiled.
    solvers["vipetsc propagator"](case)
    rows: dict[tuple[str, float], dict] = {}
    for _ in range(rounds):
        for rtol in tolerances:
            # All solvers at one tolerance before the next tolerance: what disturbs the machine for a minute then
            # disturbs all of them.
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
    # The reference is no more exact than the largest distance says.
    about["floor"] = MARGIN * max(about["separation"].values())
    ratios, spread = equal_error_ratios(table, [e for e in ERRORS if e >= about["floor"]])
    return {"reference": about, "rows": table, "ratios": ratios, "spread": spread}


def at_equal_error(points: Iterable[tuple[float, float]], wanted: float, bound: bool = False) -> float | None:
    """Return CPU seconds of a solver at the error ``wanted``, interpolated in logarithms between its ``points``.

    Points (error, seconds) that another one beats in both are left out, which favours a solver whose error falls
    unevenly. Returns None if ``wanted`` is outside the range of the points; with ``bound``, an error larger than all of
    theirs has the time of the largest, which is a bound from above.
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
    """Return CPU times of all other solvers over that of each engine of this package, at the errors ``wanted``.

    Returns medians over the rounds, and their smallest and largest values, by names "solver / engine at error".
    """
    names = list(dict.fromkeys(row["solver"] for row in rows))
    # A row with fewer times failed in some round, and is left out below.
    rounds = max(len(row["all"]) for row in rows)

    def seconds(name: str, turn: int, wanted_error: float) -> float | None:
        # A row whose error is zero is the reference itself.
        complete = [row for row in rows if row["solver"] == name and len(row["all"]) == rounds and row["error"] > 0]
        points = [(row["error"], row["all"][turn]) for row in complete]
        # A bound from above is unfavourable to its solver: it is allowed for engines of this package, not for peers.
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
