"""The scattering law in a lattice with dashpots: fluxes past the site, their decay, and the limit without damping."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

from tests.one_site import COARSE, law_case
from vipetsc.case import LawCase
from vipetsc.parallel import StopRequest
from vipetsc.studies.one_site import LINEAR, ScatteringRuns
from vipetsc.studies.scattering_law import BACKWARD, FORWARD
from vipetsc.studies.site_waves import spectrum_of

FRACTIONS = ("transmitted", "reflected", "upper", "dissipated", "dashpots")


def damped_case(damping: dict[str, float], **law: Any) -> LawCase:
    """The small law with dashpots and a lossy contact."""
    table = law_case(contacts={"restitution": 0.7}, law=COARSE | law).model_dump(by_alias=True, exclude_none=True)
    table["lattice"]["damping"] = damping
    # The distance was resolved without dashpots, and is left to be resolved again with them.
    del table["law"]["distance"]
    return LawCase.from_table(table)


def make_runs(folder: Path, case: LawCase) -> ScatteringRuns:
    """The runs of the law ``case`` on this rank, before any has been simulated."""
    folder.mkdir(exist_ok=True)
    return ScatteringRuns(case, folder, MPI.COMM_SELF, StopRequest())


def fractions(runs: ScatteringRuns, z: float) -> dict[str, float]:
    """The fractions of a single run by name."""
    runs.make([z])
    # A point would otherwise be the mean of several runs, whose scatter exceeds the differences that are compared.
    runs.jittered = lambda point: [point]
    mean, _ = runs.outcomes(z)
    return {name: float(mean[name]) for name in FRACTIONS}


@pytest.fixture(scope="module")
def undamped(tmp_path_factory) -> dict[str, float]:
    """The fractions without dashpots, from the waves at the end of the run."""
    return fractions(make_runs(tmp_path_factory.mktemp("undamped"), damped_case({})), 1.3)


def test_without_damping_the_fluxes_are_the_waves_at_the_end(undamped, tmp_path):
    """With dashpots that take 3e-8 of the wave, fluxes past the site are the energies in all cells at the end."""
    runs = make_runs(tmp_path, damped_case({"mass": 1e-6}))
    assert runs.records[LINEAR]["taken_before"] < 1e-7

    weak = fractions(runs, 1.3)

    for name in FRACTIONS:
        assert weak[name] == pytest.approx(undamped[name], abs=4e-4), name


def test_the_wave_decays_over_the_distance_as_by_dashpots_to_ground(tmp_path):
    """Dashpots of c m on every mass m leave exp(-c t) of the energy after t, the distance over the group velocity."""
    runs = make_runs(tmp_path, damped_case({"mass": 2.0}))
    waves = runs.site_waves
    distance = runs.setting.distance
    band = runs.setting.band
    # Each wavenumber of the packet has its own speed and therefore its own loss.
    sent = waves.weight[:, band] * waves.flux[0, :, band] * np.abs(waves.leaving_drive[:, band]) ** 2
    expected = sent @ np.exp(-2.0 * distance / waves.speed[:, band]) / sent.sum()

    assert 1 - waves.taken_before() == pytest.approx(expected, rel=2e-4)
    # The decay is large enough for the comparison to fail without it.
    assert expected < 0.95


def test_the_power_through_springs_is_that_of_the_waves(tmp_path):
    """The energy through a spring three cells from the site is that of the waves, with their decay over three cells.

    Behind the site it is the transmitted energy; before the site it is the arriving energy less the reflected one, as
    the two waves interfere little.
    """
    away = 3
    runs = make_runs(tmp_path, damped_case({"stiffness": 5e-6}, settle=3.0))
    ring = runs.ring
    setting = ring.setting
    amplitude = runs.amplitude(4.0)
    run = ring.run_at_site(amplitude, with_site=True, neighbours=away + 1)
    contact = runs._contact(run, amplitude)
    linear = amplitude * np.array(runs.records[LINEAR]["displacement"])
    waves = runs.site_waves
    force = waves.force(ring.motion(run), linear, contact["onset"], contact["separation"])

    [spring] = [spring for spring in runs.cell.springs if spring.offset]
    amplitudes = waves.amplitudes(force / amplitude)

    def through(cell: int) -> float:
        """Energy in J for a drive of 1 N through the spring from ``cell`` to the next one."""
        i = int(np.flatnonzero(run["cell"].values == cell)[0])
        motion = [run[name].values for name in ("displacement", "velocity")]
        (u, v), (next_u, next_v) = ([f[:, i, spring.start] for f in motion], [f[:, i + 1, spring.end] for f in motion])
        # The dashpot parallel to the spring transmits power as well.
        pull = spring.stiffness * (u - next_u) + spring.damping * (v - next_v)
        return float((pull * (v + next_v) / 2).sum() * setting.interval / amplitude**2)

    def carried(direction: int, spectrum: np.ndarray, cells: float) -> float:
        """Energy in J of waves with a ``spectrum`` at the site, after ``cells`` cells in their direction."""
        there = spectrum * waves.factor[direction] ** cells
        return float((waves.weight * waves.flux[direction] * np.abs(there) ** 2).sum())

    site = setting.site + 1
    assert through(site + away) == pytest.approx(carried(FORWARD, amplitudes[0], away + 0.5), abs=1e-3 * runs.arrived)
    returning = carried(BACKWARD, amplitudes[1], away + 0.5)
    coming = carried(FORWARD, waves.arriving, -away - 0.5)
    assert through(site - away - 1) == pytest.approx(coming - returning, abs=2e-3 * runs.arrived)
    # The reflected energy is large enough for its flux to be tested.
    assert returning > 0.05 * runs.arrived


def test_the_spectrum_at_any_frequency_is_the_transform():
    """The spectrum is the fast transform at its frequencies, and the sum that defines it between them."""
    rng = np.random.default_rng(3)
    # The fast transform of an odd number of samples has no frequency at half the sampling rate.
    signal = rng.normal(size=77)
    step = 1e-3
    at_bins = 2 * np.pi * np.fft.rfftfreq(77, step)
    np.testing.assert_allclose(spectrum_of(signal, step, at_bins), step * np.fft.rfft(signal), atol=1e-14)

    between = np.array([[100.0, 777.0]])
    expected = step * np.exp(-1j * np.multiply.outer(between, step * np.arange(77))) @ signal
    np.testing.assert_allclose(spectrum_of(signal, step, between), expected, atol=1e-14)
