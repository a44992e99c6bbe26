"""Records of a cluster that is advanced in substeps: where it stands, and a substep that is tried.

A cluster (sec. 6 of the derivation in the package's docstring) goes through the step from t_0 to t_0 + H in substeps
whose length follows its contacts. Each is computed in a ``Trial`` (sec. 3) and thrown away if its error is too large or
if a site changes its mode inside (sec. 4); only a trial that is taken is written into the ``Cluster``. Both are named
tuples of arrays, because compiled code takes them as arguments and changes the arrays in place.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.contact.law import FREE, STUCK
from vipetsc.dynamics.drives import Drives, drive_end
from vipetsc.dynamics.propagator.nodes import NODES, Collocation
from vipetsc.dynamics.spring_law import SPRING_LAW

COUNTS = ("substeps", "rejected", "landings", "switches", "missed", "forced")
SUBSTEP_STATE = np.dtype(
    [(name, float) for name in ("begin", "position", "length")] + [(name, np.int64) for name in COUNTS]
)
"""Where a cluster stands, a record in an array, so that compiled code can change it: the time in s at which the step
begins; the position in the step and the length of the next substep, both in units of H; counts of substeps tried,
without their repetitions that end on a kink or a change, of those rejected, of landings begun, of switches of a mode,
of substeps that end beside a change or with a kink inside, and of those taken although their error is too large."""

SPRING_DOF = np.dtype([("law", SPRING_LAW), ("scale", float)])
"""A nonlinear spring: what its force has beyond the linear part; the size in m of elongations."""

HISTORY = np.dtype([("onset", float), ("duration", float)])
"""A site's contact: its onset and expected duration in s."""


class Substep(NamedTuple):
    """A substep: the ``kind`` of its nodes (``PLAIN``, ``ONSET``, ``EXIT``), its ``length`` in units of H."""

    kind: int
    length: float


class Sums(NamedTuple):
    """Workspace of a substep: compiled code that makes no arrays need not count references to them.

    At the nodes: ``free_w`` and ``free_v`` (dof, node) of the free motion; ``to_w`` and ``to_v`` (dof, source, node of
    the source, node) of a unit force, for pairs that ``reaches`` (dof, source) marks; ``w`` and ``v`` (node,) of one
    DoF. Of stuck sites: ``free_a`` (dof, node) and ``to_a`` (dof, source, node of the source, node), the same of the
    acceleration by s, ``residuals`` (dof, node) of it, and ``corrections`` (dof, node) of their reactions. Besides,
    ``forces`` (dof,) at one time, their ``rates``, and the ``given`` part of accelerations; ``impulses`` (dof,) that
    have struck sites; ``moments`` (power,) of one DoF's force about the substep's end; ``series`` (power, coefficient),
    whose row k is the polynomial in s that term k of a response makes of them; ``bernstein`` (2, 6), coefficients of
    two quintics for w; and ``had_contact`` (dof,), whether a site was in contact before the sites switched at the
    substep's end.
    """

    free_w: np.ndarray
    free_v: np.ndarray
    to_w: np.ndarray
    to_v: np.ndarray
    reaches: np.ndarray
    w: np.ndarray
    v: np.ndarray
    free_a: np.ndarray
    to_a: np.ndarray
    residuals: np.ndarray
    corrections: np.ndarray
    forces: np.ndarray
    rates: np.ndarray
    given: np.ndarray
    impulses: np.ndarray
    moments: np.ndarray
    series: np.ndarray
    bernstein: np.ndarray
    had_contact: np.ndarray


class Trial(NamedTuple):
    """A substep that has been computed but not yet taken.

    Forces act on the DoFs ``active``: first the sites that are not free, ``closed``, then all ``springs``, then masses
    whose drive is on. ``force`` in N, ``w`` in m and ``v`` in m/s (dof, node) are those at its nodes; ``taylor`` and
    ``site_motion`` are as in ``Cluster``, at its end.
    """

    active: np.ndarray
    closed: np.ndarray
    springs: np.ndarray
    force: np.ndarray
    w: np.ndarray
    v: np.ndarray
    taylor: np.ndarray
    site_motion: np.ndarray
    sums: Sums


