"""Steady states that slow sweeps of the frequency reach: two runs, one to higher frequencies and one to lower ones.

A sweep comes to states that no curve from the beginning of the range meets, such as those from which a sweep down jumps
if the range ends between two folds. The drive is a chirp from rest, so slow that the motion stays near a steady state.
Newton's method begins with the harmonics of one period of the motion at each place; where it does not converge, no
state is found.

The frequency of the chirp passes the range [low, high] at a constant rate in the time T = count ``nfrc.isola_periods``
2 pi/((low + high)/2). The place number n of ``count``, low + (high - low) (n + 1/2)/count, is therefore passed at
T (n + 1/2)/count, in the order of the sweep. A motion that has not settled there, or is not periodic with the drive,
is a guess of little use.
"""

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from mpi4py import MPI

import numpy as np
from scipy.interpolate import CubicSpline

from vipetsc.case import Case
from vipetsc.dynamics.run import simulate
from vipetsc.io.store import RunMemory
from vipetsc.lattice import ModalCompliance, Pieces
from vipetsc.modes.response.equations import FAILURES
from vipetsc.modes.response.steady import SteadyStates

# Samples of a run in a period of the drive, at least, and values of the spline through them in one period. The
# harmonics up to PER_PERIOD/2 - 1 are guessed, the others are 0.
PER_PERIOD = 32
# Duration of the drive's ramps over the time between two places: shorter than the half of that time after which the
# first place comes.
RAMP = 0.25


def swept_states(states: SteadyStates, places: np.ndarray) -> list[list[np.ndarray]]:
    """Unknowns (n + 1,) of the steady states that the two sweeps have reached: a list for each of ``places``.

    ``places`` (count,) are scaled frequencies, the middles of equal parts of the range. Each sweep takes
    ``nfrc.isola_periods`` periods from one to the next. Raises CaseError if a run needs more memory than there is.
    """
    of_places: list[list[np.ndarray]] = [[] for _ in places]
    for direction in (1, -1):
        numbers = range(len(places))[::direction]
        for number, motion in zip(numbers, motions(states, len(places), direction), strict=False):
            p = float(places[number])
            guess = states.balance.pack(motion) / states.clearance
            with suppress(*FAILURES):
                of_places[number].append(states.at(np.append(guess, p), p))
    return of_places


def motions(states: SteadyStates, count: int, direction: int) -> Iterator[np.ndarray]:
    """Harmonics (pair, order) in m of the motion of a sweep at ``count`` places, in the order in which it passes them.

    ``direction`` is 1 to higher frequencies, -1 to lower ones. Phases are those of a drive cos(theta). A run that ends
    early has fewer places.
    """
    case = _sweep(states, count, direction)
    memory = RunMemory(MPI.COMM_SELF)
    simulate(case, memory)
    run = memory.dataset
    drive = case.model().drive
    assert run is not None and isinstance(drive, Pieces)

    times = run["time"].to_numpy()
    phases = drive.phase(times)
    displacements = run["displacement"].to_numpy().reshape(len(times), -1)
    pairs = ModalCompliance(case.model().chain).loads
    for number in range(count):
        middle = drive.duration * (number + 0.5) / count
        # Steady states are those of a drive cos(theta), the run's drive is the sine of its phase: theta is the phase
        # less pi/2. The period begins at a multiple of 2 pi of theta, the last one that ends at most half a period
        # after the middle. The spline has half a period more on each side, so that its ends do no harm.
        first = 2 * np.pi * np.floor((drive.phase(middle) - 1.5 * np.pi) / (2 * np.pi)) + 0.5 * np.pi
        window = (phases > first - np.pi) & (phases < first + 3 * np.pi)
        # A run that has failed ends before its last places.
        if times[-1] < middle or np.count_nonzero(window) < PER_PERIOD:
            return
        motion = CubicSpline(phases[window], displacements[window] @ pairs)
        period = motion(first + 2 * np.pi * np.arange(PER_PERIOD) / PER_PERIOD)
        yield _harmonics(period, states.options.harmonics)


def _harmonics(period: np.ndarray, order: int) -> np.ndarray:
    """Harmonics (pair, order + 1) of one period (sample, pair) from a phase of 0 on; 0 beyond those of the samples."""
    # The last order of the transform, at two samples a period, is a sum of two conjugate parts and has no phase.
    spectrum = 2 * np.fft.rfft(period, axis=0)[:-1] / len(period)
    spectrum[0] /= 2
    harmonics = np.zeros((order + 1, period.shape[1]), complex)
    orders = min(len(spectrum), order + 1)
    harmonics[:orders] = spectrum[:orders]
    return harmonics.T


def _sweep(states: SteadyStates, count: int, direction: int) -> Case:
    """The run of a sweep over ``count`` places, to higher frequencies (``direction`` 1) or to lower ones (-1)."""
    case = states.case
    low, high = states.options.range
    middle = (low + high) / 2
    between = states.options.isola_periods * 2 * np.pi / middle
    duration = count * between

    drives: list[dict[str, Any]] = []
    for one, ratio in case.drive.ratios:
        # The wall that moves says which mass is driven.
        place: dict[str, Any] = {"cell": one.cell, "mass": one.mass}
        if one.end:
            place = {"end": one.end}
        chirp = {
            "waveform": "chirp",
            "amplitude": ratio * states.parameter.fixed,
            "frequency": middle,
            "bandwidth": direction * (high - low),
            "duration": duration,
            "ramp": RAMP * between,
        }
        drives.append(place | chirp)
    drive, *more = drives
    if more:
        drive["more"] = more
    interval = case.time.sample_interval
    assert interval != "auto"  # that of a resolved case
    # The spline needs enough samples of the shortest period, too.
    time = {"end": duration, "sample_interval": min(interval, 2 * np.pi / (high * PER_PERIOD))}
    # Sites that have restitutions of their own keep them.
    contacts = {"restitution": states.restitution}
    if case.contacts.each and case.contacts.each.restitution:
        contacts = {}
    return case.varied(
        without=["drive", "time", "output", "analysis"],
        drive=drive,
        time=time,
        output={"fields": ["displacement"], "figures": False},
        contacts=contacts,
    )
