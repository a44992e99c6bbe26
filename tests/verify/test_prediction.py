"""Predictions composed of single sites: limits, energy, first contact, dashpots and absorbing ends."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import xarray as xr
from scipy.interpolate import CubicSpline

from tests.conftest import simulated, with_sections
from tests.one_site import PREDICTION, prediction_case
from vipetsc.case import Case
from vipetsc.case.law import NO_SITES
from vipetsc.case.predict import PredictCase
from vipetsc.figures.registry import draw
from vipetsc.io.records import read_records
from vipetsc.lattice import Chain, ModalCompliance, WaveCompliance, bloch
from vipetsc.lattice.compliance.by_elimination import DirectCompliance
from vipetsc.lattice.ends import absorber
from vipetsc.lattice.sites import Pair, sites_at
from vipetsc.studies.composition import Network
from vipetsc.studies.prediction import predict
from vipetsc.studies.prediction_runs import LINEAR, SITE
from vipetsc.studies.rays import BINS, Rays
from vipetsc.studies.response import SiteResponse, SiteResponses, in_contact

# The two ramps of this chirp meet, so that its spectrum is smooth and lies within the band.
CHIRP = {"waveform": "chirp", "bandwidth": 300.0, "duration": 0.09, "ramp": 0.045}


def pulse_case(drive: dict[str, Any], **sections: dict[str, Any]) -> PredictCase:
    """The small case with another waveform than a burst, at the same frequency; ``drive`` updates [drive]."""
    wave = {key: value for key, value in PREDICTION["drive"].items() if key != "cycles"}
    return PredictCase.from_table(with_sections(PREDICTION | {"drive": wave | drive}, sections))


class Prediction(NamedTuple):
    """A prediction: its folder, its case and its content."""

    folder: Path
    case: PredictCase
    data: xr.Dataset

    def records(self) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """New copies of the record of the linear run, and of those of one site alone."""
        records = [record for record, _ in read_records(self.folder / "prediction-runs.jsonl", pytest.fail)]
        linear = next(record for record in records if record["kind"] == LINEAR)
        return linear, [record for record in records if record["kind"] == SITE]

    def site(self) -> SiteResponse:
        """The response of one site to the waves that meet it, by the records."""
        _, site_records = self.records()
        frequency = self.case.model().drive.frequency
        [kind] = self.case.kinds.kinds
        cell = self.case.lattice.unit_cell()
        return SiteResponse.of(site_records, cell, frequency, site_records[0]["largest"], kind.pair)


@pytest.fixture(scope="module")
def prediction(tmp_path_factory) -> Prediction:
    """A small prediction together with the simulations that it is compared with."""
    folder = tmp_path_factory.mktemp("prediction")
    case = prediction_case()
    return Prediction(folder, case, predict(case, folder))


def test_energy_is_whole_and_no_fraction_is_negative(prediction):
    """Predicted energies of bands and the loss sum to one, and no energy of a band is negative."""
    data = prediction.data

    predicted = data["predicted/bands"].sum("band") + data["predicted/dissipated"]
    # Predicted energy is in bands or dissipated, and nowhere else.
    np.testing.assert_allclose(predicted, 1, atol=1e-12)
    # That holds by definition. What the forces of the sites take from the drive's wave is another sum, and is that
    # which the runs of one site give.
    taken = 1 - data["predicted/bands"].max("band")
    assert float(taken.max()) > 0.2
    assert float(np.abs(data["predicted/defect"]).max()) < 0.03
    assert data.attrs["warnings"] == "[]"
    assert float(data["predicted/bands"].min()) >= 0
    # A little energy is in the contacts at the end of a simulation.
    simulated = data["simulated/bands"].sum("band") + data["simulated/dissipated"]
    np.testing.assert_allclose(simulated, 1, atol=5e-3)


def test_below_the_onset_the_run_is_linear(prediction):
    """Below the onset the predicted energies of bands are those of the run, and nothing is dissipated."""
    data = prediction.data
    # The first amplitude is below the onset, all others above.
    assert data["amplitude"][0] < data.attrs["onset_amplitude"] < data["amplitude"][1]

    np.testing.assert_allclose(data["predicted/bands"][0], data["simulated/bands"][0], atol=1e-9)
    assert float(data["predicted/dissipated"][0]) == 0


def test_the_small_prediction_is_near_the_simulation(prediction):
    """The prediction, which fits nothing, errs by less than 0.15 decades in upper bands and 0.05 in the loss."""
    data = prediction.data

    assert data.attrs["rms_upper"] < 0.15
    assert data.attrs["worst_dissipated"] < 0.05
    # The iteration between the sites has converged.
    assert float(data["predicted/change"].max()) < 1e-3


@pytest.mark.parametrize(("factor", "touches"), [(0.9999, False), (1.0001, True)])
def test_the_first_contact_is_exact(prediction, factor, touches):
    """A run has no contact at 0.9999 of the predicted onset amplitude, and contact at 1.0001 of it."""
    table = prediction.case.model_dump(by_alias=True, exclude_none=True)
    # The table of a run has no sections of other verbs.
    del table["law"]
    del table["predict"]
    # The amplitude is 1e-4 below or above the predicted onset.
    table["drive"]["amplitude"] = factor * prediction.data.attrs["onset_amplitude"]

    _, result = simulated(Case.from_table(table))

    assert (result.statistics["episodes"] > 0) == touches


def test_one_site_alone_is_what_its_run_gave(prediction):
    """The energies composed for a single site are those of its run at the same z, if nothing returns from the ends."""
    _, site_records = prediction.records()
    clearance = prediction.case.law.clearance
    site = prediction.site()
    contacts = {"sites": [200], "clearance": [clearance]}
    # The lattice is so long that no wave comes back from its ends within the run.
    long = prediction_case(lattice={"cells": 400}, contacts=contacts, time={"end": 0.75})
    network = Network(long.model())

    # The points lie above the onset and cover the whole range of z.
    for record in site_records[6::4]:
        amplitude = record["z"] * clearance / np.abs(network.linear).max()
        outcome = network.compose(amplitude, SiteResponses((site,), np.zeros(1, int)))
        # Totals are sums of powers over samples: the power lost, then those by band.
        lost, *into = np.array(record["totals"]) * prediction.case.model().sample_interval
        assert outcome.dissipated == pytest.approx(lost, rel=0.2)
        assert outcome.into[2:].sum() == pytest.approx(sum(into[2:]), rel=0.2)


LOSSY = {"restitution": 0.7}
LOUD = {"predict": {"amplitudes": [30.0, 120.0]}}
# Sections by name, and by how much of the work the loss may err.
PREDICTED: dict[str, tuple[dict[str, Any], float]] = {
    "two restitutions": (LOUD | {"contacts": {"each": {"restitution": [0.9, 0.4]}}}, 0.05),
    "one-sided": (LOUD | {"contacts": LOSSY | {"side": "plus"}}, 0.1),
    "next cell": (LOUD | {"contacts": LOSSY | {"pair": [1, 1], "next_cell": True}}, 0.05),
    "ring": (LOUD | {"contacts": LOSSY, "lattice": {"ends": "periodic"}}, 0.05),
    # One amplitude lies below the predicted onset of contact, one above.
    "moved wall": (
        {"contacts": LOSSY, "drive": {"end": "left"}, "predict": {"amplitudes": [5e-4, 2e-3], "points": 16}},
        0.05,
    ),
}


@pytest.mark.parametrize("name", PREDICTED)
def test_sites_waves_and_lattices_of_other_kinds_are_predicted_as_simulated(name, tmp_path):
    """Sites with laws or pairs of their own, a ring and a moved wall keep to the bounds of the small prediction."""
    sections, error = PREDICTED[name]
    data = predict(prediction_case(**sections), tmp_path)

    assert data["sites/kind"].values.tolist() == [1, 1 + (name == "two restitutions")]
    assert data.attrs["rms_upper"] < 0.15
    assert data.attrs["worst_dissipated"] < error
    touched = data["simulated/contact_episodes"].values > 0
    assert (touched == (data["amplitude"].values > data.attrs["onset_amplitude"])).all()


def test_linear_waves_of_a_moved_wall_and_on_a_ring():
    """A wall moved by U acts as a force k U on its mass; on a ring the wave is the same wherever it begins."""
    moved = prediction_case(drive={"end": "left"}).model()
    [spring] = moved.drives
    forced = prediction_case(drive={"cell": 1, "mass": spring.mass + 1}).model()
    np.testing.assert_allclose(Network(moved).linear, spring.stiffness * Network(forced).linear, rtol=1e-12)

    ring = {"lattice": {"ends": "periodic"}}
    # The ring is turned by half, so that the drive sends its wave over the joint.
    sites = {"sites": [10, 100], "clearance": [1.8e-3, 2e-3]}
    turned = Network(prediction_case(**ring, contacts=sites, drive={"cell": 61}).model()).linear
    here = Network(prediction_case(**ring).model()).linear
    np.testing.assert_allclose(turned, here[::-1], rtol=1e-9, atol=1e-12)


def test_contact_goes_on_until_release():
    """Contact begins above z = 1 and ends where z falls below the release, which differs from site to site."""
    # z rises through the onset, falls through both releases, and rises again without reaching the onset.
    z = np.array([[0.9, 1.1, 0.9, 0.41, 0.39, 0.9]] * 2)

    is_in_contact = in_contact(z, np.array([0.4, 0.6]))

    assert is_in_contact[0].tolist() == [False, True, True, True, False, False]
    assert is_in_contact[1].tolist() == [False, True, True, False, False, False]


def test_the_wave_of_a_pulse_that_is_no_burst_is_that_of_the_linear_run():
    """Envelopes at the sites, times the oscillation at their main frequency, are the motion of a linear run."""
    case = pulse_case(CHIRP)
    network = Network(case.model())
    run, _ = simulated(case.varied(contacts=NO_SITES, drive={"amplitude": 1.0}))
    cell = case.lattice.unit_cell()
    time = network.time[network.during]
    for site, envelope in zip(case.model().chain.sites.cells, network.linear, strict=True):
        u = run["displacement"].values[:, site]
        # The network's times lie between the samples of the run.
        w = CubicSpline(run["time"].values, u[:, cell.resonator] - u[:, cell.host])(time)
        predicted = (envelope[network.during] * np.exp(1j * network.om * time)).real
        np.testing.assert_allclose(predicted, w, atol=0.03 * np.abs(w).max())


def test_sites_that_are_too_close_are_told(tmp_path):
    """A prediction whose sites feel each other too strongly warns: its energies do not close, and its steps fail."""
    contacts = {"sites": list(range(40, 48)), "clearance": 1e-3, "restitution": 1.0}
    data = predict(prediction_case(contacts=contacts, predict={"amplitudes": [30.0, 1000.0]}), tmp_path)
    assert float(np.abs(data["predicted/defect"]).max()) > 0.1
    assert "too close together" in data.attrs["warnings"]


AMPLITUDES = {"amplitudes": [5.0, 30.0], "points": 16}
ABSORBING = {"cells": 30, "strength": 2000.0}
BAND = 2  # the band whose waves are followed, from 0
EVEN = np.full((4, BINS), 1 / BINS)


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
def test_elimination_agrees_with_waves_and_with_modes(ends):
    """Compliances by elimination are those of Bloch waves, and with an absorbing end those of damped modes."""
    cell = prediction_case().lattice.unit_cell()
    pairs = (Pair(1, 2), Pair(-1, 2))
    omega = np.linspace(400, 3000, 7) - 4j
    points = ((0, 0), (5, 2))
    equal = Chain(cell, 40, ends, sites=sites_at([12, 25], pairs))
    np.testing.assert_allclose(
        DirectCompliance(equal, points).response(omega), WaveCompliance(equal, points=points).response(omega), rtol=1e-9
    )

    if ends == "periodic":
        return
    graded = absorber(cell, ends, 15, 1000.0, before=25)
    varied = Chain(cell, 40, ends, sites=sites_at([12, 25], pairs), variation=graded.variation)
    direct = DirectCompliance(varied, points).response(omega)
    np.testing.assert_allclose(direct, ModalCompliance(varied, points).response(omega), rtol=1e-8, atol=1e-15)


def test_rays_fade_at_the_rate_of_dashpots_to_ground():
    """Dashpots of c m on every mass m leave exp(-c t) of the energy in every band after a time t."""
    model = prediction_case(lattice={"damping": {"mass": 3.0}}).model()
    time = np.linspace(0, model.end, 9)

    left = Rays(model, time).of_bands(40, EVEN)

    np.testing.assert_allclose(
        left.remaining, np.broadcast_to(np.exp(-3.0 * (model.end - time)), left.remaining.shape), rtol=1e-4
    )
    assert float(np.abs(left.absorbed).max()) == 0


def test_a_wave_is_absorbed_once_it_reaches_the_end():
    """A wave loses its energy when it reaches the absorbing end at the group velocity."""
    model = prediction_case(lattice={"absorbing": ABSORBING}, time={"end": 2.0}).model()
    kappa = 1.3
    speed = abs(float(bloch(model.chain.cell, kappa).group_velocity[BAND]))
    site = 60
    there = 120 - ABSORBING["cells"] - site
    ages = (
        np.array([there, there + ABSORBING["cells"], 2 * site + there, 2 * site + there + ABSORBING["cells"]]) / speed
    )

    left = Rays(model, model.end - ages).of_wave(site, BAND, kappa)

    np.testing.assert_allclose(left.remaining, [1, 0.5, 0.5, 0], atol=2e-3)
    np.testing.assert_allclose(left.remaining + left.absorbed, 1, atol=1e-12)


def test_absorbing_ends_take_the_whole_linear_wave():
    """After a long time absorbing ends have taken all work of a linear wave, by their compliance."""
    case = prediction_case(lattice={"absorbing": ABSORBING}, time={"end": 0.8})
    network = Network(case.model())
    assert network.losses
    absorbed = network.losses.absorbed_without_contacts()

    model = case.model()
    step = float(network.time[1])
    assert network.losses.has_ends
    # The work is that of the force on its own mass.
    omega = network.om + network.offset - 1j * network.line.decay
    compliance = DirectCompliance(model.chain, ((model.drive_cell, model.drive_mass),))
    velocity = 1j * omega * compliance.motion(omega, compliance.loads[:, -1:])[:, 0, -1]
    force = network.line.backward(network.losses.driving[0])
    work = 0.5 * (force.conj() * network.line.backward(velocity * network.losses.driving[0])).real.sum() * step
    assert absorbed == pytest.approx(work, rel=2e-3)


@pytest.fixture(scope="module", params=["dashpots", "absorbing end"])
def damped(request, tmp_path_factory):
    """The data and folder of a prediction with dashpots or with an absorbing end, and whether it has such an end."""
    lattice = {"damping": {"mass": 5.0}} if request.param == "dashpots" else {"absorbing": ABSORBING}
    folder = tmp_path_factory.mktemp("damped")
    case = prediction_case(lattice=lattice, contacts={"restitution": 0.7}, drive={"cycles": 10}, predict=AMPLITUDES)
    return predict(case, folder), folder, request.param != "dashpots"


def test_dashpots_and_ends_take_what_they_take_in_the_run(damped):
    """Losses in dashpots, ends and contacts are predicted as simulated, with the bounds of undamped lattices."""
    data, folder, has_end = damped
    for kind in ("predicted", "simulated"):
        total = data[f"{kind}/bands"].sum("band") + data[f"{kind}/dissipated"] + data[f"{kind}/dashpots"]
        np.testing.assert_allclose(total, 1, atol=5e-3)
    assert float(data["predicted/bands"].min()) >= 0

    # Below the first contact the run is linear.
    np.testing.assert_allclose(data["predicted/dashpots"][0], data["simulated/dashpots"][0], atol=1e-9)
    assert data.attrs["rms_upper"] < 0.15
    assert data.attrs["worst_dissipated"] < 0.05
    assert data.attrs["worst_dashpots"] < (0.03 if has_end else 0.005)

    assert ("predicted/absorbed" in data) == has_end
    if has_end:
        np.testing.assert_allclose(data["predicted/absorbed"], data["predicted/dashpots"], atol=2e-3)
    assert [path.name for path in draw("prediction", [folder])] == ["prediction.png"]
