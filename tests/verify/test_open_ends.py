"""Waves that leave: open ends, absorbing ends, complex bands of damped cells."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import trapezoid

from tests.conftest import run_of, small_case
from tests.verify.test_responses import rounded_cell
from vipetsc.case import Case
from vipetsc.case.absorbing import reflected, reflected_at, sections_of, sources_of
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.warnings import losses
from vipetsc.dynamics import simulate
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.ts.integrator import Integrator
from vipetsc.figures import runs
from vipetsc.io.store import RunMemory
from vipetsc.lattice import (
    Chain,
    ModalCompliance,
    OpenCompliance,
    Spring,
    UnitCell,
    WaveCompliance,
    bloch,
    diatomic,
    four_band,
    max_group_velocity,
    pass_bands,
    waves_at,
)
from vipetsc.lattice.damped import KAPPAS, damped_bloch, damped_waves, decay_length, fitted_dashpots
from vipetsc.lattice.ends import Side, absorber, condensed, reflection, reflections
from vipetsc.lattice.sent import integrate
from vipetsc.lattice.sites import Pair, sites_at
from vipetsc.modes.response.condensation import compliance_of
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state

CELL = UnitCell((1.0, 0.3), (Spring(0, 0, 1.0, offset=1), Spring(0, 1, 0.5)), host=0, resonator=1)
SPRINGS = [{"start": 1, "end": 1, "stiffness": 1.0, "next_cell": True}, {"start": 1, "end": 2, "stiffness": 0.5}]


def absorbing(end: str = "both", **nfrc: Any) -> dict[str, Any]:
    """The case of a two-mass lattice with an absorbing ``end`` or both, one contact site and a force next to it."""
    lattice = {"cells": 12, "cell": {"masses": [1.0, 0.3], "springs": SPRINGS, "contact": [1, 2]}}
    ends = {"end": end, "cells": 3, "strength": 2.0}
    options = {"source": "force", "over": "amplitude", "range": [2.0, 2.5], "fixed": [0.7], "harmonics": 9}
    return {
        "name": "open",
        "lattice": lattice | {"absorbing": ends},
        "contacts": {"law": "bilinear", "stiffness": 3.0, "restitution": 1.0, "sites": [6], "clearance": 0.3},
        "drive": {"waveform": "harmonic", "amplitude": 0.3, "frequency": 0.7, "cell": 5, "mass": 1},
        "time": {"end": 10.0},
        "nfrc": options | {"open_ends": True} | nfrc,
    }


SMOOTH = absorbing()
SMOOTH["lattice"]["cell"] = SMOOTH["lattice"]["cell"] | {"springs": [SPRINGS[0] | {"cubic": 1.0}, SPRINGS[1]]}


@pytest.mark.parametrize("ends", ["fixed", "free"])
def test_with_both_ends_open_the_lattice_is_endless(ends):
    """With both ends open the compliance is that of Bloch waves, in bands, gaps, at rest and for growing motions."""
    chain = Chain(CELL, 9, ends, sites=sites_at([2, 6], CELL.pair))
    here = OpenCompliance(chain, ((0, 0),), open_ends=("left", "right"))
    endless = WaveCompliance(chain, ((0, 0),), infinite=True)
    omega = np.array([0.31, 0.9, 1.2, 1.6, 2.2, 3.5, 1.1 - 0.01j, -0.7 - 0.02j, -0.7])
    np.testing.assert_allclose(here.response(omega), endless.response(omega), rtol=1e-6)
    # A constant force on one mass moves an endless lattice without bound. The opposite forces of a contact do not.
    np.testing.assert_allclose(here.at(0.0), endless.at(0.0), atol=1e-4)
    forces = [0.3, -2.0, 1.5]
    np.testing.assert_allclose(here.field(0.9, forces, range(9)), endless.field(0.9, forces, range(9)), rtol=1e-6)


@pytest.mark.parametrize("end", ["left", "right"])
def test_nothing_comes_back_over_whole_bands(end):
    """An open end reflects less than 1e-7 of the energy of waves in all bands, up to 1e-3 of a band from its edges."""
    chain = Chain(CELL, 12, "fixed", sites=sites_at([5], CELL.pair))
    driven = 0 if end == "right" else 11
    lattice = OpenCompliance(chain, ((driven, 0),), open_ends=(end,))
    worst = made_for_one = 0.0
    absorbers = sections_of(NfrcCase.from_table(absorbing()).lattice.absorbing, CELL, "fixed", 60, 0.4)
    for band in pass_bands(CELL):
        for place in (1e-3, 1e-2, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 0.999):
            omega = band.low + place * (band.high - band.low)
            u = lattice.field(omega, [0.0, 1.0], [4, 5])[:, 0]
            ((_, kappa, speed),) = waves_at(CELL, omega)
            towards = np.exp(-1j * kappa * np.sign(speed)) ** (1 if end == "right" else -1)
            forth, back = np.linalg.solve([[1.0, 1.0], [towards, 1 / towards]], u)
            worst = max(worst, abs(back / forth) ** 2)
            made_for_one = max(made_for_one, reflected_at(omega, absorbers))
    assert worst < 1e-7
    # Dashpots over 60 cells, chosen for one frequency, reflect more than a tenth near the edges of the bands.
    assert made_for_one > 0.1


def test_dashpots_cells_that_differ_and_contacts_to_ground_stay_what_they_are():
    """An open end keeps dashpots, rounded cells and contacts with the ground: the compliance is a long lattice's.

    The long lattice has 240 cells and a strong loss, so that nothing comes back from its far end.
    """
    pairs = (Pair(-1, 1), Pair(0, 0, offset=1))
    short = Chain(rounded_cell((0.05, 0.2)), 5, "fixed", sites=sites_at([1, 3], pairs))
    long = Chain(rounded_cell((0.05, 0.2)), 240, "fixed", sites=sites_at([1, 3], pairs))
    here = OpenCompliance(short, ((0, 0),), open_ends=("right",))
    omega = np.array([0.6, 1.1 - 0.1j, 1.5, 2.5])
    np.testing.assert_allclose(here.response(omega), ModalCompliance(long, ((0, 0),)).response(omega), rtol=1e-6)


def test_states_are_those_of_the_endless_lattice():
    """A steady state has the harmonics and stability of the endless lattice's, as the ends' dashpots are left out."""
    case = NfrcCase.from_table(absorbing())
    assert isinstance(compliance_of(case), OpenCompliance)
    assert not compliance_of(case).chain.is_damped
    table = absorbing(infinite=True, open_ends=False)
    del table["lattice"]["absorbing"]
    measured = []
    for one in (case, NfrcCase.from_table(table)):
        states = SteadyStates(one, 1.0, 0.7)
        measured.append(states.measured(first_state(states).xi))
    here, endless = measured
    assert here.episodes > 0
    np.testing.assert_allclose(here.harmonics, endless.harmonics, atol=1e-7)
    assert here.unstable == endless.unstable


# Twelve cycles near the lower edge of band 2: their spectrum contains the edge, where waves are slow.
BURST = {"amplitude": 1.0, "frequency": 760.0, "cycles": 12}
# The run whose waves come back: the cells of the lattice, of its absorbing end, and between the force and that end; the
# duration in s and the number of samples.
CELLS = 740
LENGTH = 20
BEFORE = 3
END = 2.6
SAMPLES = 4000


def case(lattice, drive, stride=1, **time):
    """A case of a four-band lattice without contacts; ``time`` updates the table [time]."""
    table = {"lattice": {"preset": "four-band", "ends": "fixed"} | lattice, "contacts": {"sites": 0}, "drive": drive}
    return Case.from_table(table | {"time": {"engine": "propagator"} | time, "output": {"stride": stride}})


def with_returning_waves(lattice):
    """A case whose force acts three cells before an end of 20 cells; the field is recorded at the last time only."""
    drive = BURST | {"cell": CELLS - LENGTH - BEFORE}
    return case(lattice, drive, stride=SAMPLES, end=END, sample_interval=END / SAMPLES)


@pytest.fixture(scope="module")
def goes_on():
    """The chain of a lattice with uniform cells in place of the absorbing end and beyond it, and its run."""
    of = with_returning_waves({"cells": 2 * CELLS})
    return of.model().chain, run(of)


def run(of):
    """The result of a run of the case ``of``, as a dataset."""
    memory = RunMemory(MPI.COMM_SELF)
    simulate(of, memory)
    return memory.dataset


def source_and_sections(of):
    """The drive of the case ``of`` as a source of waves, and its absorbing ends as sections."""
    lattice = of.lattice
    cell = lattice.unit_cell()
    end = lattice.absorbing
    (source,) = sources_of(of.model().drives, cell, lattice.ends, lattice.cells)
    return source, sections_of(end, cell, lattice.ends, end.cells, end.strength)


@pytest.mark.parametrize(("cell", "mass"), [(5, 2)])
def test_what_a_drive_sends_is_its_work(cell, mass):
    """The energy of the waves that a force sends, an integral over its spectrum, is the work it does in a run."""
    end = {"cells": 20, "strength": 200.0}
    of = case({"cells": 300, "absorbing": end}, BURST | {"cell": cell, "mass": mass}, end=0.105)
    work = run(of)["energy/work"].values[-1]

    source, _ = source_and_sections(of)
    # All waves leave to the right, as the wall at the left reflects those that go there.
    (sent,) = integrate(lambda omegas: source.sent(omegas, "right").sum(axis=1)[None], source.edges())
    assert sent == pytest.approx(work, rel=1e-3)


@cache
def waves_of(cell, omega):
    """The waves at ``omega`` (rad/s) and their largest group velocity in cells/s, which no absorbing end changes."""
    return damped_waves(cell, omega), max((wave[2] for wave in waves_at(cell, omega)), default=0.0)


def returning(source, section, slowest):
    """The fractions of the sent energy that come back as waves faster than each of ``slowest`` (cells/s).

    The integral over the spectrum is a sum over a fixed grid.
    """
    angles = (np.arange(60) + 0.5) / 60 * np.pi / 2
    sent = 0.0
    back = np.zeros(len(slowest))
    for low, high in itertools.pairwise(source.edges().tolist()):
        # The grid is dense near the edges of bands, where waves are slow.
        omegas = low + (high - low) * np.sin(angles) ** 2
        weights = (high - low) * np.sin(2 * angles) * np.pi / 2 / len(angles)
        energies = source.sent(omegas, section.end)
        blocks = condensed(section, omegas)
        for omega, weight, energy, z in zip(omegas.tolist(), weights, energies, blocks, strict=True):
            if not energy.any():
                continue
            waves, speed = waves_of(source.cell, omega)
            fraction = reflections(z, waves, section.end)
            sent += weight * energy.sum()
            # A least speed of 0 counts all waves, also those at a frequency in a gap, where no wave travels.
            back += weight * (energy @ fraction) * ((speed > np.array(slowest)) | (np.array(slowest) == 0))
    return back / sent


@pytest.mark.parametrize("strength", [230.0])
def test_what_comes_back_in_a_run_is_what_is_stated(goes_on, strength):
    """The energy that comes back in a run lies between two predictions, for fast waves alone and for all that return.

    The reflected wave is the difference between the run and one of a lattice that goes on beyond the end. The force
    acts three cells before the end, and so far from the other end that nothing returns from there. Waves turn back
    somewhere within the end's 20 cells and travel 6 to 46 cells. All that have come back after 2.6 s are faster than
    6/2.6 cells/s. Those that travel 46 cells in the time that the burst leaves of 2.6 s have certainly come back.
    """
    with_end = with_returning_waves({"cells": CELLS, "absorbing": {"cells": LENGTH, "strength": strength}})
    ours = run(with_end)
    chain, longer = goes_on
    fields = []
    for name in ("displacement", "velocity"):
        field = np.zeros(longer[name].shape[1:])
        uniform = slice(0, CELLS - LENGTH)
        field[uniform] = (ours[name][-1, uniform] - longer[name][-1, uniform]).values
        fields.append(field.ravel())
    u, v = fields
    energy = (chain.masses() @ v**2 + u @ (chain.stiffness_matrix() @ u)) / 2
    sent = ours["energy/work"].values[-1] / 2
    measured = energy / sent

    source, (section,) = source_and_sections(with_end)
    burst = source.waveform.duration
    every, some, least = returning(source, section, [0, 2 * BEFORE / END, 2 * (BEFORE + LENGTH) / (END - burst)])
    assert reflected([source], [section]) == pytest.approx(every, rel=0.01)
    # Slow waves are still on their way when the run ends: what it measures lies between what has certainly come back
    # and what may have come back.
    assert 0.98 * least < measured < 1.02 * some
    # The weak end reflects fast waves, the strong one slow waves: both bounds are tested.
    assert (least > 0.9 * every) == (strength < 100)
    assert measured > 0.35 * every


def test_drives_without_an_end_or_a_sine():
    """The reflection of a lasting sine is that at its frequency; that of a held force uses the transform of a step."""
    end = {"cells": 90, "absorbing": {"cells": 20, "strength": 200.0}}
    sine = case(end, {"waveform": "harmonic", "frequency": 1023.0})
    source, sections = source_and_sections(sine)
    z = condensed(sections[0], np.array([1023.0]))[0]
    waves = damped_waves(source.cell, 1023.0)
    # Waves that decay carry no energy to the end.
    carries = Side.at("right", waves).decay() < 1e-7
    assert reflected([source], sections) == pytest.approx(reflections(z, waves, "right")[carries].max())

    step = case(end, {"waveform": "step", "ramp": 0.01})
    held, sections = source_and_sections(step)
    waveform = held.waveform
    omegas = np.array([50.0, 300.0])
    times = np.linspace(0, waveform.settled, 20001)
    sums = trapezoid(waveform.force(times) * np.exp(-1j * omegas[:, None] * times), times)
    # The rest is constant; its transform is that of a decaying force as the decay tends to zero.
    tail = np.exp(-1j * omegas * waveform.settled) / (1j * omegas)
    assert waveform.spectrum(omegas) == pytest.approx(sums + tail, rel=1e-5)
    assert 0 < reflected([held], sections) < 1


KAPPA = np.linspace(0.2, 3.0, 7)


def damped(cell, alpha=0.0, beta=0.0, extra=(0.0, 0.0, 0.0, 0.0)):
    """``cell`` with Rayleigh damping alpha M + beta K, and ``extra`` dashpots (N s/m) parallel to its springs."""
    springs = tuple(replace(s, damping=beta * s.stiffness + c) for s, c in zip(cell.springs, extra, strict=False))
    return replace(cell, springs=springs, grounding=tuple(alpha * m for m in cell.masses))


@pytest.mark.parametrize("cell", [four_band(), diatomic()])
def test_rayleigh_damping_has_its_closed_form(cell):
    """Damped waves have zeta = (alpha/omega + beta omega)/2, and at a real frequency decay over v_g/(zeta omega)."""
    alpha = 20.0
    beta = 2e-5
    omega = bloch(cell, KAPPA).frequency
    point = damped_bloch(damped(cell, alpha, beta), KAPPA)
    assert point.ratio == pytest.approx((alpha / omega + beta * omega) / 2, rel=1e-10)
    assert np.abs(point.rate) == pytest.approx(omega, rel=1e-10)

    # The decay of weak damping is of first order in it.
    weak = damped(cell, 1e-3 * alpha, 1e-3 * beta)
    _, frequency, speed = max_group_velocity(cell, 2)
    zeta = 1e-3 * (alpha / frequency + beta * frequency) / 2
    assert decay_length(weak, frequency) == pytest.approx(speed / (zeta * frequency), rel=1e-4)
    assert decay_length(cell, frequency) == np.inf


@pytest.mark.parametrize("cell", [four_band(), diatomic()])
def test_waves_of_a_real_frequency_solve_the_bloch_equation(cell):
    """Waves at a frequency of a band satisfy (K(kappa) - omega^2 M) u = 0, where exp(i kappa) is the wave's factor."""
    _, frequency, _ = max_group_velocity(cell, 2)

    waves = damped_waves(cell, frequency)

    for factor, shape in zip(waves.factor, waves.shape.T, strict=True):
        inertia = frequency**2 * np.array(cell.masses) * shape
        residual = cell.stiffness_matrix(np.angle(factor)) @ shape - inertia
        assert np.abs(residual).max() < 1e-8 * frequency**2


