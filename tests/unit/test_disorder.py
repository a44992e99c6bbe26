"""Scatter has the distribution asked for, is the same for the same seed, and changes no other quantity."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.conftest import put_members
from vipetsc.case import Case, CaseError, Sweep
from vipetsc.case.disorder import SCATTERED, Deviation, values_of
from vipetsc.io.read import open_ensemble
from vipetsc.lattice import pass_bands

BASE = {"name": "small", "lattice": {"preset": "four-band", "cells": 40}, "drive": {"cycles": 4}}
CLEARANCE = 2e-3
TEN_SITES = {"sites": list(range(5, 15)), "clearance": CLEARANCE}


def draw(contacts: dict[str, Any] = TEN_SITES, **disorder: Any) -> Case:
    """Return the case with the quantities of ``disorder`` drawn, or the nominal case without any."""
    table = BASE | {"contacts": contacts}
    if disorder:
        table = table | {"disorder": disorder}
    return Case.from_table(table)


@pytest.mark.parametrize("distribution", ["normal", "uniform", "lognormal"])
@pytest.mark.parametrize("size", [{"relative": 0.1}, {"absolute": 0.1 * CLEARANCE}])
def test_mean_and_deviation_are_those_asked_for(distribution, size):
    """100,000 drawn numbers have the mean, the deviation, the range and the skewness of their distribution."""
    nominal = np.full(100_000, CLEARANCE)
    drawn = Deviation(distribution=distribution, **size).draw(nominal, 7, "clearance") / CLEARANCE

    # Four standard errors of the mean.
    assert drawn.mean() == pytest.approx(1, abs=4 * 0.1 / np.sqrt(len(nominal)))
    assert drawn.std() == pytest.approx(0.1, rel=0.02)
    largest = np.abs(drawn - 1).max() / 0.1
    if distribution == "uniform":
        assert largest <= np.sqrt(3)
    else:
        assert largest > 4
    # The skewness of a lognormal number with the relative deviation c is 3 c + c^3.
    skewness = np.mean((drawn - 1) ** 3) / 0.1**3
    assert skewness == pytest.approx(0.301 if distribution == "lognormal" else 0.0, abs=0.05)


def test_a_seed_gives_the_same_bits_whatever_else_is_drawn():
    """Numbers of a quantity depend on the seed and not on other quantities; fewer sites have the first of them."""
    spread = {"relative": 0.05}
    one = draw(seed=3, clearance=spread)
    assert draw(seed=3, clearance=spread).to_toml() == one.to_toml()
    assert draw(seed=4, clearance=spread).contacts.clearance != one.contacts.clearance

    with_others = draw(seed=3, restitution={"absolute": 0.01}, masses=spread, clearance=spread)
    assert with_others.contacts.clearance == one.contacts.clearance
    fewer_sites = draw({"sites": [5, 6], "clearance": CLEARANCE}, seed=3, clearance=spread)
    assert fewer_sites.contacts.clearance == one.contacts.clearance[:2]


def test_a_deviation_of_zero_leaves_the_case_as_it_is_without_the_section():
    """Deviations of zero give the text of the nominal case."""
    quantities = ("clearance", "masses", "springs", "restitution", "stiffness")
    zero = {name: {"relative": 0.0} for name in quantities}
    assert draw(**zero, sites={"absolute": 0.0}).to_toml() == draw().to_toml()


def test_the_resolved_case_holds_what_was_drawn():
    """A resolved case has drawn masses, springs and stiffness, the nominal drive and times, and no [disorder]."""
    nominal = draw()
    case = draw(seed=1, masses={"relative": 0.02}, springs={"relative": 0.02}, modulus={"relative": 0.1})
    assert Case.from_toml(case.to_toml()) == case
    assert "disorder" not in case.to_toml()

    before = nominal.lattice.unit_cell()
    after = case.lattice.unit_cell()
    masses = np.divide(after.masses, before.masses)
    springs = np.divide([s.stiffness for s in after.springs], [s.stiffness for s in before.springs])
    for ratios in (masses, springs):
        assert 0 < np.abs(ratios - 1).max() < 0.1
    assert (after.host, after.resonator) == (before.host, before.resonator)
    ends_before = [(s.start, s.end, s.offset) for s in before.springs]
    assert [(s.start, s.end, s.offset) for s in after.springs] == ends_before
    assert pass_bands(after)[1].high != pass_bands(before)[1].high

    assert 1e-3 < abs(case.contacts.stiffness / nominal.contacts.stiffness - 1) < 0.4
    assert case.contact_radius == nominal.contact_radius
    # The drive and the times are those that the lattice was designed for.
    assert (case.drive, case.time) == (nominal.drive, nominal.time)


def test_sites_move_by_whole_cells():
    """Drawn sites are whole cells near the nominal ones."""
    case = draw({"sites": [10, 30], "clearance": CLEARANCE}, seed=2, sites={"absolute": 2.0})
    assert case.contacts.sites != [10, 30]
    # The bound is three deviations.
    assert np.abs(np.subtract(case.contacts.sites, [10, 30])).max() <= 6


def test_the_clearances_of_the_two_sides_are_drawn_independently():
    """Clearances on the side w < 0 have numbers of their own, and those on the side w > 0 are as without them."""
    scatter = {"seed": 2, "clearance": {"relative": 0.05}}
    equal = draw(**scatter).contacts.clearance
    minus = [3e-3] * 10
    for sides in ({"clearance_minus": 3e-3}, {"each": {"clearance_minus": minus, "side": ["minus"] * 10}}):
        case = draw(TEN_SITES | sides, **scatter)
        drawn = case.contacts.each.clearance_minus
        assert case.contacts.clearance == equal
        assert len(set(drawn)) == 10
        assert drawn == pytest.approx(minus, rel=0.3)
        assert np.all(np.abs(np.divide(drawn, minus) - np.divide(equal, CLEARANCE)) > 1e-4)
        assert case.model().chain.sites.gaps[:, 1].tolist() == drawn
        assert Case.from_toml(case.to_toml()) == case

    one = draw({"sites": [5], "clearance": CLEARANCE, "clearance_minus": 3e-3}, **scatter).contacts
    assert one.each is None
    assert one.clearance_minus == drawn[0]
    changed = "draws|sign must not change"
    with pytest.raises(CaseError, match=changed):
        draw(TEN_SITES | {"clearance_minus": 1e-6}, clearance={"absolute": 1e-5})


def test_a_cell_with_scattered_springs_keeps_their_nonlinear_parts_and_dashpots():
    table = EVERYTHING
    nominal = Case.from_table(table).lattice.unit_cell()
    cell = Case.from_table(table | {"disorder": {"seed": 1, "springs": {"relative": 0.02}}}).lattice.unit_cell()

    assert [s.stiffness for s in cell.springs] != [s.stiffness for s in nominal.springs]
    for before, after in zip(nominal.springs, cell.springs, strict=True):
        assert replace(after, stiffness=before.stiffness) == before
    assert cell.grounding == (0.2, 0.1)
    assert (cell.springs[0].cubic, cell.springs[0].quadratic) == (3e9, -2e6)


SPRINGS = [
    {"start": 1, "end": 1, "stiffness": 4e3, "next_cell": True, "quadratic": -2e6, "cubic": 3e9, "damping": 0.5},
    {"start": 1, "end": 2, "stiffness": 2e3, "damping": 0.1},
]
EVERYTHING: dict[str, Any] = {
    "lattice": {"cell": {"masses": [0.01, 0.02], "springs": SPRINGS, "grounding": [0.2, 0.1]}, "cells": 40},
    "contacts": {"law": "power", "exponent": 1.4, "stiffness": 1e5, "sites": [9, 20], "clearance": 1e-3},
    "drive": {"frequency": 300.0, "cycles": 4},
}


@pytest.mark.parametrize("key", SCATTERED)
def test_each_quantity_scatters_alone_about_its_values(key):
    """Every quantity of the table has other numbers of the right size, and all others keep theirs to the bit."""
    nominal = values_of(dict(Case.from_table(EVERYTHING)))
    drawn = values_of(dict(Case.from_table(EVERYTHING | {"disorder": {"seed": 2, key: {"relative": 0.01}}})))

    ratio = np.divide(drawn[key], nominal[key], out=np.ones(len(nominal[key])), where=np.not_equal(nominal[key], 0))
    assert 1e-5 < np.abs(ratio - 1).max() < 0.05
    others = set(nominal) - {key, "modulus", "stiffness" if key == "modulus" else ""}
    assert {name: drawn[name] for name in others} == {name: nominal[name] for name in others}


SWEEP = BASE | {
    "contacts": {"sites": [9, 20]},
    "disorder": {"clearance": {"relative": 0.02}},
    "sweep": {
        "measures": ["transfer"],
        "disorder": {"seed": {"count": 5}},
        "drive": {"amplitude": {"log": [1.0, 64.0], "count": 7}},
    },
}


def test_a_count_of_seeds_is_an_axis_of_samples():
    """A sweep over a count of seeds has an axis of seeds, whose members are the cases with these seeds."""
    plan = Sweep.from_table(SWEEP)
    assert plan.shape == (5, 7)
    assert plan.axes[0] == {"disorder.seed": (0, 1, 2, 3, 4)}
    assert Sweep.from_table(tomllib.loads(plan.to_toml())).ids() == plan.ids()

    # A member is the case with its seed; engines of members are chosen by the program.
    table = {key: value for key, value in SWEEP.items() if key != "sweep"}
    table["time"] = {"engine": "auto"}
    table["disorder"] = table["disorder"] | {"seed": 3}
    assert plan.case(3 * 7).contacts == Case.from_table(table).contacts


# Members that fail: one of five samples at 8 N, all at 64 N.
FAILED = (3, 6, 13, 20, 27, 34)


def transfer_of_members() -> np.ndarray:
    """Return a random transfer (seed, amplitude) that sets in at 4 N."""
    count = 35
    values = np.random.default_rng(1).uniform(0.1, 0.3, count) * (np.arange(count) % 7 > 1)
    return values.reshape(5, 7)


@pytest.fixture(scope="module")
def ensemble(tmp_path_factory):
    """Return the ensemble of a finished sweep with the transfers of ``transfer_of_members``, each plus 1e-4."""
    transfer = transfer_of_members().ravel()

    def outcome(number: int, case: Case) -> dict[str, Any] | str:
        if number in FAILED:
            return "failed"
        statistics = {
            "episodes": int(transfer[number] > 0),
            "work": 2.0,
            "dissipated": 0.5,
            "ledger_error": 0.0,
            "engine": "ts",
        }
        return {"statistics": statistics, "measures": {"ibtet": transfer[number] + 1e-4}}

    folder = tmp_path_factory.mktemp("sweep")
    put_members(folder, Sweep.from_table(SWEEP), outcome)
    return open_ensemble(folder)


def test_statistics_are_those_of_the_samples_that_came_out(ensemble):
    """Mean, deviation and quantiles over the samples leave failed members out, and are NaN where all failed."""
    mean = ensemble["statistics/ibtet/mean"]
    deviation = ensemble["statistics/ibtet/deviation"]
    quantiles = ensemble["statistics/ibtet/quantiles"]
    assert mean.dims == ("amplitude",)
    assert quantiles.dims == ("quantile", "amplitude")
    assert mean.attrs["units"] == "1"
    assert "statistics/work/mean" in ensemble
    succeeded = [5, 5, 5, 4, 5, 5, 0]
    assert ensemble["statistics/samples"].values.tolist() == succeeded
    assert ensemble["statistics/work/samples"].values.tolist() == succeeded
    assert ensemble["statistics/ibtet/samples"].values.tolist() == succeeded

    values = transfer_of_members() + 1e-4
    values[0, 3] = np.nan
    values = values[:, :6]
    assert mean.values[:6] == pytest.approx(np.nanmean(values, axis=0), rel=1e-14)
    assert deviation.values[:6] == pytest.approx(np.nanstd(values, axis=0, ddof=1), rel=1e-14)
    for quantile, row in zip(ensemble["quantile"].values, quantiles.values, strict=True):
        assert row[:6] == pytest.approx(np.nanquantile(values, quantile, axis=0), rel=1e-14)
    for item in (mean, deviation, quantiles):
        assert np.isnan(item.values[..., 6]).all()


def test_a_modulus_scales_the_stiffness_of_sites_with_radii_of_their_own():
    """The stiffness of each site follows from the common modulus and the site's own radius."""
    material = {"sites": [5, 9], "clearance": CLEARANCE, "modulus": 1e8, "each": {"radius": [0.004, 0.005]}}
    plain = draw(material).contacts
    drawn = draw(material, modulus={"relative": 0.1}).contacts
    ratio = drawn.each.stiffness[0] / plain.each.stiffness[0]
    assert abs(ratio - 1) > 1e-3
    assert drawn.each.stiffness[1] == pytest.approx(ratio * plain.each.stiffness[1], rel=1e-15)
    assert drawn.stiffness == pytest.approx(ratio * plain.stiffness, rel=1e-15)
