"""What a design is judged by, against the ledger and against the run of the best case."""

from __future__ import annotations

import copy

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import datasets, search_table, small_case
from vipetsc.case import Case
from vipetsc.case.optimise import ObjectiveTable, OptimiseCase
from vipetsc.dynamics import simulate
from vipetsc.io.store import RunMemory
from vipetsc.lattice import gaps, pass_bands
from vipetsc.studies import optimum_search
from vipetsc.studies.linear_run import LinearRun, linear_case
from vipetsc.studies.objective import measured

SEARCH = {"budget": 30, "curve": [12.0], "variables": {"clearance": [3e-5, 3e-3]}}
TABLE = search_table(
    24, [6, 12, 13], drive={"amplitude": 24.33, "cycles": 6}, time={"end": 0.08, "rtol": 1e-8}, optimise=SEARCH
)


def objective(measure, **more):
    return ObjectiveTable.model_validate({"measure": measure} | more)


def judged(case, *objectives):
    memory = RunMemory()
    result = simulate(case, memory, MPI.COMM_SELF)
    return measured(memory.dataset, result.statistics, objectives), memory.dataset


def test_shares_of_the_work_sum_to_one():
    """Bands, parts of bands and gaps; what is lost is the ledger's."""
    case = small_case(time={"end": 0.08, "engine": "auto", "rtol": 1e-9})
    bands = pass_bands(case.lattice.unit_cell())
    middle = 0.5 * (bands[3].low + bands[3].high)
    parts = [objective("band_share", band=4, part=part) for part in ([1.0, middle], [middle, 1e5])]
    values, run = judged(case, objective("upper_share_at_end"), objective("band_share", band=4), *parts)
    of_ends = 1 - sum(values["bands"]) - values["dissipated"]
    held = float(run["energy/contact"][-1] / run["energy/work"][-1])

    assert len(gaps(bands)) == 3
    assert 0 <= of_ends - held < 0.01
    assert values["dissipated"] == pytest.approx(float(run["energy/dissipated"][-1] / run["energy/work"][-1]))
    assert values["band_share 4"] == pytest.approx(values["bands"][3], rel=1e-12)
    assert sum(values[part.name] for part in parts) == pytest.approx(values["bands"][3], rel=1e-12)
    assert all(values[part.name] > 0 for part in parts)
    assert values["upper_share_at_end"] == pytest.approx(sum(values["bands"][2:]), rel=1e-12)
    assert values["episodes"] > 10


@pytest.mark.parametrize("drive", [1, 24])
def test_what_is_beyond_the_last_site_is_what_came_through(drive):
    """Without contacts a wave passes the site whole, whichever end it comes from."""
    contacts = {"sites": [11 if drive == 1 else 14], "clearance": 1.0}
    case = small_case(contacts=contacts, drive={"cell": drive, "cycles": 2}, time={"end": 0.045, "engine": "auto"})
    values, run = judged(case, objective("transmitted"))
    energy = run["energy/kinetic"][-1] + run["energy/spring"][-1]

    assert values["episodes"] == 0
    assert float(energy / run["energy/work"][-1]) == pytest.approx(1, rel=1e-6)

    u, v = (run[name].values[-1] for name in ("displacement", "velocity"))
    chain = case.model().chain
    local = 0.5 * (u.ravel() * (chain.stiffness_matrix() @ u.ravel()) + chain.masses() * v.ravel() ** 2).reshape(24, 4)
    side = slice(11, None) if drive == 1 else slice(None, 13)

    assert values["transmitted"] == pytest.approx(local[side].sum() / float(run["energy/work"][-1]), rel=1e-9)
    assert 0.3 < values["transmitted"] < 1


@pytest.mark.slow
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

    at = list(found["amplitude"]).index(24.33)
    assert found["curve/value"][1, at, 0] == value[best]
    assert found["curve/value"][0, at, 0] == value[0]
    assert found["upper_share_at_end"].tolist() == value.tolist()


def test_a_search_begins_at_clearances_matched_by_the_law_of_a_site(tmp_path, monkeypatch):
    """Each meets the same relative displacement over clearance, less what the sites before it take."""

    class Law:
        def matched(self):
            return 1.25, 0.64

    asked = []
    monkeypatch.setattr(optimum_search, "make_law", lambda *given, **options: asked.append(given) or Law())
    table = copy.deepcopy(TABLE)
    table["optimise"] |= {"start": "matched", "budget": 2}
    table["contacts"]["sites"] = [12, 6, 13]
    optimum_search.run_search(OptimiseCase.from_table(table), tmp_path)
    ((law, folder, _),) = asked

    assert law.drive.amplitude == 24.33
    assert folder == tmp_path / "law"

    memory = RunMemory()
    result = simulate(linear_case(small_case()), memory, MPI.COMM_SELF)
    envelope = LinearRun.of(memory.dataset, result.statistics, (), ()).envelope
    met = 24.33 * envelope[np.array([6, 12, 13]) - 1] / 1.25 * [1, 0.8, 0.64]
    found = datasets(tmp_path / "optimum.h5")["parameter"]

    assert found.shape == (2, 3)
    assert found[0] == pytest.approx(2e-4)
    assert found[1][[1, 0, 2]] == pytest.approx(met, rel=1e-3)