def test_overdamped_waves_are_the_slow_ones():
    """The rate of an overdamped wave is the root of s^2 + alpha s + omega^2 = 0, alpha > 2 omega, nearer to zero."""
    alpha = 1e5
    omega = bloch(diatomic(), 1.0).frequency

    rate = damped_bloch(damped(diatomic(), alpha=alpha), 1.0).rate

    slow = -alpha / 2 + np.sqrt(alpha**2 / 4 - omega**2)
    assert np.sort(rate.real) == pytest.approx(np.sort(slow), rel=1e-8)
    assert rate.imag == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("number", [1, 3])
def test_bloch_waves_of_a_damped_ring_decay_with_their_complex_rates(number):
    """The engine ``ts`` moves each wave as u = Re(phi exp(i kappa n + s t)), to 1e-8."""
    cells = 8
    half = 4 * cells
    cell = damped(four_band(), 30.0, 1e-5, (0.3, 0.0, 0.1, 0.02))
    model = small_case(contacts={"sites": 0}, lattice={"cells": cells, "ends": "periodic"}).model()
    silent = replace(model.drives[0], waveform=replace(model.drive, amplitude=0.0))
    model = replace(model, chain=Chain(cell, cells, "periodic"), drives=(silent,))
    kappa = 2 * np.pi * number / cells
    point = damped_bloch(cell, kappa)
    end = 0.01

    for s, phi in zip(point.rate, point.vectors.T, strict=True):
        wave = phi * np.exp(1j * kappa * np.arange(cells))[:, None]
        # Velocities are larger than displacements by |s|.
        tight = replace(model, rtol=1e-12, atol=(1e-12, 1e-12 * abs(s)))
        engine = Integrator(tight, Layout(model, MPI.COMM_SELF))
        engine.state.array[:half] = wave.real.T.ravel()
        engine.state.array[half : 2 * half] = (s * wave).real.T.ravel()

        engine.advance(end)

        u = engine.state.array_r[:half].reshape(4, cells).T
        expected = (wave * np.exp(s * end)).real
        assert np.abs(u - expected).max() < 1e-8 * np.abs(expected).max()
        engine.destroy()


