"""The tape of substeps: marks of substeps with which a contact begins, and rows of closed sites."""

from typing import NamedTuple

import numpy as np

from tests.unit.propagator_parts import mass_on_stop
from vipetsc.contact.law import CLOSED
from vipetsc.dynamics.propagator.nodes import EXIT, NODES, ONSET, PLAIN
from vipetsc.dynamics.propagator.substeps import Substep, create_tape, create_trial, write_on_tape


class TimedOnset(NamedTuple):
    """A substep at ``position`` of a step that begins at ``begin`` s, an ``onset`` in s, and 1 if both coincide."""

    begin: float
    position: float
    onset: float
    begins_contact: int


def timed_onsets(interval: float) -> list[TimedOnset]:
    """Return onsets at the beginning of a substep within roundings of the time, and two that are no onsets there."""
    # A substep of the shortest length, 1e-9 of a step, lies between these onsets and the substep.
    found = [
        TimedOnset(begin=0.0, position=3e-3, onset=(3e-3 - 1e-9) * interval, begins_contact=0),
        TimedOnset(begin=0.0, position=3e-3, onset=(3e-3 + 1e-9) * interval, begins_contact=0),
    ]
    # The rounding of a time of 40 s is much larger than that of the interval.
    for begin, position in ((0.0, 3e-3), (0.7, 0.25), (40.0, 0.999)):
        time = begin + position * interval
        two_roundings = 2.0 * max(np.spacing(time), np.spacing(interval))
        for onset in (time, time - two_roundings, time + two_roundings):
            found.append(TimedOnset(begin, position, onset, begins_contact=1))
    return found


def test_a_tape_marks_the_substep_in_which_a_contact_begins():
    """A contact begins with a substep if its onset equals the beginning up to rounding of two different sums."""
    cluster = mass_on_stop()
    timed = timed_onsets(cluster.interval)
    tape = create_tape(1, len(timed))
    cluster = cluster._replace(tape=tape)

    for each in timed:
        cluster.state["begin"] = each.begin
        cluster.state["position"] = each.position
        cluster.history["onset"] = each.onset
        write_on_tape(cluster, cluster.trial, Substep(PLAIN, 1e-3))

    assert tape.rows["onset"][0].tolist() == [each.begins_contact for each in timed]


def test_a_tape_holds_the_closed_sites_of_a_substep_and_counts_rows_beyond_its_end():
    """A row holds the substep and the motion of its closed site; rows beyond the last are counted alone."""
    tape = create_tape(1, 2)
    cluster = mass_on_stop()
    # Two sites, of which the second one is closed.
    cluster = cluster._replace(
        contacts=cluster.contacts.repeat(2),
        site_motion=np.array([[9.0, 9.0, 9.0], [1.0, 2.0, 3.0]]),
        history=cluster.history.repeat(2),
        tape=tape,
    )
    cluster.state["begin"] = 0.3
    cluster.state["position"] = 0.25
    cluster.contacts["approach"] = [9.0, 0.75]
    trial = create_trial(2, 1)._replace(closed=np.array([1]))
    trial.w[1] = np.arange(NODES)
    trial.v[1] = -np.arange(NODES)

    for kind in (ONSET, EXIT, PLAIN):
        write_on_tape(cluster, trial, Substep(kind, 0.125))

    assert tape.used[0] == 3
    assert tape.rows["kind"].tolist() == [[ONSET, EXIT]]
    substep = {"begin": 0.3, "position": 0.25, "length": 0.125}
    site = {"site": 1, "mode": CLOSED, "approach": 0.75, "rate": 2.0, "acceleration": 3.0}
    for name, value in (substep | site).items():
        assert (tape.rows[name] == value).all(), name
    np.testing.assert_array_equal(tape.motion[0, 1], [np.arange(NODES), -np.arange(NODES)])

    # Without rows nothing is written, and nothing counted.
    cluster = cluster._replace(tape=create_tape(1, 0))
    write_on_tape(cluster, trial, Substep(PLAIN, 0.125))
    assert cluster.tape.used[0] == 0
