"""Absorbing ends: what a drive sends is its work, what comes back in a run is what is stated, and the bound is kept."""

from __future__ import annotations

import itertools
from functools import cache

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import trapezoid

from vipetsc.case import Case, CaseError
from vipetsc.case.absorbing import reflected, sections_of, sources_of
from vipetsc.cli.case_rows import describe_ends
from vipetsc.dynamics import simulate
from vipetsc.io.store import RunMemory
from vipetsc.lattice import waves_at
from vipetsc.lattice.damped import damped_waves
from vipetsc.lattice.ends import Side, condensed, reflections
from vipetsc.lattice.sent import integrate

pytestmark = pytest.mark.parallel(1)
# Twelve cycles near the lower edge of band 2, which the spectrum reaches.
BURST = {"amplitude": 1.0, "frequency": 760.0, "cycles": 12}


# Of the run whose waves come back: cells, those of its end, those from the force to the end, duration in s, samples.
CELLS = 740
LENGTH = 20
BEFORE = 3
END = 2.6
SAMPLES = 4000


def case(lattice, drive, stride=1, **time):
    table = {"lattice": {"preset": "four-band", "ends": "fixed"} | lattice, "contacts": {"sites": 0}, "drive": drive}
    return Case.from_table(table | {"time": {"engine": "propagator"} | time, "output": {"stride": stride}})


def with_returning_waves(lattice):
    """A case whose force acts three cells before an end of 20 cells; the field is kept at its end alone."""
    drive = BURST | {"cell": CELLS - LENGTH - BEFORE}
    return case(lattice, drive, stride=SAMPLES, end=END, sample_interval=END / SAMPLES)


@pytest.fixture(scope="module")
def goes_on():
    """The chain of a lattice that goes on beyond the end, and its run."""
    of = with_returning_waves({"cells": 2 * CELLS})
    return of.model().chain, run(of)


def run(of):
    memory = RunMemory(MPI.COMM_SELF)
    simulate(of, memory)
    return memory.dataset


def source_and_sections(of):
    lattice = of.lattice
    cell = lattice.unit_cell()
    end = lattice.absorbing
    (source,) = sources_of(of.model().drives, cell, lattice.ends, lattice.cells)
    return source, sections_of(end, cell, lattice.ends, end.cells, end.strength)


@pytest.mark.slow
@pytest.mark.parametrize(("cell", "mass"), [(1, 1), (5, 2), (100, 3)])
def test_what_a_drive_sends_is_its_work(cell, mass):
    """At a wall, near to it, where the waves that it sends back are in phase, and far from it."""
    end = {"cells": 20, "strength": 200.0}
    of = case({"cells": 300, "absorbing": end}, BURST | {"cell": cell, "mass": mass}, end=0.105)
    work = run(of)["energy/work"].values[-1]

    source, _ = source_and_sections(of)
    # At the right alone: a wall at the left reflects what goes there.
    (sent,) = integrate(lambda omegas: source.sent(omegas, "right").sum(axis=1)[None], source.edges())
    assert sent == pytest.approx(work, rel=1e-3)


def stated(of):
    source, sections = source_and_sections(of)
    return reflected([source], sections)


@cache
def waves_of(cell, omega):
    """The waves at a frequency, and the largest group velocity in cells/s: the same for ends of any strength."""
    return damped_waves(cell, omega), max((wave[2] for wave in waves_at(cell, omega)), default=0.0)


def returning(source, section, slowest):
    """Fractions of what is sent that come back as waves faster than each of ``slowest`` (cells/s), on a fixed grid."""
    angles = (np.arange(60) + 0.5) / 60 * np.pi / 2
    sent = 0.0
    back = np.zeros(len(slowest))
    for low, high in itertools.pairwise(source.edges().tolist()):
        # Dense near the edges of bands, where waves are slow.
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
            # Of no least speed all waves count, those of a gap as well, in which none travels.
            back += weight * (energy @ fraction) * ((speed > np.array(slowest)) | (np.array(slowest) == 0))
    return back / sent


@pytest.mark.slow
@pytest.mark.parametrize("strength", [60.0, 230.0])
def test_what_comes_back_in_a_run_is_what_is_stated(goes_on, strength):
    """The wave that comes back is the difference to a lattice that goes on.

    The force acts three cells before the end, and so far from the other one that nothing comes from there. Waves turn
    somewhere in the end's 20 cells: those that come back in 2.6 s are faster than 6/2.6 cells/s, and among them are all
    that are faster than 46 cells in what is left of it after the burst.
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
    # Slow waves are still within the end or before it: the run lies between what has come back for certain and all.
    assert 0.98 * least < measured < 1.02 * some
    # The weak end reflects fast waves, the strong one slow waves: both bounds are tested.
    assert (least > 0.9 * every) == (strength < 100)
    assert measured > 0.35 * every


@pytest.mark.slow
def test_the_end_that_is_chosen_keeps_its_bound():
    """Where an end was chosen by the spectrum's main lobe alone, 0.8 % came back from it."""
    of = case({"cells": 1200, "absorbing": {}}, BURST | {"cell": 400})
    source, sections = source_and_sections(of)
    (back,) = returning(source, sections[0], [0])
    assert of.lattice.absorbing.cells > 160
    assert back < 1.01e-3
    assert f"{reflected([source], sections):.1e} of all waves that the drive sends" in describe_ends(of)


@pytest.mark.slow
def test_both_ends_absorb_what_each_of_them_gets():
    one, both = (
        case({"cells": 300, "absorbing": {"end": end, "cells": 20, "strength": 200.0}}, BURST | {"cell": 150})
        for end in ("right", "both")
    )
    fractions = [stated(of) for of in (one, both)]
    # In proportion to what each side sends, so that a second end leaves the fraction as it is.
    assert fractions[1] == pytest.approx(fractions[0], rel=0.02)
    # Next to a wall that the end does not replace, waves at the band's edge are not sent at all.
    at_wall = case({"cells": 300, "absorbing": {"cells": 20, "strength": 200.0}}, BURST)
    assert stated(at_wall) < 0.2 * fractions[0]


@pytest.mark.slow
def test_where_no_end_keeps_the_bound_the_message_names_the_remedy():
    with pytest.raises(CaseError, match=r"lattice\.absorbing\.reflection.*slow waves at band edges; allow more"):
        case({"cells": 300, "absorbing": {}}, BURST | {"cell": 100})


def test_drives_without_an_end_or_a_sine():
    """A sine that goes on is judged at its frequency, a force that is held by the transform of a step."""
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
    # The transform of a constant from there on, in the limit of a slow decay.
    tail = np.exp(-1j * omegas * waveform.settled) / (1j * omegas)
    assert waveform.spectrum(omegas) == pytest.approx(sums + tail, rel=1e-5)
    assert 0 < reflected([held], sections) < 1
