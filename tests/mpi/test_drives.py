"""Runs under drives of cells on different ranks and of a moved end have the same bits on any number of ranks."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import StopAt, assert_same_bits, datasets, on_two, small_case
from tests.mpi.test_partition import runs_alike
from vipetsc.dynamics import simulate
from vipetsc.dynamics.observers import Observer

DRIVES = [
    {"waveform": "impulse", "amplitude": 2e-2, "duration": 3e-4, "cell": 20, "mass": 3},
    {"waveform": "chirp", "amplitude": 8.0, "frequency": 900.0, "bandwidth": 500.0, "duration": 0.02, "cell": 11},
    {"waveform": "step", "amplitude": 1e-4, "ramp": 2e-3, "end": "right"},
]


class InParts(Observer):
    """An observer of blocks of ten samples: a run can stop after each block."""

    name = "in-parts"
    longest = 10


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("engine", ["ts", *on_two("propagator")])
def test_same_bits_under_several_drives(folder, engine):
    """An impulse, a chirp and a moved end, besides the first drive, act alike on any number of ranks."""
    runs_alike(folder, small_case(drive={"more": DRIVES}, time={"end": 0.022, "engine": engine}))


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize(("engine", "looks"), [("ts", (31, 36)), ("propagator", (2, 1))])
def test_a_damped_wall_has_the_same_bits_and_goes_on(folder, engine, looks):
    """The work and the losses of a wall's dashpots do not depend on the ranks, on stops, or on a later end."""
    lattice = {"damping": {"stiffness": 1e-5}}
    case = small_case(drive={"more": DRIVES}, lattice=lattice, time={"end": 0.012, "engine": engine})
    simulate(case, folder / "whole", observers=[InParts])
    for number in looks:
        assert simulate(case, folder / "parts", stop=StopAt(number), observers=[InParts]).resumable
    simulate(case, folder / "parts", observers=[InParts])
    assert_same_bits(datasets(folder / "whole/run.h5"), datasets(folder / "parts/run.h5"))

    longer = small_case(drive={"more": DRIVES}, lattice=lattice, time={"end": 0.024, "engine": engine})
    simulate(longer, folder / "parts", extend=True)
    simulate(longer, folder / "long")
    assert_same_bits(datasets(folder / "long/run.h5"), datasets(folder / "parts/run.h5"))
    runs_alike(folder, longer)


@pytest.mark.parallel([1, 2, 3])
# The time stepper looks for a request to stop after every step, the propagator after every ten samples: both runs stop
# while the drives act, and a second time during a contact.
@pytest.mark.parametrize(("engine", "looks"), [*on_two(("ts", (31, 36))), ("propagator", (2, 1))])
def test_a_run_goes_on_amid_its_drives(folder, engine, looks):
    """A run that is stopped while its drives act and a contact is closed, and resumed, has the bits of a whole one."""
    case = small_case(drive={"more": DRIVES}, time={"end": 0.012, "engine": engine})
    simulate(case, folder / "whole", observers=[InParts])

    for number in looks:
        stopped = simulate(case, folder / "parts", stop=StopAt(number), observers=[InParts])
        assert stopped.resumable
    assert simulate(case, folder / "parts", resume=True, observers=[InParts]).complete

    whole = datasets(folder / "whole/run.h5")
    last = stopped.statistics["end"]
    assert np.any((whole["impacts/onset"] < last) & (last < whole["impacts/separation"]))
    assert_same_bits(whole, datasets(folder / "parts/run.h5"))
