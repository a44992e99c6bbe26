"""Checks of identification: recovery without noise, derivatives of motions, and errors over the length of a record.

    python scripts/identify_checks.py exact
    python scripts/identify_checks.py derivatives [--out PICTURE]
    python scripts/identify_checks.py length [--seeds 8]

``exact`` identifies five clearances, stiffness and restitution of a four-band lattice from three velocities without
noise, with starts 30 % off, and prints the errors. ``derivatives`` compares derivatives of the motion by a clearance
with differences of fourth order, and with them predicts the motion after a change of 0.1 %; it prints and draws the
errors over the number of impacts. ``length`` identifies two parameters of a chain that is shaken steadily and meets a
stop in every period, and prints standard errors and actual errors for records of 0.5 to 4 s with 2 % noise.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

# The tests' modules for records and tables are not installed with the package.
sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.conftest import run_of
from tests.identified import identify_table, lattice_table, measured_table
from vipetsc.case import Case
from vipetsc.case.identify import IdentifyCase
from vipetsc.figures import style
from vipetsc.identification.uncertainty import uncertainty_of
from vipetsc.parallel import StopRequest
from vipetsc.studies.identification import Identification, read_measured_records

EXAMPLE = Path(__file__).parents[1] / "vipetsc" / "examples" / "identify.toml"
PICTURE = Path(__file__).parents[1] / "vipetsc" / "manual" / "pictures" / "identify-derivatives.png"
STIFFNESS = 5.18e6
CLEARANCES = (1.32e-3, 1.20e-3, 1.08e-3, 0.96e-3, 0.90e-3)


def work_of(table: dict[str, Any]) -> Identification:
    """Return the identification of the case ``table``, ready for its fits."""
    plan = IdentifyCase.from_table(table)
    return Identification(plan, read_measured_records(plan), StopRequest())


def computed_record(table: dict[str, Any], folder: Path, noise: float = 0.0, seed: int = 1) -> dict[str, Any]:
    """Simulate ``table``, and write the velocities of its points to a file in ``folder``; the table of this record.

    ``noise`` is relative to the root mean square of each sensor's record, ``seed`` that of its random numbers.
    """
    run = run_of(Case.from_table(table))
    values = run["points/velocity"].values
    sizes = np.sqrt(np.mean(values**2, axis=0))
    values = values + noise * sizes * np.random.default_rng(seed).standard_normal(values.shape)
    path = folder / f"{table['name']}-{seed}.csv"
    # With 17 digits doubles are read as they were, so that without noise the record has no error of its own.
    np.savetxt(path, np.column_stack([run["time"].values, values]), delimiter=",", fmt="%.17g")
    sensors = [
        {"quantity": "velocity", "column": column, "cell": point["cell"], "mass": point.get("mass", 1)}
        for column, point in enumerate(table["output"]["points"], 2)
    ]
    return {"file": str(path), "time": 1, "sensors": sensors}


def exact(folder: Path) -> None:
    """Print the errors of seven parameters that are identified without noise; the record is written to ``folder``."""
    example = tomllib.loads(EXAMPLE.read_text())
    points = [
        {"name": sensor["column"].split()[0], "cell": sensor["cell"], "mass": sensor["mass"]}
        for sensor in example["identify"]["records"][0]["sensors"]
    ]
    contacts = example["contacts"] | {"clearance": list(CLEARANCES), "stiffness": STIFFNESS, "restitution": 0.7}
    # At a tolerance far below the default, the record's own error does not limit how well parameters are found.
    time = {"end": 0.04, "sample_interval": 2.5e-4, "engine": "propagator", "rtol": 1e-12}
    table = {key: example[key] for key in ("lattice", "drive")}
    table |= {"name": "truth", "contacts": contacts, "time": time, "output": {"points": points}}

    # Starts are alternately too large and too small: a common factor would be an easier start.
    factors = np.array([1.3, 0.7, 1.3, 0.7, 1.3])
    unknowns = [
        {"quantity": "clearance", "of": "each", "bounds": [3e-4, 5e-3], "start": (factors * CLEARANCES).tolist()},
        {"quantity": "stiffness", "bounds": [5e5, 5e7], "start": 0.7 * STIFFNESS},
        {"quantity": "restitution", "bounds": [0.3, 1.0], "start": 0.91},
    ]
    work = work_of(identify_table(table, computed_record(table, folder), unknowns=unknowns))
    record = work.fit(0)
    windows, z = work.solution(record)
    truth = [*CLEARANCES, STIFFNESS, 0.7]
    print(f"{len(record['windows'])} windows, {record['windows'][-1]['impacts']} impacts in the last")
    for parameter, value, true in zip(work.plan.parameters, windows.misfit.values(z), truth, strict=True):
        print(f"{parameter.name:<12} {value:.10g}  relative error {abs(value / true - 1):.1e}")


def derivatives(folder: Path, picture: Path) -> None:
    """Print the errors of derivatives by a clearance over the number of impacts, with loss and without, and draw them.

    The figure is written to ``picture``.
    """
    figure, axes = plt.subplots(1, 2, figsize=(7.6, 3.2), layout="constrained", sharex=True, sharey=True)
    for panel, restitution in zip(axes, (0.7, 1.0), strict=True):
        rows = derivative_errors(folder, restitution)
        print(f"restitution {restitution}\nimpacts  largest derivative  against differences  a change of 0.1 % misses")
        for row in rows:
            print("{:7d}  {:18.3g}  {:19.1e}  {:24.2g}".format(*row))

        impacts, largest, by_differences, missed = np.array(rows).T
        panel.loglog(
            impacts, by_differences, "o-", color=style.BLUE, ms=3, lw=0.8, label="derivative against differences"
        )
        panel.loglog(
            impacts, missed, "s-", color=style.VERMILION, ms=3, lw=0.8, label="prediction of a change of 0.1 %"
        )
        panel.loglog(impacts, largest, "-", color=style.GREY, lw=0.8, label="largest derivative (m/s)")
        panel.axhline(1.0, color=style.BLACK, lw=0.6)
        panel.set(xlabel="impacts in the window", title=f"restitution {restitution}")
    axes[0].set(ylabel="relative error")
    axes[0].legend(fontsize=7)
    figure.savefig(picture, dpi=100)


def derivative_errors(folder: Path, restitution: float) -> list[tuple[int, float, float, float]]:
    """Return errors of derivatives by a clearance in windows of more and more impacts; a row for each.

    A row has the number of impacts, the largest derivative by the logarithm of the clearance in m/s, its largest
    relative error, and the relative error of the change that it predicts for 0.1 %.
    """
    # The differences below, over h = 1e-5, lose five digits: of runs to 1e-13 they keep eight.
    table = lattice_table(time={"end": 0.06, "rtol": 1e-13}, contacts={"restitution": restitution})
    unknowns = [{"quantity": "clearance", "of": [[1]], "bounds": [1e-4, 2e-3], "start": 5e-4}]
    work = work_of(identify_table(table, measured_table(folder, table), unknowns=unknowns))
    misfit = work.windows().misfit
    z = work.starts()[0]
    onsets = np.sort(misfit.motion(z, 0, 1.0).onset)
    slopes = misfit.jacobian(z, [1.0], [0]).reshape(-1, len(misfit.noise[0])) * misfit.noise[0]

    def moved(step: float) -> np.ndarray:
        """Return the velocities of a run whose clearance is exp(``step``) times as large."""
        case = work.plan.case_of([work.plan.parameters[0].from_coordinate(z[0] + step)])
        return np.asarray(run_of(case)["points/velocity"].values)

    # Central differences of fourth order. At this step neither part of their error, h^4 of the formula and 1e-13/h of
    # the runs, is above 1e-8.
    h = 1e-5
    differences = np.zeros_like(slopes)
    for steps, weight in ((-2, 1), (-1, -8), (1, 8), (2, -1)):
        differences += weight * moved(steps * h) / (12 * h)
    change = moved(1e-3) - moved(0.0)

    rows = []
    times = misfit.records[0].times
    # Windows are spaced evenly in the logarithm of the number of impacts, of which derivatives grow as powers or
    # exponentials.
    for impacts in np.unique(np.geomspace(1, len(onsets) - 1, 16).astype(int)):
        # The window ends where the next impact begins, and has the number of impacts that is printed.
        window = times < onsets[impacts]
        largest = float(np.abs(slopes[window]).max())
        # Before the first contact with this clearance nothing depends on it, and there is no relative error.
        if not largest:
            continue
        error = float(np.abs(slopes - differences)[window].max()) / largest
        missed = float(np.abs(1e-3 * slopes - change)[window].max() / np.abs(change)[window].max())
        rows.append((int(impacts), largest, error, missed))
    return rows


def length(folder: Path, seeds: int) -> None:
    """Print standard errors and actual errors over the length of a record, from so many ``seeds`` of its noise."""
    spring = {"start": 1, "end": 1, "stiffness": 4e4, "next_cell": True}
    table = {
        "name": "shaken",
        "lattice": {"cells": 4, "cell": {"masses": [0.25], "grounding": [5.0], "springs": [spring], "contact": [1, 1]}},
        "contacts": {
            "stiffness": 5e7,
            "restitution": 0.7,
            "sites": [3],
            "pair": [0, 1],
            "side": "plus",
            "clearance": 4e-4,
        },
        "drive": {"waveform": "harmonic", "amplitude": 12.0, "frequency": 230.0},
        "output": {"points": [{"name": "a", "cell": 1}, {"name": "b", "cell": 3}]},
    }
    unknowns = [
        {"quantity": "clearance", "bounds": [1e-4, 2e-3], "start": 4.2e-4},
        {"quantity": "restitution", "bounds": [0.2, 1.0], "start": 0.75},
    ]
    truth = np.array([4e-4, 0.7])
    print("length  impacts  standard errors                actual errors")
    for duration in (0.5, 1.0, 2.0, 4.0):
        # The first second, in which the drive rises, is left out: it determines the parameters better than a second of
        # the steady state does.
        end = 1.0 + duration
        timed = table | {"time": {"end": end, "sample_interval": 2e-3, "engine": "propagator", "rtol": 1e-12}}
        found = []
        for seed in range(1, seeds + 1):
            record = computed_record(timed, folder, noise=0.02, seed=seed) | {"begin": 1.0}
            work = work_of(identify_table(timed, record, unknowns=unknowns))
            fit = work.fit(0)
            windows, z = work.solution(fit)
            found.append(windows.misfit.values(z) / truth - 1)
        uncertainty = uncertainty_of(windows.misfit.jacobian(z, windows.last, range(2)))
        stated = uncertainty.errors * [p.slope(x) for p, x in zip(work.plan.parameters, z, strict=True)] / truth
        actual = np.sqrt(np.mean(np.square(found), axis=0))
        print(
            f"{duration:5.1f} s {fit['windows'][-1]['impacts']:8d}  {100 * stated[0]:.4f} % {100 * stated[1]:.4f} %"
            f"              {100 * actual[0]:.4f} % {100 * actual[1]:.4f} %",
            flush=True,
        )


def main() -> None:
    """Make the check that the first argument names."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=["exact", "derivatives", "length"])
    parser.add_argument("--out", type=Path, default=PICTURE)
    parser.add_argument("--seeds", type=int, default=8)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if options.what == "exact":
            exact(Path(folder))
        elif options.what == "derivatives":
            derivatives(Path(folder), options.out)
        else:
            length(Path(folder), options.seeds)


if __name__ == "__main__":
    main()