class Cluster(NamedTuple):
    """A cluster, or all clusters of a rank one after another: constants, and what changes as it is advanced.

    The DoFs of a cluster are its sites, which ``contacts`` (site,) describe, its ``springs`` (spring,) of dtype
    ``SPRING_DOF``, and then the driven masses in reach. ``drives`` has a row for every DoF; those of sites and springs
    drive nothing. ``response`` (dof, dof of the same cluster, term):
    term m is the coefficient of s^(2 m + 1), s the time over H, in the displacement of the first DoF after a unit
    impulse on the second one, times H; with dashpots that of s^(m + 1), one for each power but s^0. ``interval`` is H
    in s; ``rtol`` and ``atol`` (m/s) bound the error of a substep; a contact begins with the fraction ``first_substep``
    of its duration.

    ``taylor`` (dof, coefficient) is the series in m of the free motion about the present position, by powers of s,
    twice ``StepSeries.terms`` of them; ``site_motion`` (dof, 3) has w, w', w'' of the sites there, or of a stuck site
    its reaction R, R', 0. ``moments`` (dof,
    power) in N s, as many, are the integrals of the step's forces times (remaining time/H)^power up to its end,
    ``energy`` (dof,) in J is what sites dissipated and the work of drives. ``history`` (dof,) is of dtype ``HISTORY``,
    ``state`` (cluster,) of dtype ``SUBSTEP_STATE``; ``trial`` is workspace for the largest cluster.
    """

    contacts: np.ndarray
    springs: np.ndarray
    drives: Drives
    response: np.ndarray
    nodes: Collocation
    interval: float
    omega_max_h: float
    rtol: float
    atol: float
    first_substep: float
    taylor: np.ndarray
    site_motion: np.ndarray
    moments: np.ndarray
    energy: np.ndarray
    history: np.ndarray
    state: np.ndarray
    trial: Trial


def create_trial(dofs: int, terms: int, any_rigid: bool = False) -> Trial:
    """Return workspace for a substep of ``dofs`` DoFs, all of which are active; as it is here, all are sites.

    Only where sites may stick, with ``any_rigid``, is there room for what their accelerations take.
    """
    stuck = 0
    if any_rigid:
        stuck = dofs
    sums = Sums(
        free_w=np.zeros((dofs, NODES)),
        free_v=np.zeros((dofs, NODES)),
        to_w=np.zeros((dofs, dofs, NODES, NODES)),
        to_v=np.zeros((dofs, dofs, NODES, NODES)),
        reaches=np.zeros((dofs, dofs), bool),
        w=np.zeros(NODES),
        v=np.zeros(NODES),
        free_a=np.zeros((stuck, NODES)),
        to_a=np.zeros((stuck, stuck, NODES, NODES)),
        residuals=np.zeros((stuck, NODES)),
        corrections=np.zeros((stuck, NODES)),
        forces=np.zeros(dofs),
        rates=np.zeros(dofs),
        given=np.zeros(dofs),
        impulses=np.zeros(dofs),
        moments=np.zeros(2 * terms),
        series=np.zeros((2 * terms, 2 * terms)),
        bernstein=np.zeros((2, 6)),
        had_contact=np.zeros(dofs, bool),
    )
    return Trial(
        active=np.arange(dofs),
        closed=np.arange(dofs),
        springs=np.arange(0),
        force=np.zeros((dofs, NODES)),
        w=np.zeros((dofs, NODES)),
        v=np.zeros((dofs, NODES)),
        taylor=np.zeros((dofs, 2 * terms)),
        site_motion=np.zeros((dofs, 3)),
        sums=sums,
    )


@kernel
def has_stuck_sites(cluster: Cluster) -> bool:
    """Return whether a rigid site of a cluster is stuck."""
    any_stuck = False
    for i in range(cluster.contacts.size):
        any_stuck |= abs(cluster.contacts[i].mode) == STUCK
    return any_stuck


@kernel
def first_drive(cluster: Cluster) -> int:
    """Return the first of a cluster's DoFs that is a driven mass."""
    return cluster.contacts.size + cluster.springs.size


@kernel
def select_active(cluster: Cluster) -> Trial:
    """Return the workspace for a substep of a cluster, of those DoFs on which forces act."""
    state = cluster.state[0]
    sites = cluster.contacts
    room = cluster.trial
    closed = 0
    for i in range(sites.size):
        if sites[i].mode != FREE:
            room.active[closed] = i
            room.closed[closed] = i
            closed += 1

    count = closed
    for i in range(sites.size, first_drive(cluster)):
        room.active[count] = i
        count += 1
    drives = count
    for i in range(first_drive(cluster), cluster.taylor.shape[0]):
        if state.position < drive_end(cluster.drives, i, state.begin, cluster.interval, state.position):
            room.active[count] = i
            count += 1
    return Trial(
        active=room.active[:count],
        closed=room.closed[:closed],
        springs=room.active[closed:drives],
        force=room.force,
        w=room.w,
        v=room.v,
        taylor=room.taylor,
        site_motion=room.site_motion,
        sums=room.sums,
    )
