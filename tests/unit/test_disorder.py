"""Scatter: what is drawn is what was asked, the same for a seed wherever it is drawn, and nothing else changes."""

from __future__ import annotations

import tomllib
from dataclasses import fields, replace

import numpy as np
import pytest

from tests.conftest import put_members
from vipetsc.case import Case, CaseError, Sweep
from vipetsc.case.disorder import Deviation, with_cell
from vipetsc.case.schema import SpringTable
from vipetsc.case.verb_cases import disorder_of
from vipetsc.figures.sweep_members import Files, Sweeps
from vipetsc.figures.transfer_curves import transfer_curves
from vipetsc.io.read import open_ensemble, over_samples
from vipetsc.lattice import Spring, UnitCell, pass_bands
from vipetsc.studies.linear_run import linear_name

BASE = {"name": "small", "lattice": {"preset": "four-band", "cells": 40}, "drive": {"cycles": 4}}
SITES = {"sites": list(range(5, 15)), "clearance": 2e-3}


def draw(contacts=SITES, **disorder) -> Case:
    table = BASE | {"contacts": contacts}
    return Case.from_table(table | ({"disorder": disorder} if disorder else {}))


@pytest.mark.parametrize("distribution", ["normal", "uniform", "lognormal"])
@pytest.mark.parametrize("size", [{"relative": 0.1}, {"absolute": 2e-4}])
def test_mean_and_deviation_are_those_asked_for(distribution, size):
    values = np.full(100_000, 2e-3)
    drawn = Deviation(distribution=distribution, **size).draw(values, 7, "clearance") / 2e-3
    assert drawn.mean() == pytest.approx(1, abs=4 * 0.1 / np.sqrt(len(values)))
    assert drawn.std() == pytest.approx(0.1, rel=0.02)
    reach = np.abs(drawn - 1).max() / 0.1
    assert reach <= np.sqrt(3) if distribution == "uniform" else reach > 4
    skewness = np.mean((drawn - 1) ** 3) / 0.1**3
    assert skewness == pytest.approx(0.301 if distribution == "lognormal" else 0.0, abs=0.05)  # 3 c + c^3, c = .1


def test_a_seed_gives_the_same_bits_beside_other_quantities_and_sites():
    spread = {"relative": 0.05}
    one, again = (draw(seed=3, clearance=spread) for _ in range(2))
    assert one.to_toml() == again.to_toml()
    beside = draw(seed=3, restitution={"absolute": 0.01}, masses=spread, clearance=spread)
    assert beside.contacts.clearance == one.contacts.clearance != draw(seed=4, clearance=spread).contacts.clearance
    fewer = draw({"sites": [5, 6], "clearance": 2e-3}, seed=3, clearance=spread)
    assert fewer.contacts.clearance == one.contacts.clearance[:2]
    assert one.contacts.clearance[0] == 2e-3 * (1 + 0.05 * (again.contacts.clearance[0] / 2e-3 - 1) / 0.05)
    masses, springs = (Deviation(relative=1.0).draw(np.ones(4), 3, name) for name in ("masses", "springs"))
    assert not np.isclose(masses, springs).any()


def test_without_deviation_the_case_is_what_it_is_without_the_section():
    nominal = draw()
    zero = {name: {"relative": 0.0} for name in ("clearance", "masses", "springs", "restitution", "stiffness")}
    assert draw(**zero, sites={"absolute": 0.0}).to_toml() == nominal.to_toml()


def test_what_is_drawn_stands_in_the_resolved_case():
    nominal = draw()
    case = draw(seed=1, masses={"relative": 0.02}, springs={"relative": 0.02}, modulus={"relative": 0.1})
    assert Case.from_toml(case.to_toml()) == case and "disorder" not in case.to_toml()
    before, after = nominal.lattice.unit_cell(), case.lattice.unit_cell()
    stiffness = [[spring.stiffness for spring in cell.springs] for cell in (before, after)]
    for old, new in ((before.masses, after.masses), stiffness):
        assert 0 < np.abs(np.divide(new, old) - 1).max() < 0.1
    assert (after.host, after.resonator) == (before.host, before.resonator)
    assert [(s.start, s.end, s.next_cell) for s in after.springs] == [
        (s.start, s.end, s.next_cell) for s in before.springs
    ]
    assert pass_bands(after)[1].high != pass_bands(before)[1].high
    assert 1e-3 < abs(case.contacts.stiffness / nominal.contacts.stiffness - 1) < 0.4
    assert case.contact_radius == nominal.contact_radius
    # The drive and the times are those that the lattice was designed for.
    assert (case.drive, case.time) == (nominal.drive, nominal.time)
    cells = draw({"sites": [10, 30], "clearance": 2e-3}, seed=2, sites={"absolute": 2.0}).contacts.sites
    assert cells != [10, 30] and np.abs(np.subtract(cells, [10, 30])).max() <= 6


