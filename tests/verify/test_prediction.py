"""Sites composed from the answer of one: limits, energy, order, first contact, resuming, bad input."""

import json

from mpi4py import MPI

import numpy as np
import pytest

from vipetsc.case import Case, CaseError
from vipetsc.case.predict import PredictCase
from vipetsc.dynamics import simulate
from vipetsc.io.records import read_records
from vipetsc.io.store import RunMemory
from vipetsc.studies.composition import Network
from vipetsc.studies.prediction import LINEAR, SITE, Records, amplitudes_of, composed, predict, site_points
from vipetsc.studies.recorded_runs import RecordedRuns
from vipetsc.studies.response import BINS, SiteResponse, in_contact

SMALL = {
    "name": "small",
    "lattice": {"preset": "four-band", "cells": 120},
    "contacts": {"sites": [40, 70], "clearance": [2e-3, 1.8e-3]},
    "drive": {"cycles": 15, "band": 2, "at": "max-group-velocity"},
    "predict": {"points": 16, "amplitudes": [5.0, 30.0, 120.0, 600.0]},
}


def small(**sections):
    return PredictCase.from_table({k: SMALL.get(k, {}) | sections.get(k, {}) if k != "name" else "small"
                                   for k in SMALL | sections})  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of a small prediction, its case and its content."""
    folder = tmp_path_factory.mktemp("prediction")
    case = small()
    return folder, case, predict(case, folder)


def response(made, **sections):
    """The linear record and the answer of one site of the small case, with other sections for a network."""
    folder = made[0]
    records = [record for record, _ in read_records(folder / "prediction-runs.jsonl", pytest.fail)]
    linear = next(record for record in records if record["kind"] == LINEAR)
    answers = [record for record in records if record["kind"] == SITE]
    return linear, answers, small(**sections)


def compose_case(case, linear, answers):
    """The prediction of a case from these records, without simulations beside it."""
    return composed(case, Records(linear, answers, [], answers[0]["largest"]))


def answer(made):
    _, answers, case = response(made)
    return SiteResponse.of(answers, case.lattice.unit_cell(), case.model().drive.frequency, answers[0]["largest"])


@pytest.mark.slow
def test_energy_is_whole_and_no_share_is_negative(made):
    data = made[2]
    total = data["predicted/bands"].sum("band") + data["predicted/dissipated"]
    np.testing.assert_allclose(total, 1, atol=1e-12)
    assert float(data["predicted/bands"].min()) >= 0
    simulated = data["simulated/bands"].sum("band") + data["simulated/dissipated"]
    np.testing.assert_allclose(simulated, 1, atol=5e-3)  # the contacts hold the rest


def test_below_the_onset_the_run_is_linear(made):
    data = made[2]
    assert data["amplitude"][0] < data.attrs["onset_amplitude"] < data["amplitude"][1]
    np.testing.assert_allclose(data["predicted/bands"][0], data["simulated/bands"][0], atol=1e-9)
    assert float(data["predicted/dissipated"][0]) == 0


def test_the_small_prediction_is_near_the_simulation(made):
    data = made[2]
    assert data.attrs["rms_upper"] < 0.15
    assert data.attrs["worst_dissipated"] < 0.05
    assert float(data["predicted/change"].max()) < 1e-3


def test_the_first_contact_is_exact(made):
    _, case, data = made
    table = case.model_dump(by_alias=True, exclude_none=True)
    del table["law"], table["predict"]
    for share, contacts in ((0.9999, False), (1.0001, True)):
        table["drive"]["amplitude"] = share * data.attrs["onset_amplitude"]
        result = simulate(Case.from_table(table), RunMemory(MPI.COMM_SELF))
        assert (result.statistics["episodes"] > 0) == contacts


def test_one_site_alone_is_what_its_run_gave(made):
    """A lattice from whose ends nothing returns: energies are those of the run of one site at the same z."""
    _, answers, small_case = response(made)
    clearance, site = small_case.law.clearance, answer(made)
    contacts = {"sites": [200], "clearance": [clearance]}
    network = Network(small(lattice={"cells": 400}, contacts=contacts, time={"end": 0.75}).model())
    for record in answers[6::4]:
        got = network.compose(record["z"] * clearance / np.abs(network.linear).max(), site)
        lost, *into = np.array(record["totals"]) * small_case.model().sample_interval
        assert got.dissipated == pytest.approx(lost, rel=0.2)
        assert got.into[2:].sum() == pytest.approx(sum(into[2:]), rel=0.2)


def test_without_loss_nothing_is_lost(made):
    """Records of r = 1 dissipate nothing: neither does what is composed of them."""
    linear, answers, case = response(made)
    for record in answers:
        record["sums"][6], record["totals"][0] = [0.0] * BINS, 0.0
    data = compose_case(case, linear, answers)
    assert float(np.abs(data["predicted/dissipated"]).max()) == 0
    assert float(data["predicted/upper"].max()) > 0.05


def test_the_order_of_the_sites_in_the_file_does_not_matter(made):
    linear, answers, _ = response(made)
    swapped = small(contacts={"sites": [70, 40], "clearance": [1.8e-3, 2e-3]})
    ways = []
    for case, reached in ((small(), linear["reached"]), (swapped, linear["reached"][::-1])):
        ways.append(compose_case(case, linear | {"reached": reached}, answers))
    np.testing.assert_allclose(ways[0]["predicted/bands"], ways[1]["predicted/bands"], atol=2e-4)


def test_a_site_that_nothing_reaches_changes_nothing(made):
    linear, answers, _ = response(made)
    more = small(contacts={"sites": [40, 70, 100], "clearance": [2e-3, 1.8e-3, 1.0]})
    data = compose_case(more, linear | {"reached": [*linear["reached"], 1e-4]}, answers)
    np.testing.assert_allclose(data["predicted/bands"], made[2]["predicted/bands"], atol=2e-3)


def test_contact_goes_on_until_release():
    z = np.array([[0.9, 1.1, 0.9, 0.41, 0.39, 0.9]] * 2)
    on = in_contact(z, np.array([0.4, 0.6]))
    assert on.tolist() == [[False, True, True, True, False, False], [False, True, True, False, False, False]]


def test_the_release_is_where_the_last_contact_of_a_run_ended(made):
    """Records tell it, and the response interpolates it over the largest z; without contacts it is the onset."""
    _, answers, _ = response(made)
    site = answer(made)
    assert all(0 < record["release"] < 1 for record in answers[4:])
    z = [record["z"] for record in answers]
    np.testing.assert_allclose(site.over_bursts(np.array(z)).release, [record["release"] for record in answers])


def test_runs_that_are_there_are_not_made_again(made, tmp_path, monkeypatch):
    folder, case, data = made
    (tmp_path / "prediction-runs.jsonl").write_bytes((folder / "prediction-runs.jsonl").read_bytes())
    (tmp_path / "case.toml").write_text(case.to_toml())
    monkeypatch.setattr(RecordedRuns, "run_in_memory", lambda *_: pytest.fail("a run was made"))
    again = predict(case, tmp_path)
    for name in ("predicted/bands", "simulated/bands"):
        np.testing.assert_array_equal(again[name], data[name])


def test_amplitudes_and_points_by_default():
    case = small(predict={"amplitudes": [], "count": 3, "span": 4.0})
    np.testing.assert_allclose(amplitudes_of(case, {"reached": [0.1, 0.05]}), [10, 20, 40])
    points = site_points(case, 50.5)
    assert points == sorted(points) and points[0] == 1.0005 and points[-1] == pytest.approx(50)


@pytest.mark.parametrize(
    ("sections", "key"),
    [
        ({"contacts": {"sites": [], "clearance": []}}, "contacts.sites"),
        ({"lattice": {"ends": "periodic"}}, "lattice.ends"),
        ({"predict": {"amplitudes": [-1.0]}}, "predict.amplitudes[1]"),
        ({"predict": {"spam": 1}}, "predict.spam"),
    ],
)
def test_what_cannot_be_predicted_is_said_before_any_run(sections, key):
    with pytest.raises(CaseError) as error:
        small(**sections)
    assert key in str(error.value)
    assert json.dumps(str(error.value)).count("problem") >= 1
