r"""Energy that dashpots and contacts take from a motion in a period, and the force that gives it back.

Motions of a branch are those without loss. Along one of them, to first order in the loss,

    Delta E = int v^T C v dt + sum over contacts of (c/|w'_minus|) int f w'^2 dt

is lost in a period, with the dashpots C and the damping c of each contact. Of weakly damped motions the energy decays
by the factor exp(-2 zeta Om t), with zeta = Delta E/(4 pi E) at every energy, which is the damping ratio of a linear
mode. A force F cos(Om t) on one mass, a quarter of a period ahead of its displacement, gives the work pi F |U_1| in a
period, with the first harmonic U_1 of that mass: F = Delta E/(pi |U_1|) keeps the motion going (resonance by quadrature
of phase; M. Peeters, G. Kerschen, J. C. Golinval, J. Sound Vib. 330 (2011) 486).

Along an orbit that was shot with matrices the arc is integrated by Gauss's rule between its changes of contact. The
rest of the period consists of images of the arc, some of them backwards in time, in which a contact begins with the
velocity with which it ends in the arc.
"""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from vipetsc.case import NnmCase
from vipetsc.lattice import Contact
from vipetsc.modes.flow import SEPARATION, Arc
from vipetsc.modes.point import Point
from vipetsc.modes.shooting import Shooting
from vipetsc.modes.system import elongation_rows

# Nodes of Gauss's rule in a piece of an arc, and the longest piece in radians of the fastest motion. A contact that is
# stiffer than all springs may be one piece: 12 nodes err by 1e-4 of its loss, 24 by 1e-12.
NODES = 24
LONGEST = 2.0


class Dissipation(NamedTuple):
    """Sources of loss, ``damping`` (n, n) in N s/m and the ``laws`` of all contacts; the ``forced`` mass or None."""

    damping: csr_matrix
    laws: Sequence[Contact]
    forced: int | None

    @property
    def acts(self) -> bool:
        """Whether anything dissipates."""
        return bool(self.damping.nnz) or any(law.damping for law in self.laws)


def dissipation_of(case: NnmCase) -> Dissipation:
    """The dashpots and contacts of a case that dissipate, and its forced mass."""
    damping = csr_matrix((0, 0))
    if case.nnm.system in ("chain", "condensed"):
        chain = case.damped_chain
        damping = chain.damping_rows(0, chain.cells)
        damping.eliminate_zeros()
    elif case.nnm.custom is not None:
        # The table counts masses from 1, and 0 is the ground.
        dashpots = case.nnm.custom.dashpots
        mass: list[int | None] = [None, *range(len(case.nnm.custom.masses))]
        ends = [(mass[dashpot.start], dashpot.end - 1) for dashpot in dashpots]
        rows = elongation_rows(ends, len(case.nnm.custom.masses))
        rates = np.array([dashpot.damping for dashpot in dashpots])
        damping = csr_matrix(rows.T @ (rates[:, None] * rows))
    return Dissipation(damping=damping, laws=case.laws(), forced=case.forced_mass())


class _Moment(NamedTuple):
    """A node of the quadrature: its ``weight`` and ``time`` in s, and the state there in m and m/s."""

    weight: float
    time: float
    u: np.ndarray
    v: np.ndarray


class _Contact(NamedTuple):
    """One contact episode in an arc: its ``action``, the integral of f w'^2 dt in N m^2/s.

    ``onset`` and ``separation`` are |w'| in m/s where it begins and ends. ``onset`` is None if the contact is closed at
    the start of the arc, ``separation`` if it is closed at the end.
    """

    action: float
    onset: float | None
    separation: float | None


def with_loss(problem: Shooting, dissipation: Dissipation, point: Point) -> Point:
    """The ``point`` with its loss in J a period, and the force in N at the forced mass that makes up for it."""
    arc = problem.arc(point.x, point.period)
    moments = _moments(problem, arc, point.period)
    images = 1 / problem.map.fraction

    loss = 0.0
    if dissipation.damping.nnz:
        for moment in moments:
            loss += images * moment.weight * float(moment.v @ (dissipation.damping @ moment.v))
    for number, law in enumerate(dissipation.laws):
        if law.damping:
            loss += images / 2 * _taken(law, _contacts_of_arc(problem, arc, moments, number))

    force = np.nan
    if dissipation.forced is not None:
        omega = 2 * np.pi / point.period
        # About a rest displacements are even, a sum of cosines; about the centre odd, a sum of sines.
        lag = np.pi / 2
        if problem.map.starts_at_rest:
            lag = 0.0
        harmonic = sum(m.weight * m.u[dissipation.forced] * np.cos(omega * m.time - lag) for m in moments)
        force = force_for(loss, 2 * images / point.period * float(harmonic))
    return replace(point, loss=loss, force=force)


