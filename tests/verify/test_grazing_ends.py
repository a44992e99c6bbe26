"""A branch that ends where a stiff contact grazes names the contact and the keys with which it can go on."""

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

from vipetsc.case import NnmCase
from vipetsc.lattice import Contact
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.shooting import grazing_contacts
from vipetsc.modes.system import ContactPair, System


def third_mode_of(own: dict[str, Any], **contacts: Any) -> dict[str, Any]:
    """The table of the third mode of an ``own`` lattice with stiff bilinear ``contacts``."""
    nnm = {"system": "own", "modes": [3], "points": 130, "locate": False, "own": own}
    return {"name": "stiff", "contacts": {"law": "bilinear"} | contacts, "nnm": nnm}


# AT_START has four masses, whose third mode closes the second of three contacts first, at the start of the orbit.
# AT_END has three masses, whose third mode closes the second of two contacts first, at the end of the orbit.
AT_START = third_mode_of(
    {
        "masses": [0.509, 0.8, 1.936, 1.48],
        "springs": [
            {"start": 0, "end": 1, "stiffness": 1707.1},
            {"start": 1, "end": 2, "stiffness": 1207.5},
            {"start": 2, "end": 3, "stiffness": 370.1},
            {"start": 3, "end": 4, "stiffness": 1211.6},
        ],
        "contacts": [
            {"host": 0, "resonator": 1, "clearance": 0.001},
            {"host": 2, "resonator": 3, "clearance": 0.001},
            {"host": 0, "resonator": 2, "clearance": 0.000734},
        ],
    },
    stiffness=5e8,
)
AT_END = third_mode_of(
    {
        "masses": [1.06, 1.042, 0.59],
        "springs": [
            {"start": 0, "end": 1, "stiffness": 771.4},
            {"start": 1, "end": 2, "stiffness": 690.1},
            {"start": 2, "end": 3, "stiffness": 406.0},
        ],
        "contacts": [{"host": 0, "resonator": 3, "clearance": 5e-5}, {"host": 1, "resonator": 2, "clearance": 5e-5}],
    },
    stiffness=5e9,
    side="plus",
)


def ending(table: dict[str, Any], **nnm: Any) -> str:
    """The sentence that says how the branch of a case ends; ``nnm`` updates the table [nnm]."""
    (branch,) = follow_all(NnmCase.from_table(table | {"nnm": table["nnm"] | nnm}), None, MPI.COMM_SELF)
    return branch.ended.sentence


@pytest.mark.parametrize("table", [AT_START, AT_END])
def test_a_branch_that_ends_at_a_touch_names_the_contact(table):
    """A branch that ends at the grazing of contact 2 names it, and goes on with smaller steps and wider guards."""
    assert "contact 2 grazes there" in ending(table)
    assert "points reached" in ending(
        table, smallest_step=1e-18, guards={"corrector": 0.5, "turn": 1.0, "turn_relative": 1.0}
    )


def test_the_chart_of_grazing_leads_through_a_touch_at_the_start():
    assert "points reached" in ending(AT_START, chart="grazing")


def motion(amplitude: float, samples: int = 101) -> np.ndarray:
    """Displacements (samples, 1) of one mass that passes its largest value between two samples."""
    return amplitude * np.cos(np.linspace(-0.99, np.pi - 0.99, samples))[:, None]


def stops(plus: float, minus: float) -> System:
    """One mass with stops at the clearances ``plus`` and ``minus`` in m; a stop of negative clearance is pressed."""
    pair = ContactPair(None, 0, plus, Contact("bilinear", 1e3), clearance_minus=minus)
    return System(np.ones(1), np.eye(1), (pair,))


def test_a_touch_on_either_side_between_samples():
    assert grazing_contacts(stops(1.0, np.inf), motion(1.0)) == [1]
    assert grazing_contacts(stops(np.inf, 1.0), -motion(1.0)) == [1]
    assert grazing_contacts(stops(np.inf, 1.0), motion(1.0)) == []


def test_a_pressed_contact_grazes_where_it_would_open():
    """A contact that is pressed by 1 m on the side + opens, and therefore grazes, at w = -1 m."""
    assert grazing_contacts(stops(-1.0, np.inf), -motion(1.0)) == [1]
    assert grazing_contacts(stops(-1.0, np.inf), motion(1.0)) == []
