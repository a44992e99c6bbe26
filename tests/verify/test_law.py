"""The scattering law of one contact site: waves by band and direction, energy, dashpots."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import run_of
from tests.one_site import COARSE, LATTICES, law_case
from vipetsc.case import Case, LawCase
from vipetsc.figures.registry import draw
from vipetsc.io.netcdf import open_netcdf
from vipetsc.lattice import Chain, ToneBurst, bloch
from vipetsc.parallel import StopRequest
from vipetsc.spectra import by_direction, wave_energies
from vipetsc.studies.one_site import LINEAR, ScatteringRuns, make_law
from vipetsc.studies.scattering_law import (
    BACKWARD,
    FORWARD,
    POINT_LAYOUT,
    ScatteringLaw,
    ScatteringOutcome,
    matched_clearances,
)


def fractions(runs: ScatteringRuns, *points: float) -> np.ndarray:
    """Fractions of the energy (point, fraction) in single runs with z at ``points``.

    A row has the fractions by band and direction, then the dissipated one and that left in the contact.
    """
    runs.make([*points])
    # A point has one outcome, without the jitter of the clearance.
    runs.jittered = lambda z: [z]
    rows = [runs.outcomes(z)[0] for z in points]
    return np.array([[*row["share"].ravel(), row["dissipated"], row["contact"]] for row in rows])


def make_runs(folder: Path, case: LawCase) -> ScatteringRuns:
    """The runs of the law ``case`` on this rank, before any has been simulated."""
    folder.mkdir(exist_ok=True)
    return ScatteringRuns(case, folder, MPI.COMM_SELF, StopRequest())


@pytest.mark.parametrize("cell", [law_case(name).lattice.unit_cell() for name in LATTICES], ids=[*LATTICES])
@pytest.mark.parametrize("cells", [24, 25])
def test_wave_energies_sum_to_the_lattices_and_go_where_the_wave_goes(cell, cells):
    """Energies of Bloch waves sum to the ring's energy, and a single wave has the direction of its group velocity."""
    rng = np.random.default_rng(1)
    # The sum holds for any state.
    u, v = rng.normal(size=(2, cells, cell.dofs))
    chain = Chain(cell, cells, "periodic")
    whole = 0.5 * (chain.masses() @ v.ravel() ** 2 + u.ravel() @ chain.stiffness_matrix() @ u.ravel())

    energy, speed = wave_energies(cell, u, v)
    assert energy.sum() == pytest.approx(whole, rel=1e-12)
    assert by_direction(energy, speed).sum() == pytest.approx(whole, rel=1e-12)

    number = np.arange(cells)
    # Waves of a wavenumber that fits on the ring travel in either direction.
    for kappa in (2 * np.pi * 5 / cells, -2 * np.pi * 5 / cells):
        point = bloch(cell, kappa)
        wave = np.exp(1j * kappa * number)[:, None] * point.vectors[:, 1]
        # Displacement and this velocity make a travelling wave, whereas a standing one would go in both directions.
        rate = -1j * point.frequency[1] * wave

        single = by_direction(*wave_energies(cell, wave.real, rate.real))
        direction = 0 if point.group_velocity[1] > 0 else 1
        assert single[1, direction] == pytest.approx(single.sum(), rel=1e-12)