def test_a_packet_comes_back_as_computed():
    """A weak absorbing end leaves the predicted fraction of a packet's energy, within ten per cent."""
    cell = four_band("calibrated")
    kappa = 1.8
    table = {
        "lattice": {"preset": "four-band", "cells": 130, "absorbing": {"cells": 10, "strength": 400.0}},
        "contacts": {"sites": 0},
        "initial": {"kind": "packet", "band": 2, "wavenumber": kappa, "cell": 70, "width": 8, "amplitude": 1e-3},
        "time": {"end": 0.26, "engine": "propagator"},
    }
    run = run_of(Case.from_table(table))

    energy = (run["energy/kinetic"] + run["energy/spring"]).values
    omega = float(bloch(cell, kappa).frequency[1])
    computed = reflection(absorber(cell, "fixed", 10, 400.0), omega, 10)
    # The reflection is large enough to be measured, and small enough for the end to absorb most of the packet.
    assert 1e-3 < computed < 0.1
    assert energy[-1] / energy[0] == pytest.approx(computed, rel=0.1)


def lossy(cell, loss):
    """``cell`` with dashpots fitted to a ``loss``, a table of loss factors by band number."""
    grounding, springs = fitted_dashpots(cell, tuple(loss.items()))
    return replace(damped(cell, extra=springs.tolist()), grounding=tuple(grounding.tolist()))


