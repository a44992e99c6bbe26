"""Searches: objectives against ledger, runs and responses in closed form."""

from __future__ import annotations

import itertools
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import datasets, search_table, simulated, small_case, with_sections
from vipetsc.case import Case
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.optimise import ObjectiveTable, OptimiseCase
from vipetsc.io.netcdf import open_netcdf
from vipetsc.lattice import gaps, pass_bands
from vipetsc.modes.branches.follow import follow_all
from vipetsc.parallel import StopRequest
from vipetsc.spectra.responses import CurvePart, largest_response
from vipetsc.studies import optimum_search
from vipetsc.studies.objective import measured, measured_responses
from vipetsc.studies.optimum_search import run_search

SEARCH = {"budget": 30, "curve": [12.0], "variables": {"clearance": [3e-5, 3e-3]}}
TABLE = search_table(
    24, [6, 12, 13], drive={"amplitude": 24.33, "cycles": 6}, time={"end": 0.08, "rtol": 1e-8}, optimise=SEARCH
)


def objective(measure: str, **more) -> ObjectiveTable:
    """An objective of a search by its ``measure`` and ``more`` keys."""
    return ObjectiveTable.model_validate({"measure": measure} | more)


def judged(case: Case, *objectives: ObjectiveTable):
    """The values by name that a search measures of a case for these objectives, and the dataset of the case's run."""
    run, result = simulated(case)
    return measured(run, result.statistics, objectives), run


def test_fractions_of_the_work_sum_to_one():
    """Fractions of the work sum to one: in bands, lost as the ledger says, in contacts, and in modes in gaps."""
    case = small_case(time={"end": 0.08, "engine": "auto", "rtol": 1e-9})
    bands = pass_bands(case.lattice.unit_cell())
    assert len(gaps(bands)) == 3
    middle = 0.5 * (bands[3].low + bands[3].high)
    lower_part = objective("band_share", band=4, part=[1.0, middle])
    upper_part = objective("band_share", band=4, part=[middle, 1e5])

    values, run = judged(case, objective("upper_share_at_end"), objective("band_share", band=4), lower_part, upper_part)

    work = float(run["energy/work"][-1])
    assert values["episodes"] > 10
    assert values["dissipated"] == pytest.approx(float(run["energy/dissipated"][-1]) / work)
    # The remaining energy is in contacts, and a little in modes of the ends, which lie in gaps.
    outside = 1 - sum(values["bands"]) - values["dissipated"]
    held = float(run["energy/contact"][-1]) / work
    assert 0 <= outside - held < 0.01

    assert values["band_share 4"] == pytest.approx(values["bands"][3], rel=1e-12)
    assert values["upper_share_at_end"] == pytest.approx(sum(values["bands"][2:]), rel=1e-12)
    assert values[lower_part.name] > 0
    assert values[upper_part.name] > 0
    assert values[lower_part.name] + values[upper_part.name] == pytest.approx(values["bands"][3], rel=1e-12)


FREE = {"drive": {"amplitude": 0.0}, "time": {"end": 0.03, "engine": "auto", "rtol": 1e-9}}
PACKET = {"kind": "packet", "band": 2, "wavenumber": "pi/2", "cell": 9, "width": 1, "amplitude": 1e-3}
STRUCK = {"kind": "velocity", "cell": 5, "velocity": -3.0, "more": [{"cell": 9, "mass": 3, "velocity": 1.5}]}


def free_table(initial: dict[str, Any], **sections) -> dict[str, Any]:
    """The table of the small lattice without a drive, which begins with the motion ``initial``."""
    table = small_case(**sections).model_dump(by_alias=True, exclude_none=True)
    return {key: table[key] for key in ("name", "lattice", "contacts")} | {"initial": initial} | FREE


def free_case(initial: dict[str, Any], **sections) -> Case:
    """The case of ``free_table``."""
    return Case.from_table(free_table(initial, **sections))


@pytest.mark.parametrize("initial", [PACKET, STRUCK], ids=["packet", "struck"])
def test_fractions_of_a_free_motion_are_of_its_energy_at_the_start(initial):
    """Fractions of an undriven motion are parts of its energy at t = 0: in bands, in contacts, or lost."""
    values, run = judged(free_case(initial))

    at_start = float(run["energy/kinetic"][0] + run["energy/spring"][0])
    assert values["episodes"] > 5
    assert values["dissipated"] == pytest.approx(float(run["energy/dissipated"][-1]) / at_start)
    outside = 1 - sum(values["bands"]) - values["dissipated"]
    assert abs(outside - float(run["energy/contact"][-1]) / at_start) < 0.01


# For a drive at the left end the cells after site 11 are beyond it; for one at the right end those before site 14 are.
@pytest.mark.parametrize(("driven", "site", "beyond"), [(1, 11, slice(11, None)), (24, 14, slice(None, 13))])
def test_what_is_beyond_the_last_site_is_what_came_through(driven, site, beyond):
    """The transmitted fraction is the energy beyond the last site over the work, for a wave from either end."""
    case = small_case(
        contacts={"sites": [site], "clearance": 1.0},
        drive={"cell": driven, "cycles": 2},
        time={"end": 0.045, "engine": "auto"},
    )
    values, run = judged(case, objective("transmitted"))
    assert values["episodes"] == 0

    chain = case.model().chain
    u = run["displacement"].values[-1].ravel()
    v = run["velocity"].values[-1].ravel()
    energy = 0.5 * (u * (chain.stiffness_matrix() @ u) + chain.masses() * v**2).reshape(24, 4)
    work = float(run["energy/work"][-1])
    assert energy.sum() / work == pytest.approx(1, rel=1e-6)
    assert values["transmitted"] == pytest.approx(energy[beyond].sum() / work, rel=1e-9)
    assert 0.3 < values["transmitted"] < 1


