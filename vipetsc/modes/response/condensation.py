"""The condensed system of a case of ``nfrc``: contacts, nonlinear springs, driven masses, and the compliance between.

Everything else in the lattice is linear. Its response to harmonic forces at these places is the compliance G(omega) in
m/N, a matrix with a row and a column for each contact, nonlinear spring and driven mass. The equations of steady states
(``steady``) have the motions at these places alone as unknowns.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.case.drive import build_drive
from vipetsc.case.nfrc import NfrcCase, needs_modes
from vipetsc.case.resolve import build_chain
from vipetsc.lattice import ModalCompliance, OpenCompliance, WaveCompliance, nonlinear_places
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.balance.stops import Stops


class DrivenPoints(NamedTuple):
    """The masses on which a drive acts, as (cell, mass) from 0, and the force in N on each for the amplitude 1."""

    places: tuple[tuple[int, int], ...]
    weights: np.ndarray


def driven_points(case: NfrcCase) -> DrivenPoints:
    """The driven masses of a ``case``; none under an incident wave.

    A force of the drive acts on its mass. A wall that moves acts on each mass that a spring ties to it, with the
    spring's stiffness times the wall's motion: the amplitude is then in m. It is that of the first drive; all others
    keep their ratios to it.
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
    """The compliance of the lattice of a ``case`` between its contacts, nonlinear springs and driven masses.

    Bloch waves give it of an infinite lattice, and of a finite one of equal cells without dashpots whose contacts join
    the pair of their cell; else the modes of the finite lattice do, continued beyond ends that are open. That of modes
    costs up to a minute at its first call: curves of one case are computed with one.
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
    return WaveCompliance(chain, bool(case.nfrc.infinite), places)


def forces_of(case: NfrcCase, restitution: float) -> SiteForces:
    """The contacts of a ``case``, with a ``restitution``, and its springs that are not linear."""
    chain = case.model().chain
    springs = [place.law for place in nonlinear_places(chain)]
    return SiteForces(stops_of(case, restitution), springs)


def stops_of(case: NfrcCase, restitution: float) -> list[Stops]:
    """The law and the stops of each site of a ``case``, with a ``restitution``.

    Where a pressed contact is a spring of the linear lattice, its ``Stops.spring`` is the slope of its law at rest.
    """
    model = case.model()
    gaps = model.gaps or [(clearance, clearance) for clearance in model.chain.clearances]
    stops = [Stops(law, plus, minus) for law, (plus, minus) in zip(case.laws(restitution), gaps, strict=True)]
    if not case.are_contacts_springs:
        return stops
    return [one._replace(spring=one.slope_at_rest) for one in stops]


def contact_springs(case: NfrcCase) -> tuple[float, ...]:
    """Stiffness in N/m of the spring that the linear lattice of a ``case`` has at each contact; () without any."""
    if not case.are_contacts_springs:
        return ()
    # The spring is the slope of the elastic law, on which the restitution has no influence: any value serves here.
    return tuple(one.spring for one in stops_of(case, 1.0))
