"""Searches by frequency responses: an absorber whose best values have a closed form, and the files of a search."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import datasets, with_sections
from vipetsc.case import Case
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.optimise import ObjectiveTable, OptimiseCase
from vipetsc.endings import Ending
from vipetsc.io.netcdf import open_netcdf
from vipetsc.modes.branches.follow import follow_all
from vipetsc.parallel import StopRequest
from vipetsc.spectra.responses import CurvePart, largest_response
from vipetsc.studies import objective
from vipetsc.studies.objective import measured_responses
from vipetsc.studies.optimum_search import run_search

PEAK = "response/peak_displacement/mass"
RATIO = 0.05  # the absorber's mass over the main mass of 1 kg, whose springs have 1 N/m in total
BOUNDS = {"stiffness": {"log": [0.02, 0.1]}, "damping": {"log": [2e-3, 5e-2]}}
TABLE: dict[str, Any] = {
    "name": "absorber",
    "lattice": {
        "cells": 1,
        "cell": {
            "masses": [1.0, RATIO],
            "springs": [
                {"start": 1, "end": 1, "stiffness": 0.5, "next_cell": True},
                {"start": 1, "end": 2, "stiffness": 0.06, "damping": 0.01},
            ],
        },
    },
    # The motion never reaches the stop: the responses are those of a linear system, in closed form below.
    "contacts": {"law": "bilinear", "stiffness": 20.0, "sites": [1], "pair": [0, 1], "clearance": 40.0},
    "drive": {"waveform": "harmonic", "amplitude": 1.0, "frequency": 1.0},
    "time": {"end": 10.0},
    "output": {"points": [{"name": "mass", "cell": 1}]},
    # One harmonic is exact for a linear motion.
    "nfrc": {"source": "force", "over": "frequency", "range": [0.75, 1.2], "fixed": [1.0], "harmonics": 1},
    "optimise": {
        "budget": 5,
        "population": 4,
        "variables": {"lattice": {"cell": {"springs[2]": BOUNDS}}},
        "objective": [{"measure": PEAK, "goal": "minimise"}],
    },
}


def displacement(frequency: np.ndarray, stiffness: float, damping: float) -> np.ndarray:
    """The amplitude (frequency,) in m of the main mass under 1 N, from the equations of motion of mass and absorber."""
    joined = stiffness + 1j * frequency * damping
    absorber = joined - RATIO * frequency**2
    return np.abs(absorber / ((1 - frequency**2 + joined) * absorber - joined**2))


def absorber(stiffness: float, damping: float, **nfrc: Any) -> NfrcCase:
    """The case of responses with an absorber of a ``stiffness`` in N/m and a ``damping`` in N s/m."""
    plan = OptimiseCase.from_table(with_sections(TABLE, {"nfrc": nfrc}))
    return plan.responses(plan.design(np.array([stiffness, damping])))


def measured(case: NfrcCase, **table: Any) -> list[float]:
    """The values of an objective, one for each curve; ``table`` has further keys of the objective."""
    objective = ObjectiveTable.model_validate({"measure": PEAK} | table)
    return measured_responses(case, [objective], MPI.COMM_SELF, StopRequest())["values"][objective.name]


def test_the_peak_is_least_at_the_absorber_of_den_hartog():
    """Den Hartog's absorber has the peak (1 + 2/mu)^(1/2), and other stiffnesses and dampings have larger peaks.

    Its frequency is 1/(1 + mu), its damping ratio (3 mu/(8 (1 + mu)^3))^(1/2).
    """
    frequency = 1 / (1 + RATIO)
    # The damping ratio is the dashpot over twice the absorber's mass times the main mass's frequency, here 1 rad/s.
    damping = 2 * RATIO * np.sqrt(3 * RATIO / (8 * (1 + RATIO) ** 3))
    (least,) = measured(absorber(RATIO * frequency**2, damping))
    # The damping equalises the two peaks only to first order in the mass ratio.
    assert least == pytest.approx(np.sqrt(1 + 2 / RATIO), rel=2e-3)

    # The peak depends less on the damping than on the frequency, so that the damping is changed by more.
    for factor in (0.94, 1.06):
        assert measured(absorber(factor * RATIO * frequency**2, damping))[0] > 1.02 * least
        assert measured(absorber(RATIO * frequency**2, factor**3 * damping))[0] > 1.005 * least


def test_peaks_and_gaps_are_those_of_the_equations_of_motion():
    """Peaks over the range and over a part of it, and widths below a level, are those of the exact response."""
    case = absorber(0.045, 0.01, fixed=[1.0, 2.0], largest_step=0.05)
    # The grid is far finer than the curve's points, so that only interpolation between those needs a tolerance.
    grid = np.linspace(0.75, 1.2, 200_001)
    exact = displacement(grid, 0.045, 0.01)
    assert measured(case) == pytest.approx([exact.max(), 2 * exact.max()], rel=1e-4)
    inside = (grid >= 0.95) & (grid <= 1.02)
    assert measured(case, part=[0.95, 1.02])[0] == pytest.approx(exact[inside].max(), rel=2e-3)

    for level in (4.0, 6.5):
        # Intervals begin and end where the exact curve crosses the level, or at the ends of the range.
        below = np.append(np.flatnonzero(np.diff((exact < level).astype(int))), len(grid) - 1)
        edges = np.append(0, below)
        widths = [grid[b] - grid[a] for a, b in itertools.pairwise(edges) if exact[(a + b) // 2] < level]
        assert measured(case, below=level)[0] == pytest.approx(max(widths), rel=5e-3)


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    """The plan, the folder and the summary of a small search."""
    folder = tmp_path_factory.mktemp("search")
    # Curves of few points are enough, since the tests compare values of the same curves.
    plan = OptimiseCase.from_table(with_sections(TABLE, {"nfrc": {"largest_step": 0.3, "points": 200}}))
    return plan, folder, run_search(plan, folder, MPI.COMM_SELF).attrs["summary"]


def test_the_best_case_has_the_value_of_the_search(searched, tmp_path):
    """The verb nfrc, run on best.toml, gives the curve whose largest value the search has found, to the bit."""
    _, folder, summary = searched
    found = datasets(folder / "optimum.h5")
    best = int(found["comparison/number"][1])
    # The objective needs responses alone, so that there are no runs.
    assert "5 designs, 5 frequency responses; 0 designs failed" in summary
    # The titles of the table are divided by blanks, and each number ends where its title does.
    titles, *rows = summary.splitlines()[-3:]
    assert titles.split()[:3] == ["design", "number", "1:"]
    assert {len(row) for row in rows} == {len(titles)}
    assert found["value"][best, 0] == found["value"].min()

    follow_all(NfrcCase.load(folder / "best.toml"), tmp_path, MPI.COMM_SELF)
    (path,) = tmp_path.glob("branch-*.h5")
    with open_netcdf(path, "branch") as file:
        curve = file.load()
    steps = np.linalg.norm(np.diff(curve["xi"].values, axis=0), axis=1)
    values = curve["peak_displacement"].values[:, 0]
    length = np.append(0.0, np.cumsum(steps))
    whole = CurvePart(curve["frequency"].values, values, length, curve["kind"].values == 0)
    # The values are equal to the bit, since the case file must describe the design exactly.
    assert largest_response([whole], 0.75, 1.2) == found["value"][best, 0]

    # The file of the search has the same curve for its picture.
    points = found["response/of"] == list(found["response/compared"]).index(b"best")
    assert found["response/value"][points, 0].tolist() == values.tolist()
    assert found["response/parameter"][points].tolist() == curve["frequency"].values.tolist()
    assert Case.load(folder / "best.toml").lattice.cell.springs[1].damping == found["parameter"][best, 1]


def test_a_curve_that_ends_early_is_a_design_that_fails(tmp_path):
    """A design whose curve ends early fails, with the curve's ending as its reason; its runs are still measured."""
    # Four points reach only a part of the range.
    table = with_sections(TABLE, {"nfrc": {"points": 5}, "time": {"end": 20.0}})
    table["optimise"] |= {"budget": 2, "curve": [1.0]}
    table["optimise"]["constraint"] = [{"measure": "peak_displacement/mass", "at_most": 100.0}]
    summary = run_search(OptimiseCase.from_table(table), tmp_path, MPI.COMM_SELF).attrs["summary"]
    found = datasets(tmp_path / "optimum.h5")
    assert np.isnan(found["value"]).all()
    assert found["reason"][0].startswith(b"curve r1-1: 5 points reached: increase nfrc.points")
    assert "2 designs, 2 runs, 2 frequency responses; 2 designs failed" in summary
    assert np.isfinite(found["curve/dissipated"]).all()


def test_a_curve_that_turns_back_has_no_states_on_a_part_of_its_range(monkeypatch):
    """A design fails if its curve turns back to the beginning of the range, since a peak beyond would be missed."""
    case = absorber(0.05, 0.01, largest_step=0.3)
    [curve] = follow_all(case, None, MPI.COMM_SELF)
    # Linear motions for comparison are of use in files alone, and take longer than the curve.
    assert not [name for name in curve.extra if name.startswith("linear")]
    # A complete curve is taken there and back: turning back by itself would need impacts.
    ended = Ending.CLOSED.with_numbers()
    there_and_back = replace(curve, points=[*curve.points, *curve.points[::-1]], ended=ended)
    monkeypatch.setattr(objective, "follow_all", lambda *arguments, **options: [there_and_back])
    with pytest.raises(RuntimeError, match=r"r1-1: turned back and closed.*, without states up to 1\.2"):
        measured(case)
