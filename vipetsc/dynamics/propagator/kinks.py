"""Where contacts that touch or are pressed at rest, which have no modes, open or close within a substep.

Their force is max(x, 0)^n of the indentation x. Nodes see little of a kink near an end: no substep has one inside.
"""

from vipetsc.compiled import kernel
from vipetsc.contact.changes import LANDED_W
from vipetsc.contact.law import PERMANENT, gap_of
from vipetsc.contact.search import bernstein, first_upcrossing_after_start
from vipetsc.dynamics.propagator.collocation import Cluster, Trial


@kernel
def first_kink(cluster: Cluster, trial: Trial, length: float) -> float:
    """Share of a substep tried at which the first contact without modes opens or closes; 2 if none does inside."""
    first, c = 2.0, trial.sums.bernstein[0]
    for i in trial.closed:
        site = cluster.contacts[i]
        if abs(site.mode) != PERMANENT:
            continue
        side, tolerance = 1.0 if site.mode > 0 else -1.0, LANDED_W * site.scale
        bernstein(cluster.site_motion[i], trial.site_motion[i], length * cluster.interval, c)
        depth, largest = side * c[0] - gap_of(site, side), 0.0
        opens = depth > tolerance or (depth >= -tolerance and side * (c[1] - c[0]) > 0.0)
        for k in range(6):
            c[k] = (gap_of(site, side) - side * c[k]) * (1.0 if opens else -1.0)
            largest = max(largest, c[k])
        if largest > tolerance and abs(c[5]) > tolerance:
            first = min(first, first_upcrossing_after_start(c, tolerance))
    return first
