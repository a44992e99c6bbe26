"""Parts of the propagator by themselves: a small chain with its series, and a mass on a stop with an exact motion."""

from __future__ import annotations

from typing import NamedTuple

from mpi4py import MPI

import numpy as np

from tests.conftest import small_case
from vipetsc.case import Model
from vipetsc.contact.law import CLOSED, LANDED, UNSWITCHED, create_contacts
from vipetsc.dynamics.drives import create_drives
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.nodes import collocation
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.dynamics.propagator.stencil import HaloRegions
from vipetsc.dynamics.propagator.substeps import HISTORY, SPRING_DOF, SUBSTEP_STATE, Cluster, Trial, create_trial
from vipetsc.records import Record

# The mass on a stop: its mass in kg, its velocity at the onset in m/s, and the stop's (k/m)^1/2 in rad/s.
MASS = 0.02
SPEED = 0.5
RATE = 3e4


class ChainParts(NamedTuple):
    """A chain's model, its layout on one rank, the series of a step and the halo that the series needs."""

    model: Model
    layout: Layout
    series: StepSeries
    halo: HaloRegions


def chain_parts(ends: str, interval: float, tolerance: float, sites: tuple[int, ...] = (5, 6, 12)) -> ChainParts:
    """Return the parts of a propagator for a chain of 24 cells on one rank.

    ``interval`` in s is the step, ``tolerance`` that of its series; ``sites`` are cells, from 1.
    """
    model = small_case(lattice={"ends": ends}, contacts={"sites": list(sites)}).model()
    layout = Layout(model, MPI.COMM_SELF)
    return ChainParts(model, layout, StepSeries(model.chain, interval, tolerance), HaloRegions(layout))


def workspace(dofs: int, terms: int) -> Trial:
    """Return workspace of the type that the propagator's own code has: of another type, all would be compiled anew."""
    trial = create_trial(dofs, terms)
    return trial._replace(sums=Record(trial.sums))


def mass_on_stop(damping: float = 0.0) -> Record:
    """Return a mass on a bilinear stop at w = 1 m: w - 1 = SPEED sin(RATE t)/RATE unless it is damped."""
    interval = 1e-4
    contact = small_case(contacts={"law": "bilinear"}).model().chain.sites[0].law
    contacts = create_contacts(contact, [1.0])
    contacts["mode"] = CLOSED
    contacts["approach"] = SPEED
    contacts["elastic"]["stiffness"] = MASS * RATE**2
    contacts["damping"] = damping
    contacts["floor"] = 0.0

    cluster = Cluster(
        contacts=contacts,
        springs=np.zeros(0, SPRING_DOF),
        drives=create_drives((), []),
        # A unit impulse changes the velocity of a free mass by 1/m and moves it by H s/m when the fraction s of the
        # interval H has passed; the table holds H times that.
        response=np.full((1, 1, 1), interval**2 / MASS),
        nodes=collocation(2),
        interval=interval,
        omega_max_h=1.0,
        rtol=1e-10,
        atol=1e-12,
        first_substep=1.0,
        taylor=np.array([[1.0, SPEED * interval]]),
        site_motion=np.zeros((1, 3)),
        moments=np.zeros((1, 2)),
        energy=np.zeros(1),
        history=np.zeros(1, HISTORY),
        state=np.zeros(1, SUBSTEP_STATE),
        trial=workspace(1, 1),
    )
    return Record(cluster)


def mass_on_cubic_spring(cubic: float) -> Record:
    """Return the mass of ``mass_on_stop`` on a spring with the force ``cubic`` z^3 in N alone, and no stop."""
    cluster = mass_on_stop()
    springs = np.zeros(1, SPRING_DOF)
    springs["law"]["cubic"] = cubic
    springs["scale"] = 1.0
    none = np.zeros(0, np.int64)
    return cluster._replace(
        contacts=cluster.contacts[:0],
        springs=springs,
        site_motion=cluster.site_motion[:0],
        trial=cluster.trial._replace(closed=none, springs=np.zeros(1, np.int64)),
    )


def pressed_mass(gap: float, side: int = 1) -> Record:
    """Return the mass of ``mass_on_stop`` at an unswitched contact; its stop is at w = ``gap`` in m on one ``side``."""
    cluster = mass_on_stop()
    cluster.contacts["mode"] = side * UNSWITCHED
    cluster.contacts["clearance"] = gap
    cluster.contacts["clearance_minus"] = gap
    cluster.contacts["scale"] = 0.5
    cluster.contacts["tolerance"] = 0.5 * LANDED

    # Accelerations need a second term of the response, which is zero as the mass is free between its contacts.
    response = np.append(cluster.response, np.zeros((1, 1, 1)), axis=2)
    return cluster._replace(
        response=response,
        taylor=np.zeros((1, 4)),
        moments=np.zeros((1, 4)),
        nodes=collocation(4),
        trial=workspace(1, 2),
    )
