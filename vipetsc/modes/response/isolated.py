"""States of isolated curves, which no curve from the beginning of the range meets: where one can begin.

At one amplitude an isolated curve (an isola) is apart from the others, but states at other amplitudes connect them:
with the amplitude an isola grows, and in general merges with its neighbour. From each state found so far at a value p
of the parameter the states over the amplitude are therefore followed at this p, up and down. Where such a line passes
the amplitude of the curve again it has found a state at this amplitude, a known or a new one. An isola is missed if at
none of the values p tried such a line, within ``nfrc.isola_reach``, leads to it from a known state.

Cf. T. Detroux et al., Mech. Syst. Signal Process. 60-61 (2015) 799, and R. J. Kuether et al., J. Sound Vib. 351 (2015)
299, who continue folds over the amplitude.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import pairwise

import numpy as np

from vipetsc.modes.continuation.arclength import Continuation
from vipetsc.modes.response.equations import FAILURES
from vipetsc.modes.response.over_key import StatesOverKey
from vipetsc.modes.response.state import Response
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import TurningSteps

# States of one line over the amplitude, at most.
MOST_STATES = 1000
# Difference of unknowns, over their size, above which two states are not the same. Newton's method leaves a residual of
# 1e-11 (``nfrc.tolerance``), which near a fold is a much larger error of the unknowns.
DIFFERENT = 1e-6
# Sizes, over the unit of displacements, and number of phases within a period of the drive of the subharmonic motions at
# which Newton's method begins.
SIZES = np.geomspace(0.1, 10, 9)
PHASES = 8
# A state is subharmonic if harmonics of this size, over the motion, are no multiples of the drive's frequency.
LEAST_SUBHARMONIC = 1e-4

Equations = SteadyStates | StatesOverKey
Curves = Sequence[Sequence[Response]]


def places_of(states: Equations, count: int) -> np.ndarray:
    """Return the scaled parameters (count,) at which states are looked for: middles of equal parts of the range."""
    low, high = (bound / states.parameter.scale for bound in states.options.range)
    return np.asarray(low + (high - low) * (np.arange(count) + 0.5) / count)


def unknown_states(
    states: Equations, curves_so_far: Callable[[], Curves], candidates: Sequence[np.ndarray]
) -> Iterator[np.ndarray]:
    """Yield unknowns (n + 1,) of those of the ``candidates`` that lie on none of the ``curves_so_far``.

    The curves are asked for before each state, since curves may be added between two states.
    """
    for xi in candidates:
        if not is_on(states, curves_so_far(), xi):
            yield xi


def over_amplitudes(states: Equations, curves: Curves, p: float) -> list[np.ndarray]:
    """Return states (n + 1,) at the scaled parameter ``p`` to which other amplitudes lead from the ``curves``.

    They have the curve's amplitude; some may lie on the ``curves`` themselves.
    """
    states_found: list[np.ndarray] = []
    for begin in states_on(states, curves, p):
        # The line through a state that a line has found already is that line.
        if not _is_among(begin, states_found):
            states_found += _states_over_amplitude(states, begin)
    return states_found


def subharmonic_states(states: Equations, p: float) -> list[np.ndarray]:
    """Return subharmonic states (n + 1,) at the scaled parameter ``p``, none of them another one shifted in time.

    Newton's method begins at the linear motion, and a motion of 1/n of the drive's frequency with each of several sizes
    and phases, in which the places move as under forces of that frequency.
    """
    omega, amplitude = states.drive(p)
    # Along a curve over a key each value has a lattice of its own.
    lattice = states if isinstance(states, SteadyStates) else states.states_at(p * states.parameter.scale)
    linear = amplitude * lattice.linear_motion(omega).harmonics
    compliance = lattice.compliance.at(np.array([omega / states.periods]))[0]
    shape = np.linalg.svd(compliance[: len(linear), : len(linear)])[0][:, 0]
    shape = shape / np.abs(shape).max()

    states_found: list[np.ndarray] = []
    for size in SIZES * states.clearance:
        for phase in 2 * np.pi / (PHASES * states.periods) * np.arange(PHASES):
            guess = linear.copy()
            guess[:, 1] += size * np.exp(1j * phase) * shape
            with suppress(*FAILURES):
                xi = states.at(np.append(states.balance.pack(guess) / states.clearance, p), p)
                others = [image for one in states_found for image in images(states, one)]
                if _is_subharmonic(states, xi) and not _is_among(xi, others):
                    states_found.append(xi)
    return states_found


def images(states: Equations, xi: np.ndarray) -> list[np.ndarray]:
    """Return the unknowns (n + 1,) of a state, and of all others that a symmetry makes of it.

    These are shifts in time by 1, 2, ... periods of the drive. Where all forces are odd a shift by half a period with
    the opposite sign gives a state, too.
    """
    orders = np.arange(states.balance.order + 1)
    z = states.balance.unpack(xi[:-1])
    is_odd = states.balance.forces.odd
    moved = []
    for halves in range(0, 2 * states.periods, 2 - is_odd):
        factor = (-1) ** halves * np.exp(1j * np.pi * orders * halves / states.periods)
        moved.append(np.append(states.balance.pack(z * factor), xi[-1]))
    return moved


def is_on(states: Equations, curves: Curves, xi: np.ndarray) -> bool:
    """Return whether a state, or one that a symmetry makes of it, is on a curve of ``curves`` with equal unknowns."""
    of_same = [points for points in curves if points and len(points[0].xi) == len(xi)]
    on_curves = states_on(states, of_same, float(xi[-1]))
    return any(_is_among(image, on_curves) for image in images(states, xi))


def _is_subharmonic(states: Equations, xi: np.ndarray) -> bool:
    """Return whether a state has harmonics that are no multiples of the drive's frequency."""
    z = np.abs(states.balance.unpack(xi[:-1]))
    z[:, :: states.periods] = 0
    return bool(np.linalg.norm(z) > LEAST_SUBHARMONIC * np.linalg.norm(xi[:-1]))