@pytest.mark.parametrize("loss", [{2: 0.02}, {2: 0.002, 4: 0.003}, {1: 0.001, 2: 0.001, 3: 0.001, 4: 0.001}])
def test_dashpots_fitted_to_a_loss_are_the_best_by_the_complex_dispersion(loss):
    """Fitted dashpots are not negative, and no change of one by 3 % of the largest comes nearer to the loss."""
    cell = four_band("calibrated")
    bands = np.array([*loss]) - 1

    def ratios(grounding, springs):
        varied = replace(damped(cell, extra=springs), grounding=tuple(grounding))
        return 2 * damped_bloch(varied, KAPPAS).ratio[:, bands] / [*loss.values()]

    def misfit(grounding, springs):
        return float(((ratios(grounding, springs) - 1) ** 2).sum())

    fitted = lossy(cell, loss)
    dashpots = np.array([fitted.grounding, [spring.damping for spring in fitted.springs]])
    assert dashpots.min() >= 0
    if len(loss) == 1:
        # The loss of a single band can be met at all wavenumbers.
        assert ratios(*dashpots) == pytest.approx(1.0, abs=4e-3)

    least = misfit(*dashpots)
    # A minimum over all dashpots is a minimum in each: every one is changed alone, in both directions.
    for place in np.ndindex(dashpots.shape):
        for step in (0.03, -0.03):
            changed = dashpots.copy()
            changed[place] = max(changed[place] + step * dashpots.max(), 0.0)
            assert misfit(*changed) >= least * (1 - 1e-3)


