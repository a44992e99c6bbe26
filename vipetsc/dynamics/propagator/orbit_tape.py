"""The tape of an orbit: the substeps in which sites were not free, and what they tell of contacts.

``substeps.Tape`` is the record that compiled code writes, with a row for each site that is not free in each substep. A
site is free while its contact is open, unless the contact is pressed at rest: that has a row in every substep.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.contact.law import PERMANENT
from vipetsc.dynamics.propagator.forces import Forces
from vipetsc.dynamics.propagator.nodes import NODES, at_end


class OrbitContacts(NamedTuple):
    """Intervals of an orbit, (number, 2): the times in s at which they begin and end.

    ``closed_substeps`` are those of substeps in which a site is closed, once for each site: sites that are closed
    together repeat them, and one contact takes several, which follow each other. ``departures`` are those in which a
    site is not as at rest, without a break: closed, or open if it is pressed at rest.
    """

    closed_substeps: np.ndarray
    departures: np.ndarray


class ClosedSubsteps(NamedTuple):
    """Substeps (row,) of an orbit in which contacts were closed, in the order of time at each site.

    A substep in which several sites were closed has a row for each. ``site`` counts the lattice's sites from 0,
    ``side`` is 1 or -1; ``onset`` marks substeps with which a contact begins. A substep ends at ``end`` in s, counted
    from the orbit's beginning. ``first_rate`` and ``last_rate`` are w' in m/s at both ends; ``w`` and ``rate`` (row,
    node) are w in m and w' in m/s at the nodes, whose ``weights`` (row, node) in s integrate over the substep.
    """

    site: np.ndarray
    side: np.ndarray
    onset: np.ndarray
    end: np.ndarray
    first_rate: np.ndarray
    last_rate: np.ndarray
    w: np.ndarray
    rate: np.ndarray
    weights: np.ndarray


class OrbitTape:
    """The tape of the clusters of ``forces``, in an orbit whose linear steps have the length ``interval`` in s."""

    def __init__(self, forces: Forces, interval: float) -> None:
        self._forces = forces
        self._interval = interval

    def rows(self, c: int) -> np.ndarray:
        """The rows (row,) of cluster ``c`` that are written, of dtype ``TAPE_ROW``, in the order of time."""
        tape = self._forces.clusters.tape
        return np.asarray(tape.rows[c, : tape.used[c]])

    def motion(self, c: int) -> np.ndarray:
        """w in m and w' in m/s (row, 2, node) at the nodes of the rows of cluster ``c``."""
        tape = self._forces.clusters.tape
        return np.asarray(tape.motion[c, : tape.used[c]])

    def contacts(self) -> OrbitContacts:
        """The substeps in which the sites that this rank logs are closed, and their departures from rest."""
        spans = [np.zeros((0, 2))]
        departures = []
        for c in np.flatnonzero(self._forces.logs).tolist():
            rows = self.rows(c)
            is_open = self._is_open(c)
            begin, end = self._times(rows)
            spans.append(np.column_stack([begin, end])[~is_open])
            for site in np.unique(rows["site"]):
                here = rows["site"] == site
                departures += _departures(rows[here], is_open[here], begin[here], end[here])
        return OrbitContacts(np.concatenate(spans), np.reshape(departures, (-1, 2)))

    def closed_substeps(self) -> list[ClosedSubsteps]:
        """The substeps in which contacts were closed, one record for each cluster that this rank logs."""
        substeps = []
        for c in np.flatnonzero(self._forces.logs).tolist():
            is_closed = ~self._is_open(c)
            rows = self.rows(c)[is_closed]
            motion = self.motion(c)[is_closed]
            rate = motion[:, 1]
            _, end = self._times(rows)
            length = rows["length"] * self._interval
            # "site" is the number in the cluster; ``Forces.sites`` gives those in the lattice, from 1. "kind" is that
            # of the nodes, whose weights in units of the substep are tabulated by kind.
            of_cluster = ClosedSubsteps(
                site=np.array(self._forces.sites(c), int)[rows["site"]] - 1,
                side=np.sign(rows["mode"]),
                onset=rows["onset"] > 0,
                end=end,
                first_rate=rows["rate"],
                # The polynomial through the nodes at the end of the substep.
                last_rate=rate @ at_end(),
                w=motion[:, 0],
                rate=rate,
                weights=self._forces.clusters.nodes.weight[rows["kind"]] * length[:, None],
            )
            substeps.append(of_cluster)
        return substeps

    def _times(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Begin and end (row,) in s of the substeps in ``rows``."""
        # "begin" is that of the linear step in s; position and length of the substep in it are in units of the step.
        begin = rows["begin"] + rows["position"] * self._interval
        return begin, begin + rows["length"] * self._interval

    def _is_open(self, c: int) -> np.ndarray:
        """Mask (row,) of the rows of cluster ``c`` in which the site is open, which only a pressed one may be."""
        rows = self.rows(c)
        # A substep ends where such a contact opens or closes: at all nodes it is what it is at one. A node in the
        # middle is farthest from the ends, where rounding decides.
        w = self.motion(c)[:, 0, NODES // 2]
        sites = self._forces.clusters.contacts[self._forces.dofs.first[c] + rows["site"]]
        side = np.sign(rows["mode"])
        return np.asarray((np.abs(rows["mode"]) == PERMANENT) & (side * w < clearance_on(side, sites)))


def _departures(rows: np.ndarray, is_open: np.ndarray, begin: np.ndarray, end: np.ndarray) -> list[tuple[float, float]]:
    """Begin and end in s of each time that one site is closed, or open if it is pressed at rest.

    ``rows`` (row,) are those of the site, ``begin`` and ``end`` (row,) in s the times of their substeps.
    """
    is_pressed = np.abs(rows["mode"]) == PERMANENT
    # The first substep after an onset is marked. One that begins with the orbit is not, though it begins a contact as
    # well: that of a site which is closed at the start.
    closes = (rows["onset"] > 0) | (begin == 0.0)
    # An opening begins after a substep in which the contact is closed.
    opens = is_open & ~np.append(False, is_open[:-1])
    number = np.cumsum(np.where(is_pressed, opens, closes))
    is_away = is_open | ~is_pressed

    departures = []
    for departure in range(1, number.max(initial=0) + 1):
        of_it = is_away & (number == departure)
        departures.append((begin[of_it].min(), end[of_it].max()))
    return departures


def clearance_on(side: np.ndarray, sites: np.ndarray) -> np.ndarray:
    """The clearances (site,) in m of ``sites`` of dtype ``SITE``, each on its ``side``: + above 0, else -."""
    return np.where(side > 0, sites["clearance"], sites["clearance_minus"])