def _taken(law: Contact, contacts: Iterable[_Contact]) -> float:
    """Energy in J that a contact takes in the arc and in its image backwards in time; NaN if it never separates.

    ``law`` is the contact's law, and ``contacts`` are its episodes in the arc.
    """
    total = 0.0
    for contact in contacts:
        # An episode that lasts over the rest at the arc's start or end is its own image backwards in time: it begins
        # with the speed with which it ends.
        onset = contact.onset
        if onset is None:
            onset = contact.separation
        separation = contact.separation
        if separation is None:
            separation = contact.onset
        if onset is None or separation is None:
            return np.nan
        slowness = sum(1 / max(speed, law.approach_floor) for speed in (onset, separation))
        total += law.damping * contact.action * slowness
    return total


def force_for(loss: float, amplitude: float) -> float:
    """The force in N whose work makes up for a ``loss`` in J a period; the mass moves by ``amplitude`` in m.

    A force a quarter of a period ahead of the displacement does the work pi F |a| in a period; at a node none can.
    """
    if amplitude == 0:
        return np.inf
    return loss / (np.pi * abs(amplitude))


def _moments(problem: Shooting, arc: Arc, period: float) -> list[_Moment]:
    """The nodes of the quadrature over an arc, between its changes of contact."""
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    # theta = sin^2 phi makes powers of the indentation, with which a contact begins and ends, smooth.
    phi = np.pi / 4 * (nodes + 1)
    places = np.sin(phi) ** 2
    weights = weights * np.pi / 4 * np.sin(2 * phi)

    changes = np.unique([0.0, *arc.events[:, 0].tolist(), arc.duration])
    moments = []
    state = arc.start
    reached = 0.0
    for begin, end in itertools.pairwise(changes):
        pieces = int(np.ceil((end - begin) * problem.flow.omega_ref(period) / LONGEST))
        cuts = np.linspace(begin, end, pieces + 1)
        for low, high in itertools.pairwise(cuts):
            for place, weight in zip(places, weights, strict=True):
                time = low + (high - low) * place
                state = problem.flow.arc(state, time - reached, period).end
                reached = time
                u, v = np.split(state, 2)
                moments.append(_Moment(weight=(high - low) * weight, time=time, u=u, v=v))
    return moments


def _contacts_of_arc(problem: Shooting, arc: Arc, moments: list[_Moment], number: int) -> Iterator[_Contact]:
    """The contacts of a pair of masses in an arc, from the nodes of a quadrature over it."""
    row = problem.system.contact_rows[number]
    stops = problem.system.contacts[number].stops
    changes = arc.events[arc.events[:, 1] == number]
    times = np.array([m.time for m in moments])
    rates = np.array([row @ m.v for m in moments])
    for side, clearance in ((1, stops.plus), (-1, stops.minus)):
        depths = np.array([side * (row @ m.u) - clearance for m in moments])
        densities = np.array([m.weight for m in moments]) * stops.law.elastic_force(depths) * rates**2

        of_side = changes[changes[:, 2] == side]
        bounds = of_side[:, 0].tolist()
        speeds: list[float | None] = [_speed(problem, arc, moments, time, row) for time in bounds]
        if len(of_side) and of_side[0, 3] == SEPARATION:
            bounds.insert(0, 0.0)
            speeds.insert(0, None)
        if len(bounds) % 2:
            bounds.append(arc.duration)
            speeds.append(None)
        if not bounds and np.any(densities > 0):
            yield _Contact(float(densities.sum()), None, None)

        for i in range(0, len(bounds), 2):
            inside = (times > bounds[i]) & (times < bounds[i + 1])
            yield _Contact(float(densities[inside].sum()), speeds[i], speeds[i + 1])


def _speed(problem: Shooting, arc: Arc, moments: list[_Moment], time: float, row: np.ndarray) -> float:
    """|w'| in m/s of a contact at a ``time`` in the arc."""
    state = arc.start
    reached = 0.0
    before = [m for m in moments if m.time < time]
    if before:
        state = np.concatenate([before[-1].u, before[-1].v])
        reached = before[-1].time
    end = problem.flow.arc(state, time - reached, 2 * np.pi / problem.flow.omega).end
    return float(abs(row @ end[len(row) :]))
