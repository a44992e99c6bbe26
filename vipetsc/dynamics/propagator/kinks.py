"""Kinks within a substep: where contacts that touch or are pressed at rest open or close.

Such contacts stay in the mode ``PERMANENT``: their force is that of max(x, 0), x the indentation, and not smooth where
they open or close. Substeps end on such a *kink*, but without a landing as on a change of modes: a kink that lies a
little inside the substep's end hardly changes the integral of the force.
"""

from vipetsc.compiled import kernel
from vipetsc.contact.changes import LANDED_W
from vipetsc.contact.law import PERMANENT, gap_of, side_of
from vipetsc.contact.search import bernstein, first_upcrossing_after_start
from vipetsc.dynamics.propagator.substeps import Cluster, Trial


@kernel
def first_kink(cluster: Cluster, trial: Trial, length: float) -> float:
    """Position, as a fraction of a substep tried, at which the first permanent contact opens or closes.

    2 if none does inside.
    """
    first = 2.0
    c = trial.sums.bernstein[0]
    # `closed` are all sites that are not free: a permanent one may be open.
    for i in trial.closed:
        site = cluster.contacts[i]
        if abs(site.mode) < PERMANENT:
            continue
        side = side_of(site.mode)
        gap = gap_of(site, side)
        tolerance = LANDED_W * site.scale
        bernstein(cluster.site_motion[i], trial.site_motion[i], length * cluster.interval, c)

        # It opens if it is closed at the beginning; on the kink itself the direction decides.
        depth = side * c[0] - gap
        opens = depth > tolerance or (depth >= -tolerance and side * (c[1] - c[0]) > 0.0)
        # What rises through zero at the kink: gap - side w where it opens, side w - gap where it closes.
        rises = -1.0
        if opens:
            rises = 1.0
        largest = 0.0
        for k in range(6):
            c[k] = (gap - side * c[k]) * rises
            largest = max(largest, c[k])

        # None inside if no coefficient is beyond the kink, or if the substep already ends on it.
        if largest > tolerance and abs(c[5]) > tolerance:
            first = min(first, first_upcrossing_after_start(c, tolerance))
    return first