@pytest.mark.parametrize("cycles", [1, 2, 5])
def test_the_spectrum_of_a_burst_is_its_transform(cycles):
    """The spectrum of a tone burst is the integral of F(t) exp(-i w t) dt, also at w = 0."""
    burst = ToneBurst(3.0, 100.0, cycles)
    # The burst begins and ends at zero, so that a plain sum is the trapezoidal rule.
    t, dt = np.linspace(0, burst.duration, 200_001, retstep=True)
    w = np.array([0.0, 30.0, 80.0, 100.0, 120.0, 333.0])
    expected = np.exp(-1j * np.outer(w, t)) @ burst.force(t) * dt

    np.testing.assert_allclose(burst.spectrum(w), expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("lattice", LATTICES)
def test_fractions_sum_to_one_and_nothing_happens_below_the_onset(lattice, tmp_path):
    """All energy is transmitted below the onset; above it some is reflected, and the fractions sum to one."""
    runs = make_runs(tmp_path, law_case(lattice))
    transmitted = 2 * runs.setting.band
    reflected = transmitted + 1

    # The points lie below the onset of contact, above it, and where the site is nearly closed.
    quiet, met, hard = fractions(runs, 0.999, 1.3, 6.0)

    alone = np.zeros_like(quiet)
    alone[transmitted] = 1
    np.testing.assert_allclose(quiet, alone, atol=1e-12)
    assert runs.records[0.999]["episodes"] == 0

    for row in (met, hard):
        assert row.sum() == pytest.approx(1, abs=1e-5)
        assert row[-2] == 0  # restitution 1 dissipates nothing
        assert row[transmitted] < 0.99
        # The contact has done something.
        assert row[reflected] > 1e-3


def test_the_bilinear_law_depends_on_amplitude_over_clearance_alone(tmp_path):
    """With bilinear stops motions scale with the clearance: fractions depend on amplitude over clearance alone."""
    # With Hertz's law the fractions would differ between clearances of which one is thirty times the other.
    near = law_case(contacts={"law": "bilinear", "clearance": 1e-3})
    far = law_case(contacts={"law": "bilinear", "clearance": 3e-2})

    first = fractions(make_runs(tmp_path / "near", near), 1.2, 2.0)
    second = fractions(make_runs(tmp_path / "far", far), 1.2, 2.0)

    np.testing.assert_allclose(first, second, atol=1e-6)


def test_a_site_below_the_drive_is_met_forward(tmp_path):
    """The law is the same for a drive at either end, since the four-band cell is its own mirror image."""
    contacts = {"restitution": 0.5, "sites": []}
    below = law_case(drive={"cell": 1, "mass": 1}, contacts=contacts)
    above = law_case(drive={"cell": 300, "mass": 4}, contacts=contacts)

    up = fractions(make_runs(tmp_path / "up", below), 1.2)
    down = fractions(make_runs(tmp_path / "down", above), 1.2)

    np.testing.assert_allclose(up, down, atol=1e-6)


def test_a_wave_sent_by_a_moved_wall_has_the_same_law(tmp_path):
    """A moved wall has the fractions of a force, and its amplitude at the onset is where a run first has contact."""
    wall = law_case(drive={"end": "left"}, law=COARSE | {"distance": 20})
    mass = wall.model().drive_mass + 1
    force = law_case(drive={"cell": 1, "mass": mass}, law=COARSE | {"distance": 20})
    runs = make_runs(tmp_path / "wall", wall)
    moved = fractions(runs, 1.3)
    np.testing.assert_array_equal(moved, fractions(make_runs(tmp_path / "force", force), 1.3))

    del runs.jittered  # restores the method that ``fractions`` replaced
    data = runs.dataset({1.0: np.nan, 1.3: np.nan})
    assert data["amplitude"].attrs["units"] == "m"
    onset = float(data["amplitude"][0])
    contacts = {"sites": [21], "clearance": wall.law.clearance, "restitution": 1.0}
    for factor in (0.9999, 1.0001):
        drive = {"cycles": 8, "band": 2, "at": "max-group-velocity", "end": "left", "amplitude": onset * factor}
        table = {"lattice": {"cells": 80}, "contacts": contacts, "drive": drive, "time": {"end": runs.setting.end}}
        run = run_of(Case.from_table(table))
        assert (run.sizes["episode"] > 0) == (factor > 1)


@pytest.fixture(scope="module")
def refined(tmp_path_factory):
    """The case, the result and the folder of a law whose points are refined to one per cent at its onset."""
    folder = tmp_path_factory.mktemp("law")
    case = law_case(law=COARSE | {"finest": 0.01, "tolerance": 0.1, "samples": 2})
    return case, make_law(case, folder, MPI.COMM_SELF), folder


def test_a_law_is_refined_to_its_onset(refined):
    """The points of a law are as dense as asked for where transmission drops, and the law is drawn from its file."""
    case, law, folder = refined
    transmitted = law.mean.transmitted

    drops = np.flatnonzero((transmitted[:-1] > 0.9) & (transmitted[1:] <= 0.9))
    assert len(drops)
    # Two of the finest steps are allowed, since the jump may lie next to a coarser step.
    assert (law.z[drops + 1] / law.z[drops] < 1.01**2).all()
    assert law.at(0.5).transmitted == law.at(1.0).transmitted == 1
    assert law.at(0.5).upper == 0

    with open_netcdf(folder / "law.h5", "law") as data:
        assert LawCase.of(data).to_toml() == case.to_toml()
        assert np.nanmax(data["interpolation_error"]) < 1
    assert [path.name for path in draw("law", [folder])] == ["law.png"]


def law_by_hand() -> ScatteringLaw:
    """A law of five points: all is transmitted at the onset, and z = 1.2 gives most to the upper band."""
    z = np.array([1.0, 1.02, 1.2, 1.5, 4.0])
    transmitted = np.array([1, 0.8, 0.7, 0.7, 0.9])
    upper = np.array([0, 0.08, 0.15, 0.09, 0.01])
    share = np.zeros((5, 3, 2))
    share[:, 1, 0] = transmitted
    share[:, 2] = upper[:, None] / 2

    # The point without contact has no times of contact.
    times = np.array([np.nan, 0.1, 0.1, 0.1, 0.1])
    mean = ScatteringOutcome(
        share=share,
        transmitted=transmitted,
        reflected=0 * z,
        upper=upper,
        dissipated=1 - transmitted - upper,
        contact=0 * z,
        dashpots=0 * z,
        onset=times,
        separation=times,
        release=times,
    )
    return ScatteringLaw(
        z,
        mean=mean,
        scatter=mean,
        drive_band=1,
        clearance=1e-3,
        peak=1e-4,
        linear_time=np.zeros(1),
        linear_envelope=np.zeros(1),
        about={},
    )


def test_between_points_the_law_is_linear_in_log_z():
    """The law is linear in log z between its points, constant beyond the last, and has no contact below the first."""
    law = law_by_hand()
    assert set(ScatteringOutcome._fields) == set(POINT_LAYOUT)

    # The values asked for lie between two points, on a point, below all points and above all points.
    middle = law.at([[np.sqrt(1.2 * 1.5), 1.02], [0.1, 9.0]])
    np.testing.assert_allclose(middle.upper, [[0.12, 0.08], [0, 0.01]], atol=1e-15)
    assert middle.share.shape == (2, 2, 3, 2)
    assert middle.onset[0, 1] == 0.1
    assert np.isnan(middle.onset[1, 0])

    total = middle.share.sum(axis=(-1, -2)) + middle.dissipated
    np.testing.assert_allclose(total, 1, atol=1e-15)


def test_matched_clearances_meet_each_site_at_the_best_z():
    """Matched clearances are A env(s_k) sqrt(T^k)/z*, where z* has the largest U/(1 - T)."""
    law = law_by_hand()
    z, transmitted = law.matched()
    # U/(1 - T) is 0.15/0.3 = 0.5 at z = 1.2, and 0.08/0.2 = 0.4 next to the onset.
    assert z == 1.2
    assert transmitted == 0.7

    # The envelope differs from site to site.
    linear = SimpleNamespace(envelope=np.linspace(1e-4, 2e-4, 50))
    clearances = matched_clearances(law, linear, [10, 20, 30], -20.0)
    left = np.sqrt(transmitted ** np.arange(3))
    np.testing.assert_allclose(20 * linear.envelope[[9, 19, 29]] * left / clearances, z)

    law.mean.upper[:] = 0
    with pytest.raises(ValueError, match="no energy to bands above"):
        law.matched()


FRACTIONS = ("transmitted", "reflected", "upper", "dissipated", "dashpots")


def damped_case(damping: dict[str, float], **law: Any) -> LawCase:
    """The small law with dashpots and a lossy contact."""
    table = law_case(contacts={"restitution": 0.7}, law=COARSE | law).model_dump(by_alias=True, exclude_none=True)
    table["lattice"]["damping"] = damping
    # The distance was resolved without dashpots, and is left to be resolved again with them.
    del table["law"]["distance"]
    return LawCase.from_table(table)


def damped_fractions(runs: ScatteringRuns, z: float) -> dict[str, float]:
    """The fractions of a single run by name."""
    runs.make([z])
    # A point would otherwise be the mean of several runs, whose scatter exceeds the differences that are compared.
    runs.jittered = lambda point: [point]
    mean, _ = runs.outcomes(z)
    return {name: float(mean[name]) for name in FRACTIONS}


@pytest.fixture(scope="module")
def undamped(tmp_path_factory) -> dict[str, float]:
    """The fractions without dashpots, from the waves at the end of the run."""
    return damped_fractions(make_runs(tmp_path_factory.mktemp("undamped"), damped_case({})), 1.3)


def test_without_damping_the_fluxes_are_the_waves_at_the_end(undamped, tmp_path):
    """With dashpots that take 3e-8 of the wave, fluxes past the site are the energies in all cells at the end."""
    runs = make_runs(tmp_path, damped_case({"mass": 1e-6}))
    assert runs.records[LINEAR]["taken_before"] < 1e-7

    weak = damped_fractions(runs, 1.3)

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
    """The energy through a spring three cells from the site is that of the waves, with their decay over three cells."""
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