def test_linear_runs_are_shared_by_samples_of_clearances_alone():
    clearances = {
        linear_name(draw(seed=seed, clearance={"relative": 0.1}, restitution={"absolute": 0.02})) for seed in range(3)
    }
    cells = {linear_name(draw(seed=seed, masses={"relative": 0.1})) for seed in range(3)}
    assert clearances == {linear_name(draw())} and len(cells | clearances) == 4


@pytest.mark.parametrize(
    ("disorder", "says"),
    [
        ({}, "names nothing that scatters"),
        ({"seed": 3}, "names nothing that scatters"),
        ({"clearance": {"relative": -0.1}}, "disorder.clearance.relative = -0.1: must be greater than or equal to 0"),
        ({"clearanc": {"relative": 0.1}}, "did you mean disorder.clearance?"),
        ({"clearance": {"relative": 0.1, "absolute": 1e-4}}, "give one of relative and absolute"),
        ({"clearance": {}}, "give one of relative and absolute"),
        ({"clearance": {"relative": 0.9}}, "a sign cannot change: take a smaller deviation, or lognormal"),
        ({"clearance": {"relative": 0.1, "distribution": "norml"}}, "did you mean 'normal'?"),
        ({"sites": {"relative": 0.1}}, "give absolute, in cells"),
        ({"sites": {"absolute": 3.0}}, "draws contacts.sites = "),
        ({"restitution": {"absolute": 0.25, "distribution": "uniform"}}, "draws contacts.each.restitution[1] = "),
        ({"seed": -1, "clearance": {"relative": 0.1}}, "disorder.seed = -1"),
    ],
)  # fmt: skip
def test_what_cannot_be_drawn_is_refused(disorder, says):
    with pytest.raises(CaseError) as error:
        Case.from_table(BASE | {"contacts": SITES, "disorder": disorder})
    assert says in str(error.value) and len(error.value.problems) == 1, error.value


def test_a_restitution_is_drawn_for_every_site():
    spread = {"seed": 3, "restitution": {"relative": 0.05}}
    case = draw(**spread)
    drawn = case.contacts.each.restitution
    assert len(set(drawn)) == 10 and drawn == pytest.approx([0.7] * 10, rel=0.3)
    assert [law.restitution for law in case.model().laws] == drawn
    assert case.contacts.restitution == 0.7 and Case.from_toml(case.to_toml()) == case
    one = draw({"sites": [5], "clearance": 2e-3}, **spread).contacts
    assert one.each is None and one.restitution == drawn[0]


def test_cells_drawn_keep_smooth_parts_and_dashpots_of_springs():
    parts = {"quadratic": -2e6, "cubic": 3e9, "damping": 0.5}
    springs = [
        {"start": 1, "end": 1, "stiffness": 4e3, "next_cell": True} | parts,
        {"start": 1, "end": 2, "stiffness": 2e3},
    ]
    lattice = {"cell": {"masses": [0.01, 0.02], "springs": springs, "grounding": [0.0, 0.1]}, "cells": 40}
    table = {"lattice": lattice, "contacts": {"sites": []}, "drive": {"frequency": 300.0, "cycles": 4}}
    nominal, case = (
        Case.from_table(table | more) for more in ({}, {"disorder": {"seed": 1, "springs": {"relative": 0.02}}})
    )
    before, after = (case.lattice.unit_cell() for case in (nominal, case))
    assert [s.stiffness for s in after.springs] != [s.stiffness for s in before.springs]
    assert tuple(replace(s, stiffness=1.0) for s in after.springs) == tuple(
        replace(s, stiffness=1.0) for s in before.springs
    )
    assert (after.grounding, after.springs[0].cubic, after.springs[0].quadratic) == ((0.0, 0.1), 3e9, -2e6)


def test_a_quantity_that_the_case_lacks_is_refused():
    with pytest.raises(CaseError, match=r"disorder\.clearance: the case has none"):
        draw({"sites": []}, clearance={"relative": 0.1})
    with pytest.raises(CaseError, match=r"disorder\.modulus: the case has none"):
        draw(SITES | {"stiffness": 1e6}, modulus={"relative": 0.1})


SWEEP = BASE | {
    "contacts": {"sites": [9, 20]},
    "disorder": {"clearance": {"relative": 0.02}},
    "sweep": {"measures": ["transfer"], "disorder": {"seed": {"count": 5}},
              "drive": {"amplitude": {"log": [1.0, 64.0], "count": 7}}},
}  # fmt: skip


