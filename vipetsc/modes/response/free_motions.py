"""Steady states near the free motions of a lattice without loss: its nonlinear normal modes and breathers.

Where a small force makes up for a small loss, a steady state is nearly a free motion of the conservative lattice at the
same frequency; at resonance the motion is a quarter of a period behind the force. An isolated curve of the frequency
response follows these motions over the frequency, between two points at which the force no longer makes up for the
loss. Cf. R. J. Kuether et al., J. Sound Vib. 351 (2015) 299, and T. L. Hill et al., Proc. R. Soc. A 471 (2015)
20140809.

Free motions are followed from each linear mode near the range. At each place, a frequency of the range, Newton's method
finds the amplitude of the force that keeps such a motion going against the loss that the lattice has, if the force is a
quarter of a period ahead. From that state the amplitude of the force is varied until it is that of the curve which is
being searched for.

The method finds an isolated curve only where the loss is small enough for Newton's method to come from the free motion
to the damped one, and where the force does work on the mode: a mode whose driven masses stand still is not excited.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise

import numpy as np

from vipetsc.case.nnm_table import NnmTable
from vipetsc.lattice import DenseCompliance, ModalCompliance
from vipetsc.modes.balance.conservative import FEWEST, ConservativeMotions
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.continuation.arclength import Continuation
from vipetsc.modes.point import Point
from vipetsc.modes.problem import ContinuationError, unit
from vipetsc.modes.response.equations import FAILURES, SteadyFrame
from vipetsc.modes.response.isolated import over_amplitude, with_amplitude
from vipetsc.modes.response.steady import SteadyStates

# Linear modes whose frequencies lie within this factor of the range are followed: contacts and springs shift the
# frequency of a motion from that of its mode. With 1 four of ten states of the example ``isola`` are not found.
NEAR = 2.0
# Motions of one branch, at most; the branches of ``isola`` have 40 and 36.
MOST_MOTIONS = 300
# Largest relative displacement of the first motion, over the clearance: it touches no stop, and springs that are not
# linear are nearly so. With 0.05 and with first steps of 0.01 or 0.04 the same states are found in ``isola``.
FIRST_SIZE = 0.1
# Arclength of the first step, in the units of ``HarmonicFrame``.
FIRST_STEP = 0.02
# Slack of the bounds of frequency: a motion without contact keeps its frequency, but for rounding.
SLACK = 1e-3
# Free motions are first guesses, and need not be as accurate as steady states: bounds of what their harmonics leave
# out, over the motion, and of the residual.
TRUNCATION = 1e-4
TOLERANCE = 1e-9


def states_near_free_motions(states: SteadyStates, places: np.ndarray) -> list[list[np.ndarray]]:
    """Unknowns (n + 1,) of the steady states that free motions lead to: a list for each of ``places``.

    ``states`` are those over the frequency; ``places`` (count,) are frequencies over ``states.parameter.scale``. A
    motion from which no steady state is found is left out.
    """
    motions = _conservative(states)
    of_places: list[list[np.ndarray]] = [[] for _ in places]
    for points in _branches(motions, states):
        for number, p in enumerate(places.tolist()):
            for motion in _at(motions, points, p * states.parameter.scale):
                harmonics = motions.balance(motion.order).unpack(motion.x)
                line = over_amplitude(states, p)
                with suppress(*FAILURES):
                    of_places[number] += with_amplitude(states, line, resonance(line, harmonics), p)
    return of_places


def resonance(line: SteadyStates, harmonics: np.ndarray) -> np.ndarray:
    """Unknowns, with the amplitude, of the state near a free motion that is a quarter of a period behind its force.

    ``line`` are states over the amplitude at the frequency of the motion, whose ``harmonics`` (pair, order) are in m.
    Raises ContinuationError where no force keeps a motion near it going.
    """
    orders = np.arange(line.options.harmonics + 1)
    free = np.zeros((len(harmonics), len(orders)), complex)
    count = min(len(orders), harmonics.shape[1])
    free[:, :count] = harmonics[:, :count]

    # A free motion may begin at any time. As it is computed, at rest at phase 0, it is in phase with the force; an
    # order k is put k quarter turns behind. Newton's method may not move it in time (``row`` is the motion's derivative
    # by time), and finds the amplitude of the force instead, whose first guess, the one that touches a stop, hardly
    # counts, since the equations are linear in it.
    behind = free * np.exp(-0.5j * np.pi * orders)
    row = np.append(unit(line.balance.pack(-1j * orders * behind)), 0.0)
    guess = np.append(line.balance.pack(behind) / line.clearance, 1.0)
    attempt = SteadyFrame(line, guess, row).solve(guess, row, float(row @ guess))
    if not attempt.converged:
        raise ContinuationError(f"no force keeps the motion going: {attempt.reason}")

    xi = attempt.xi
    if xi[-1] < 0:
        # The same motion half a period later, under the opposite force.
        later = line.balance.unpack(xi[:-1]) * (-1.0) ** orders
        xi = np.append(line.balance.pack(later), -xi[-1])
    return xi


def _conservative(states: SteadyStates) -> ConservativeMotions:
    """The free motions of the lattice of ``states`` without dashpots and with elastic contacts."""
    chain = states.case.model().chain
    elastic = []
    for stops in states.forces.contacts:
        elastic.append(stops._replace(law=replace(stops.law, restitution=1.0)))
    forces = SiteForces(elastic, states.forces.springs)

    modal = ModalCompliance(chain, contact_springs=tuple(stops.spring for stops in elastic))
    compliance = DenseCompliance(chain.masses(), modal.stiffness.toarray(), modal.loads.T)
    options = NnmTable.model_validate(
        {
            "harmonics": max(states.options.harmonics, FEWEST),
            "truncation": TRUNCATION,
            "tolerance": TOLERANCE,
            "points": MOST_MOTIONS,
            "first_step": FIRST_STEP,
        }
    )
    return ConservativeMotions(compliance, forces, options)


def _branches(motions: ConservativeMotions, states: SteadyStates) -> Iterator[list[Point]]:
    """The free motions that begin at each linear mode near the range of ``states``, branch by branch.

    Bounds of their frequencies are those of the range, extended to the mode itself, from which a branch begins.
    """
    compliance = motions.compliance
    assert isinstance(compliance, DenseCompliance)
    low, high = states.options.range
    for omega, parts in zip(np.sqrt(compliance.squared), compliance.parts.T, strict=True):
        size = np.abs(parts).max()
        # A mode in which no contact and no nonlinear spring moves stays linear at any size.
        if not low / NEAR < omega < high * NEAR or size == 0:
            continue
        bounds = [min(low, omega) * (1 - SLACK), max(high, omega) * (1 + SLACK)]
        options = motions.control.model_copy(update={"frequency": bounds})
        points: list[Point] = []
        # A branch that cannot go on has been followed as far as it goes.
        with suppress(*FAILURES):
            start = motions.from_mode(parts * (FIRST_SIZE * states.clearance / size), float(omega))
            points.append(start)
            points.extend(Continuation(motions, start, options))
        yield points


def _at(motions: ConservativeMotions, points: list[Point], omega: float) -> Iterator[Point]:
    """The motions of the frequency ``omega`` in rad/s on the branch of ``points``.

    Where the period of two neighbours encloses that of ``omega``, Newton's method begins at the nearer one.
    """
    period = 2 * np.pi / omega
    for before, after in pairwise(points):
        if (before.period - period) * (after.period - period) > 0 or before.period == after.period:
            continue
        nearest = min(before, after, key=lambda point: abs(point.period - period))
        with suppress(*FAILURES):
            yield motions.refined(replace(nearest, period=period, tangent=np.empty(0)), keep_frequency=True)
