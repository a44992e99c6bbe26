"""Counts how often the intervals that an identification states contain the true values, for several sizes of noise.

    python scripts/identify_coverage.py [--noise 0.01 0.02 0.05] [--seeds 50] [--end 0.014]

Records of a four-band lattice with three sites and three sensors, which end at ``--end`` in s, are computed by the
propagator. They get normal noise of the relative size ``--noise``. Three clearances and the restitution are fitted from
starts about 30 % off. For each noise the script prints the fraction of the 90 % intervals that contain the true value,
and the root mean square of the errors: relative ones of clearances, that of the restitution over the range between its
bounds.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

# The tests' modules for records and tables are not installed with the package.
sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.identified import identify_table, lattice_table, measured_table
from vipetsc.case.identify import IdentifyCase
from vipetsc.identification.uncertainty import quantile, uncertainty_of
from vipetsc.parallel import StopRequest
from vipetsc.studies.identification import Identification, read_measured_records


def main() -> None:
    """Print a row for each noise."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--noise", type=float, nargs="+", default=[0.01, 0.02, 0.05])
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--end", type=float, default=0.014)
    options = parser.parse_args()
    table = lattice_table(time={"end": options.end})
    with tempfile.TemporaryDirectory() as folder:
        for noise in options.noise:
            print(row(table, noise, options.seeds, Path(folder)), flush=True)


def row(table: dict, noise: float, seeds: int, folder: Path) -> str:
    """Identify the records of ``table`` with one ``noise`` and so many ``seeds``; returns a line of the output."""
    truth = [*table["contacts"]["clearance"], table["contacts"]["restitution"]]

    inside = []
    errors = []
    # Each seed gives a record of the same lattice with other noise.
    for seed in range(seeds):
        plan = IdentifyCase.from_table(identify_table(table, measured_table(folder, table, noise=noise, seed=seed)))
        work = Identification(plan, read_measured_records(plan), StopRequest())
        windows, z = work.solution(work.fit(0))
        uncertainty = uncertainty_of(windows.misfit.jacobian(z, windows.last, range(len(z))))
        # Intervals are symmetric in the coordinates of the fit, which are logarithms of positive quantities.
        expected = [p.to_coordinate(value) for p, value in zip(plan.parameters, truth, strict=True)]
        inside.append(np.abs(z - expected) < quantile(0.9, windows.noise_freedom(z)) * uncertainty.errors)
        errors.append(z - expected)
    size = 100 * np.sqrt(np.mean(np.square(errors), axis=0))
    each = " ".join(f"{100 * value:.0f}" for value in np.mean(inside, axis=0))
    return (
        f"noise {100 * noise:g} %, {seeds} seeds: {100 * np.mean(inside):.1f} % of the 90 % intervals hold the truth"
        f" (each: {each}); errors {', '.join(f'{value:.3f} %' for value in size)}"
    )


if __name__ == "__main__":
    main()
