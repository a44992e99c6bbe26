"""Predictions of lattices with dashpots and absorbing ends: the energy left in waves, and where the rest goes."""

from __future__ import annotations

import numpy as np
import pytest

from tests.one_site import prediction_case
from vipetsc.figures.registry import draw
from vipetsc.lattice import Chain, ModalCompliance, WaveCompliance, bloch
from vipetsc.lattice.compliance.by_elimination import DirectCompliance
from vipetsc.lattice.ends import absorber
from vipetsc.lattice.sites import Pair, sites_at
from vipetsc.studies.composition import Network
from vipetsc.studies.prediction import predict
from vipetsc.studies.rays import BINS, Rays

AMPLITUDES = {"amplitudes": [5.0, 30.0], "points": 16}
ABSORBING = {"cells": 30, "strength": 2000.0}
BAND = 2  # the band whose waves are followed, from 0
EVEN = np.full((4, BINS), 1 / BINS)


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
def test_elimination_agrees_with_waves_and_with_modes(ends):
    """Compliances by elimination are those of Bloch waves, and with an absorbing end those of damped modes.

    One of the two contacts is with the ground.
    """
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
    """A wave loses its energy when it reaches the absorbing end at the group velocity.

    Half of the energy goes there directly, the other half after a reflection at the wall on the other side.
    """
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