def states_on(states: Equations, curves: Curves, p: float) -> list[np.ndarray]:
    """Return unknowns (n + 1,) of the states of ``curves`` at the scaled parameter ``p``."""
    states_found: list[np.ndarray] = []
    for points in curves:
        for before, after in pairwise(point.xi for point in points):
            if (before[-1] - p) * (after[-1] - p) > 0 or before[-1] == after[-1]:
                continue
            # A line between the two neighbours gives the guess. Where Newton's method fails no state is reported.
            place = (p - before[-1]) / (after[-1] - before[-1])
            with suppress(*FAILURES):
                xi = states.at(before + place * (after - before), p)
                if not _is_among(xi, states_found):
                    states_found.append(xi)
    return states_found


def _is_among(xi: np.ndarray, others: Sequence[np.ndarray]) -> bool:
    """Return whether one of the ``others`` is the same state."""
    return any(np.linalg.norm(xi - other) <= DIFFERENT * np.linalg.norm(xi) for other in others)


def _states_over_amplitude(states: Equations, begin: np.ndarray) -> Iterator[np.ndarray]:
    """Return unknowns of further states with the curve's amplitude, on the line through ``begin``."""
    line = over_amplitude(states, begin[-1])
    _, amplitude = states.drive(begin[-1])
    # The two equations may have different clearances as units of displacement.
    unit = states.clearance / line.clearance
    xi = np.append(begin[:-1] * unit, amplitude / line.parameter.scale)
    return with_amplitude(states, line, xi, begin[-1])


def with_amplitude(states: Equations, line: SteadyStates, begin: np.ndarray, p: float) -> Iterator[np.ndarray]:
    """Yield states (n + 1,) at the scaled parameter ``p`` with the curve's amplitude, found along a ``line``.

    The line is followed in both directions from ``begin`` (n + 1,), unknowns near one of its states, which is left out
    if it has that amplitude itself.
    """
    _, amplitude = states.drive(p)
    crossed = amplitude / line.parameter.scale
    unit = states.clearance / line.clearance
    for direction in (1, -1):
        with suppress(*FAILURES):
            start = Response(xi=line.at(begin, float(begin[-1])), next_step=line.options.first_step)
            last = start
            rule = TurningSteps(line, points=MOST_STATES)
            for point in Continuation(line, start, control=rule, direction=direction):
                # A line that begins at the amplitude itself does not pass it with its first step.
                is_left = last is start and start.xi[-1] == crossed
                if not is_left and (last.xi[-1] - crossed) * (point.xi[-1] - crossed) <= 0:
                    place = (crossed - last.xi[-1]) / (point.xi[-1] - last.xi[-1])
                    xi = line.at(last.xi + place * (point.xi - last.xi), crossed)
                    yield np.append(xi[:-1] / unit, p)
                last = point


def over_amplitude(states: Equations, p: float) -> SteadyStates:
    """Return the equations over the amplitude at the scaled parameter ``p`` of a curve over the frequency or a key.

    Amplitudes range from 1/reach to reach times the curve's own, with reach = ``nfrc.isola_reach``.
    """
    omega, amplitude = states.drive(p)
    # Along a curve over a key each value has a lattice of its own.
    if isinstance(states, SteadyStates):
        lattice = states
    else:
        lattice = states.states_at(p * states.parameter.scale)
    reach = states.options.isola_reach
    update = {"over": "amplitude", "fixed": [omega], "range": [amplitude / reach, amplitude * reach]}
    case = lattice.case.model_copy(update={"nfrc": lattice.options.model_copy(update=update)})
    return SteadyStates(case, lattice.restitution, omega, forces=lattice.forces, like=lattice)