def test_a_count_of_seeds_is_an_axis_of_samples():
    plan = Sweep.from_table(SWEEP)
    assert plan.shape == (5, 7) and plan.axes[0] == {"disorder.seed": (0, 1, 2, 3, 4)}
    assert Sweep.from_table(tomllib.loads(plan.to_toml())).ids() == plan.ids()
    table = {key: value for key, value in SWEEP.items() if key != "sweep"} | {"time": {"engine": "auto"}}
    table["disorder"] = table["disorder"] | {"seed": 3}
    assert plan.case(3 * 7).contacts == Case.from_table(table).contacts
    disorder, nominal, drawn = disorder_of(None, ["disorder.clearance.relative=0.02", "sweep.disorder.seed=[7, 1]"])
    assert disorder.seed == 7 and nominal.contacts.clearance != drawn.contacts.clearance
    assert disorder_of(None, []) is None


def test_one_sample_that_cannot_be_drawn_refuses_the_sweep():
    wide = SWEEP | {"disorder": {"clearance": {"relative": 0.8}}}
    plan = Sweep.from_table(wide)
    possible = [plan.member(number).case is not None for number in range(0, plan.count, 7)]
    assert any(possible) and not all(possible)
    with pytest.raises(CaseError, match="but a sign cannot change"):
        plan.members()


def test_statistics_are_those_of_the_samples(tmp_path):
    """Over the seeds alone, of the samples that came out; pictures have means in place of single samples."""
    plan, rng = Sweep.from_table(SWEEP), np.random.default_rng(1)
    values = rng.uniform(0.1, 0.3, plan.count) * (np.arange(plan.count) % 7 > 1)

    def told(number, case):
        statistics = {"episodes": int(values[number] > 0), "work": 2.0, "dissipated": 0.5, "ledger_error": 0.0}
        row = {"statistics": statistics | {"engine": "ts"}, "measures": {"ibtet": values[number] + 1e-4}}
        return "failed" if number in (3, 6, 13, 20, 27, 34) else row  # one sample at 8 N, all at 64 N

    put_members(tmp_path / "out", plan, told)
    ensemble, table = open_ensemble(tmp_path / "out"), values.reshape(5, 7) + 1e-4
    table[0, 3] = np.nan
    found = {name: ensemble[f"statistics/ibtet/{name}"] for name in ("mean", "deviation", "quantiles")}
    assert found["mean"].dims == ("amplitude",) and found["quantiles"].dims == ("quantile", "amplitude")
    assert ensemble["statistics/samples"].values.tolist() == [5, 5, 5, 4, 5, 5, 0]
    came_out = table[:, :6]
    assert found["mean"].values[:6] == pytest.approx(np.nanmean(came_out, axis=0), rel=1e-14)
    assert found["deviation"].values[:6] == pytest.approx(np.nanstd(came_out, axis=0, ddof=1), rel=1e-14)
    for quantile, row in zip(ensemble["quantile"].values, found["quantiles"].values, strict=True):
        assert row[:6] == pytest.approx(np.nanquantile(came_out, quantile, axis=0), rel=1e-14)
    assert all(np.isnan(item.values[..., 6]).all() for item in found.values())
    assert found["mean"].attrs["units"] == "1" and "statistics/work/mean" in ensemble
    assert "fits/ibtet/peak" in ensemble and ensemble["statistics/fits/ibtet/peak"] == np.nanmax(found["mean"])
    means = over_samples(ensemble)
    assert means["ibtet"].dims == ("amplitude",) and (means["ibtet"] == found["mean"]).sum() == 6
    with Files() as files:
        (curve,) = transfer_curves(Sweeps([ensemble], files))
    assert curve.data["ibtet"].values[:6] == pytest.approx(found["mean"].values[:6])


def test_a_cell_with_scattered_masses_keeps_all_of_its_springs():
    """Whatever a spring may have, a further term of its force among it."""
    numbers = {field.name: 0.5 + i for i, field in enumerate(fields(Spring)) if isinstance(field.default, float)}
    assert {"damping", "quadratic", "cubic"} <= numbers.keys()
    springs = Spring(0, 0, 3.0, next_cell=True, **numbers), Spring(0, 1, 4.0)
    cell = UnitCell(masses=(1.0, 2.0), springs=springs, host=0, resonator=1)
    table = with_cell({"cells": 5}, cell, {"masses": [1.1, 2.2]})["cell"]
    assert table["masses"] == [1.1, 2.2]
    assert tuple(SpringTable(**spring).spring() for spring in table["springs"]) == springs