def test_a_loss_by_bands_is_resolved_to_dashpots():
    """A loss by bands becomes dashpots of the resolved case, and a warning gives the loss where it cannot be met."""
    case = small_case(
        lattice={"damping": {"loss": {"2": 0.02}}, "profiles": {"masses[1]": {"cells": [3], "factor": 2.0}}}
    )
    resolved = case.lattice.damping
    chain = case.model().chain

    assert Case.from_toml(case.to_toml()) == case
    assert chain.cell == lossy(four_band("calibrated"), {2: 0.02})
    assert [*chain.cell.grounding] == resolved.grounding
    assert [s.damping for s in chain.cell.springs] == resolved.springs
    # A factor of one mass leaves the dashpots as in all cells.
    assert [name for name, _ in chain.variation.items()] == ["masses"]
    assert chain.is_damped

    asked, least, mean, most = losses(case.lattice)[1]
    assert asked == 0.02
    assert 0.0199 < least < mean < most < 0.0201
    assert mean == pytest.approx(0.02, rel=1e-3)
    assert not any("loss" in sentence for sentence in case.warnings())

    # No dashpots meet the loss in both bands.
    flat = small_case(lattice={"damping": {"loss": {"1": 0.02, "2": 0.02}}})
    assert any("band 1 0.00" in sentence and "requested 0.02" in sentence for sentence in flat.warnings())


