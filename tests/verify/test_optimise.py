"""Objectives of a search, compared with the energy ledger of a run and with a run of the best case."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.conftest import datasets, search_table, simulated, small_case
from vipetsc.case import Case
from vipetsc.case.amplitude import amplitude_changes, amplitude_of
from vipetsc.case.optimise import ObjectiveTable, OptimiseCase
from vipetsc.lattice import gaps, pass_bands
from vipetsc.studies import optimum_search
from vipetsc.studies.objective import measured

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


@pytest.mark.parametrize("initial", [PACKET, STRUCK], ids=["packet", "struck"])
def test_the_amplitude_of_a_free_motion_multiplies_the_whole_motion(initial):
    """Without contacts, half the amplitude of a motion at t = 0 halves all velocities."""
    case = free_case(initial, contacts={"clearance": 1.0})
    half = case.varied(**amplitude_changes(case, 0.5 * amplitude_of(case)))
    assert amplitude_of(half) == pytest.approx(0.5 * amplitude_of(case), rel=1e-15)

    motion = simulated(case)[0]["velocity"].values
    assert np.abs(simulated(half)[0]["velocity"].values - 0.5 * motion).max() < 1e-9 * np.abs(motion).max()


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
