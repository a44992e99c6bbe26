"""The condensed system of a case of ``nfrc``: contacts, nonlinear springs, driven masses, and the compliance between.

Everything else in the lattice is linear: M u'' + C u' + K u = p - b f. The forces f (pair,) are those of contacts and
what nonlinear springs have beyond their linear part; they pull the masses of their pair together. The forces p (mass,)
are those of the drive. The columns b pick the elongations z = b^T u, of a contact its relative displacement. At each
multiple omega of the drive's frequency the harmonics of z and f obey z = w - G(omega) f (``balance.harmonic_balance``),
G being b^T (K + i omega C - omega^2 M)^-1 b in m/N, and w the motion without f: b^T (K + i omega C - omega^2 M)^-1 p,
or that by the incident wave.

**Contacts as springs.** A mean force f moves masses without bound if no wall holds them and no spring joins them: G(0)
is then infinite. If contacts that are pressed at rest hold them (``NfrcCase.are_contacts_springs``), these contacts are
springs of the linear lattice, with the slope s of their law at rest:

    z = w_s - G_s (f - s z),    G_s = b^T (K + b s b^T + i omega C - omega^2 M)^-1 b,    w_s likewise.

This is the same equation, since s z is added on one side and taken off on the other. G_s is made here
(``contact_springs``), and ``ForceSeries.add_load`` takes s z off the force (``Stops.spring``).
"""

from typing import NamedTuple

import numpy as np

from vipetsc.case.drive import build_drive
from vipetsc.case.nfrc import NfrcCase, needs_modes
from vipetsc.case.resolve import build_chain
from vipetsc.lattice import ModalCompliance, OpenCompliance, WaveCompliance, spring_laws
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.stops import Stops


class DrivenPoints(NamedTuple):
    """Masses on which drives act: ``places``, each (cell, mass) from 0, and ``weights`` (place,).

    A weight is the force in N on the mass when the first drive has the amplitude 1, in its unit, N or m.
    """

    places: tuple[tuple[int, int], ...]
    weights: np.ndarray


def driven_points(case: NfrcCase) -> DrivenPoints:
    """Return the driven masses of a ``case``; none under an incident wave.

    A force of the drive acts on its mass. A wall that moves acts on each mass that a spring ties to it, with the
    spring's stiffness times the wall's motion: such springs are linear and have no dashpot, as the case makes sure. The
    amplitude of a curve is that of the first drive, a force in N or a wall's motion in m. All others keep their ratios
    to it, which have a unit where one drive is a force and the other a wall.
    """
    if case.nfrc.source == "wave":
        return DrivenPoints((), np.empty(0))

    places: list[tuple[int, int]] = []
    weights: list[float] = []
    for drive, ratio in case.drive.ratios:
        for built in build_drive(drive, case.model().chain):
            places.append((built.cell, built.mass))
            # A force has no stiffness: for the amplitude 1 it is 1 N. Stiffnesses of springs are positive.
            weights.append(ratio * (built.stiffness or 1.0))
    return DrivenPoints(tuple(places), np.array(weights))


def compliance_of(case: NfrcCase) -> WaveCompliance | ModalCompliance:
    """Return the compliance of the lattice of a ``case`` between its contacts, nonlinear springs and driven masses.

    Where ends are open, the modes of the finite lattice give it, continued beyond these ends; ``OpenCompliance`` is a
    ``ModalCompliance``. Otherwise Bloch waves do, of an infinite lattice and of a finite one of equal cells without
    dashpots whose contacts join the pair of their cell, and modes of any other finite lattice. No contact of an
    infinite lattice is a spring: the case refuses those that would be. The compliance by modes costs up to a minute at
    its first use and is not kept here: one is made for all curves of a case.
    """
    chain = case.model().chain
    places = driven_points(case).places
    if case.nfrc.open_ends:
        absorbing = case.lattice.absorbing
        assert absorbing is not None  # checked in the case
        ends: tuple[str, ...] = (absorbing.end,)
        if absorbing.end == "both":
            ends = ("left", "right")
        # The half lattice beyond an open end takes the place of the dashpots that absorb there.
        without = build_chain(case.lattice.model_copy(update={"absorbing": None}), case.contacts)
        return OpenCompliance(without, places, contact_springs(case), open_ends=ends)
    if needs_modes(chain) and not case.nfrc.infinite:
        return ModalCompliance(chain, places, contact_springs(case))
    return WaveCompliance(chain, places, infinite=bool(case.nfrc.infinite))


def forces_of(case: NfrcCase, restitution: float) -> SiteForces:
    """Return the contacts of a ``case``, with a ``restitution``, and its springs that are not linear."""
    chain = case.model().chain
    springs = spring_laws(chain)
    return SiteForces(stops_of(case, restitution), springs)


def stops_of(case: NfrcCase, restitution: float) -> list[Stops]:
    """Return the law and the stops of each site of a ``case``, with a ``restitution``.

    Where a pressed contact is a spring of the linear lattice, its ``Stops.spring`` is the slope of its law at rest. It
    is 0 of a contact that is not pressed.
    """
    gaps = case.model().chain.sites.gaps.tolist()
    stops = [Stops(law, plus, minus) for law, (plus, minus) in zip(case.laws(restitution), gaps, strict=True)]
    if not case.are_contacts_springs:
        return stops
    return [one._replace(spring=one.slope_at_rest) for one in stops]


def contact_springs(case: NfrcCase) -> tuple[float, ...]:
    """Return the stiffness in N/m of the spring at each contact in the linear lattice of a ``case``; () for none."""
    if not case.are_contacts_springs:
        return ()
    # The spring is the slope of the elastic law, on which the restitution has no influence: any value serves here.
    return tuple(one.spring for one in stops_of(case, 1.0))
