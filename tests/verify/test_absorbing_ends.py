"""Absorbing ends: the energy that a drive sends is its work, runs reflect what is predicted, and the bound is kept."""

from __future__ import annotations

import itertools
from functools import cache

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import trapezoid

from vipetsc.case import Case
from vipetsc.case.absorbing import reflected, sections_of, sources_of
from vipetsc.dynamics import simulate
from vipetsc.io.store import RunMemory
from vipetsc.lattice import waves_at
from vipetsc.lattice.damped import damped_waves
from vipetsc.lattice.ends import Side, condensed, reflections
from vipetsc.lattice.sent import integrate

pytestmark = pytest.mark.parallel(1)
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
    """The energy of the waves that a force sends, an integral over its spectrum, is the work it does in a run.

    The force acts at a wall, near to it, where it meets the waves that the wall reflects, and far from it.
    """
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