def test_a_search_finds_a_better_case_whose_run_has_its_value(tmp_path):
    plan = OptimiseCase.from_table(TABLE)
    optimum_search.run_search(plan, tmp_path)

    found = datasets(tmp_path / "optimum.h5")
    value = found["value"][:, 0]
    best = int(found["comparison/number"][1])
    assert len(value) == 30
    assert np.isfinite(value).all()
    assert best == np.argmax(value)
    assert value[best] > 2 * value[0]

    case = Case.load(tmp_path / "best.toml")
    assert case.name == "small-best"
    assert case.contacts.clearance == pytest.approx(found["parameter"][best], rel=1e-15)

    values, _ = judged(case)
    assert values["upper_share_at_end"] == pytest.approx(value[best], rel=1e-12)

    # At the amplitude of the search the curves pass through its values.
    searched = list(found["amplitude"]).index(24.33)
    assert found["curve/value"][1, searched, 0] == value[best]
    assert found["curve/value"][0, searched, 0] == value[0]
    assert found["upper_share_at_end"].tolist() == value.tolist()


def test_a_search_of_grains_has_no_bands():
    """Grains, which contacts alone join, have no bands: measures of bands are NaN, the largest force has a value."""
    contacts = {"sites": [1, 2, 3], "next_cell": True, "side": "minus", "clearance": 0.0, "stiffness": 1e3}
    case = Case.from_table(
        {
            "name": "grains",
            "lattice": {"cells": 4, "ends": "free", "cell": {"masses": [1.0]}},
            "contacts": contacts,
            "drive": {"amplitude": 1.5, "cycles": 1, "frequency": 3.0},
            "time": {"end": 3.0, "sample_interval": 0.05},
        }
    )
    force = objective("largest_force")
    values, run = judged(case, force, objective("band_share", band=1))
    assert values[force.name] == pytest.approx(float(run["impacts/force"].max()))
    assert np.isnan([values["upper_share_at_end"], values["band_share 1"], *values["bands"]]).all()
    assert 0 < values["transmitted"] < 1


PEAK = "response/peak_displacement/mass"
RATIO = 0.05  # the absorber's mass over the main mass of 1 kg, whose springs have 1 N/m in total
BOUNDS = {"stiffness": {"log": [0.02, 0.1]}, "damping": {"log": [2e-3, 5e-2]}}
ABSORBER_TABLE: dict[str, Any] = {
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
    plan = OptimiseCase.from_table(with_sections(ABSORBER_TABLE, {"nfrc": nfrc}))
    return plan.responses(plan.design(np.array([stiffness, damping])))


def measured_peak(case: NfrcCase, **table: Any) -> list[float]:
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
    (least,) = measured_peak(absorber(RATIO * frequency**2, damping))
    # The damping equalises the two peaks only to first order in the mass ratio.
    assert least == pytest.approx(np.sqrt(1 + 2 / RATIO), rel=2e-3)

    # The peak depends less on the damping than on the frequency, so that the damping is changed by more.
    for factor in (0.94, 1.06):
        assert measured_peak(absorber(factor * RATIO * frequency**2, damping))[0] > 1.02 * least
        assert measured_peak(absorber(RATIO * frequency**2, factor**3 * damping))[0] > 1.005 * least


def test_peaks_and_gaps_are_those_of_the_equations_of_motion():
    """Peaks over the range and over a part of it, and widths below a level, are those of the exact response."""
    case = absorber(0.045, 0.01, fixed=[1.0, 2.0], largest_step=0.05)
    # The grid is far finer than the curve's points, so that only interpolation between those needs a tolerance.
    grid = np.linspace(0.75, 1.2, 200_001)
    exact = displacement(grid, 0.045, 0.01)
    assert measured_peak(case) == pytest.approx([exact.max(), 2 * exact.max()], rel=1e-4)
    inside = (grid >= 0.95) & (grid <= 1.02)
    assert measured_peak(case, part=[0.95, 1.02])[0] == pytest.approx(exact[inside].max(), rel=2e-3)

    for level in (4.0, 6.5):
        # Intervals begin and end where the exact curve crosses the level, or at the ends of the range.
        below = np.append(np.flatnonzero(np.diff((exact < level).astype(int))), len(grid) - 1)
        edges = np.append(0, below)
        widths = [grid[b] - grid[a] for a, b in itertools.pairwise(edges) if exact[(a + b) // 2] < level]
        assert measured_peak(case, below=level)[0] == pytest.approx(max(widths), rel=5e-3)


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    """The plan, the folder and the summary of a small search."""
    folder = tmp_path_factory.mktemp("search")
    # Curves of few points are enough, since the tests compare values of the same curves.
    plan = OptimiseCase.from_table(with_sections(ABSORBER_TABLE, {"nfrc": {"largest_step": 0.3, "points": 200}}))
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
    table = with_sections(ABSORBER_TABLE, {"nfrc": {"points": 5}, "time": {"end": 20.0}})
    table["optimise"] |= {"budget": 2, "curve": [1.0]}
    table["optimise"]["constraint"] = [{"measure": "peak_displacement/mass", "at_most": 100.0}]
    summary = run_search(OptimiseCase.from_table(table), tmp_path, MPI.COMM_SELF).attrs["summary"]
    found = datasets(tmp_path / "optimum.h5")
    assert np.isnan(found["value"]).all()
    assert found["reason"][0].startswith(b"curve r1-1: 5 points reached: increase nfrc.points")
    assert "2 designs, 2 runs, 2 frequency responses; 2 designs failed" in summary
    assert np.isfinite(found["curve/dissipated"]).all()