def test_bands_of_a_damped_cell_show_its_decay():
    """A third panel shows the decay of waves per cell, zeta omega/v_g in a band and much more in a gap."""
    cell = small_case(lattice={"damping": {"loss": {"2": 0.02}}}).lattice.unit_cell()
    *_, decay = runs.bands(cell, 1000.0).axes
    rates = np.asarray(decay.lines[0].get_xdata())
    omega = np.asarray(decay.lines[0].get_ydata())

    # A loss of 0.02 is twice the damping ratio.
    _, frequency, speed = max_group_velocity(cell, 2)
    in_band = np.interp(frequency / 1e3, omega, rates)
    assert in_band == pytest.approx(0.01 * frequency / speed, rel=1e-2)
    in_gap = rates[np.argmin(np.abs(omega - 0.65))]
    assert in_gap > 20 * in_band

    # An undamped cell has no third panel.
    assert len(runs.bands(four_band(), 1000.0).axes) == 2


@pytest.mark.parametrize(("bound", "cells", "loss"), [(0.1, 10, 8), (1e-4, 10, 10), (1e-5, 10, 13), (1e-7, 20, 17)])
def test_an_end_is_the_shortest_and_weakest_that_takes_enough(bound, cells, loss):
    """Its dashpots leave exp(-loss) of the fastest wave's energy: 2 v loss = strength times length, v in cells/s."""
    case = Case.from_table({}, [f"lattice.absorbing.reflection={bound}"])
    fastest = max(wave[2] for wave in waves_at(case.lattice.unit_cell(), case.drive.frequency))
    end = case.lattice.absorbing
    assert end.cells == cells
    assert end.strength * end.cells == pytest.approx(2 * fastest * loss, rel=1e-12)
