"""What holds for every steady state, tried on a zoo of lattices: it repeats itself in time and is as stable as said.

SciPy integrates the equations of motion over a period of the state, and over a period of motions beside it.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import assert_same_bits, datasets, with_sections
from tests.rigs import TWO_MASSES, period_map
from tests.steady_states import motion_at
from tests.verify.test_laws_of_motion import turned_round
from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.response.state import Response
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state

NEXT = {"start": 1, "end": 1, "stiffness": 1.0, "next_cell": True}
INSIDE = {"start": 1, "end": 2, "stiffness": 1.0}
DAMPED = {"mass": 0.1}
FORCE = {"waveform": "harmonic", "amplitude": 0.3, "frequency": 1.0, "cell": 1}
WALL = {"waveform": "harmonic", "amplitude": 0.1, "frequency": 1.0, "end": "left"}
ON_ONE_SIDE = {"law": "bilinear", "stiffness": 5.0, "restitution": 1.0, "sites": [1], "clearance": 0.3, "side": "plus"}
HELD = {"law": "hertz", "stiffness": 20.0, "restitution": 1.0, "sites": [1], "pair": [0, 1], "clearance": 0.0}
PRESSED = HELD | {"side": "minus", "precompression": 0.1}
BETWEEN = PRESSED | {"sites": [1, 2], "pair": [1, 1], "next_cell": True}
RESONATORS = {"masses": [1.0, 0.5], "springs": [INSIDE], "contact": [1, 2]}


class Kind(NamedTuple):
    """A lattice, its contacts and its drive, and where its state is looked for.

    ``error`` is that of a period: contacts have kinks, which any number of harmonics describes to some error alone.
    """

    lattice: dict[str, Any]
    contacts: dict[str, Any]
    drive: dict[str, Any]
    frequency: float
    amplitude: float
    harmonics: int = 31
    error: float = 1e-3
    grows: int | None = None

    def case(self, **nfrc: Any) -> NfrcCase:
        """Return the case of a curve over the amplitude that begins at the state; ``nfrc`` updates its section."""
        options = {"source": "force", "infinite": False, "over": "amplitude", "fixed": [self.frequency]}
        options |= {"range": [self.amplitude, 3 * self.amplitude], "harmonics": self.harmonics}
        table = {
            "name": "zoo",
            "lattice": self.lattice,
            "contacts": self.contacts,
            "time": {"end": 10.0, "sample_interval": 0.1},
        }
        return NfrcCase.from_table(table | {"drive": self.drive, "nfrc": options | nfrc})


def chain(cells: int, masses: int = 1, **spring: Any) -> dict[str, Any]:
    """Return a damped lattice of ``cells`` between walls; ``spring`` updates the spring to the next cell."""
    cell = {"masses": [1.0, 0.5][:masses], "springs": [NEXT | spring], "contact": [1, masses]}
    if masses > 1:
        cell["springs"].append(INSIDE)
    return {"cells": cells, "cell": cell, "damping": DAMPED}


def loose(cell: dict[str, Any], ends: str = "free", cells: int = 3) -> dict[str, Any]:
    """Return a damped lattice that no wall holds."""
    return {"cells": cells, "ends": ends, "cell": cell, "damping": DAMPED}


TWO = {key: TWO_MASSES[key] for key in ("lattice", "contacts", "drive")}
STOPPED = TWO["contacts"]
ZOO = {
    "a wall shakes": Kind(**TWO, frequency=1.25, amplitude=0.2),
    "twice the period": Kind(
        chain(1, stiffness=0.75) | {"damping": {"mass": 0.06}},
        STOPPED | {"clearance": 0.0},
        TWO["drive"],
        frequency=4.5,
        amplitude=0.2,
        grows=1,
    ),
    "touching beside a gap": Kind(
        TWO["lattice"],
        {"sites": [1, 2], "pair": [0, 1], "clearance": [0.0, 0.3], "restitution": 1.0}
        | {"each": {"side": ["plus", "minus"], "law": ["hertz", "bilinear"], "stiffness": [9.0, 4.0]}},
        TWO["drive"],
        frequency=1.4,
        amplitude=0.2,
    ),
    "two forces": Kind(
        TWO["lattice"],
        STOPPED,
        FORCE | {"more": [FORCE | {"amplitude": -0.6, "cell": 2}]},
        frequency=1.45,
        amplitude=1.2,
        harmonics=41,
    ),
    "a wall and a force": Kind(
        TWO["lattice"], STOPPED, WALL | {"more": [FORCE]}, frequency=1.45, amplitude=0.4, harmonics=41
    ),
    "hardening": Kind(
        chain(2, cubic=2.0), {"sites": []}, FORCE, frequency=0.8, amplitude=0.3, harmonics=15, error=1e-6
    ),
    "uneven springs": Kind(
        chain(3, cubic=1.0, quadratic=0.4), {"sites": []}, FORCE, frequency=0.9, amplitude=0.2, harmonics=15, error=1e-6
    ),
    "softening": Kind(
        chain(2, cubic=-0.2), {"sites": []}, FORCE, frequency=0.8, amplitude=0.1, harmonics=15, error=1e-6
    ),
    "a stop beside a curved spring": Kind(
        chain(2, cubic=1.0), ON_ONE_SIDE | {"pair": [0, 1]}, FORCE, frequency=0.8, amplitude=0.3
    ),
    "a curved spring in one cell": Kind(
        chain(3, 2) | {"profiles": {"springs[2].cubic": {"cells": [2], "value": 3.0}}},
        {"sites": []},
        FORCE,
        frequency=0.7,
        amplitude=0.2,
        harmonics=15,
        error=1e-6,
    ),
    "scattered cells": Kind(
        chain(4, 2)
        | {"profiles": {"masses[1]": {"first": 1.0, "last": 1.2}}, "damping": {"mass": 0.1, "stiffness": 0.02}},
        ON_ONE_SIDE
        | {"sites": [1, 2, 3]}
        | {
            "each": {
                "side": ["plus", "both", "minus"],
                "pair": [[1, 2], [0, 1], [1, 1]],
                "next_cell": [False, False, True],
            }
        }
        | {"clearance": 0.1, "clearance_minus": 0.15},
        FORCE,
        frequency=0.9,
        amplitude=0.3,
    ),
    "held by a contact": Kind(
        loose({"masses": [1.0], "springs": [NEXT | {"stiffness": 3.0}], "contact": [1, 1]}, cells=2),
        PRESSED,
        FORCE | {"cell": 2},
        frequency=1.4,
        amplitude=0.5,
    ),
    "held beside a touch": Kind(
        loose({"masses": [1.0], "springs": [NEXT | {"stiffness": 3.0}], "contact": [1, 1]}, cells=2),
        {key: value for key, value in HELD.items() if key != "pair"}
        | {"sites": [1, 2]}
        | {"each": {"precompression": [0.1, 0.0], "pair": [[0, 1], [0, 1]], "side": ["minus", "plus"]}},
        FORCE | {"cell": 2},
        frequency=1.4,
        amplitude=0.1,
    ),
    "grains": Kind(
        loose({"masses": [1.0], "contact": [1, 1]}), BETWEEN, FORCE | {"cell": 2}, frequency=1.3, amplitude=0.2
    ),
    "a ring of resonators": Kind(
        loose(RESONATORS, "periodic"), BETWEEN | {"sites": [1, 2, 3]}, FORCE | {"cell": 2}, frequency=1.3, amplitude=0.2
    ),
    "grains apart": Kind(
        loose({"masses": [1.0], "contact": [1, 1]}),
        {key: value for key, value in BETWEEN.items() if key != "precompression"} | {"side": "both", "clearance": 0.01},
        FORCE | {"cell": 2},
        frequency=1.3,
        amplitude=0.02,
    ),
}
every_kind = pytest.mark.parametrize("name", ZOO)


@cache
def state_of(name: str) -> tuple[SteadyStates, Response]:
    """Return the equations of a kind, and its state."""
    kind = ZOO[name]
    states = SteadyStates(kind.case(), 1.0, kind.frequency)
    return states, first_state(states)


@every_kind
def test_a_state_repeats_itself_and_is_as_stable_as_said(name):
    """The motion returns after a period, and as many multipliers are beyond 1 as Hill's method counts."""
    states, point = state_of(name)
    measured = states.measured(point.xi)
    # A motion that touches nothing would be the linear one; a nonlinear spring is always in its motion.
    assert not states.case.contacts.sites or measured.episodes > 0
    motion = motion_at(states, point.xi, np.arange(states.case.lattice.cells))
    state = np.concatenate([part.ravel() for part in motion])
    period = period_map(states, point, state)
    assert np.abs(period.end - state).max() < ZOO[name].error * np.abs(state).max()
    growing = np.count_nonzero(np.abs(period.multipliers) > 1.001)
    assert measured.unstable == growing
    if ZOO[name].grows is not None:
        assert growing == ZOO[name].grows
        assert measured.sideband == 0.5


@every_kind
def test_a_lattice_seen_from_the_other_side_has_the_mirrored_state(name):
    """With stops and even springs turned round the motion is the mirrored one, half a period later."""
    kind = ZOO[name]
    table = {"lattice": kind.lattice, "contacts": kind.contacts}
    turned = turned_round(with_sections(table, {}))
    mirrored = kind._replace(lattice=turned["lattice"], contacts=turned["contacts"])
    states, point = state_of(name)
    image = SteadyStates(mirrored.case(), 1.0, kind.frequency)
    expected = states.measured(point.xi)
    found = image.measured(first_state(image).xi)
    z = harmonics_of(expected)
    half_a_period = (-1.0) ** np.arange(z.shape[1])
    np.testing.assert_allclose(harmonics_of(found), -half_a_period * z, atol=1e-7 * np.abs(z).max())
    assert found.unstable == expected.unstable


def harmonics_of(measured: Any) -> np.ndarray:
    """Return harmonics (place, order) in m of the relative motions at contacts and of the nonlinear springs."""
    parts = [measured.harmonics]
    if "spring_harmonics" in measured.outputs:
        parts.append(measured.outputs["spring_harmonics"] + 1j * measured.outputs["spring_harmonics_imaginary"])
    return np.concatenate([part.reshape(-1, part.shape[-1]) for part in parts if part.size])


@pytest.mark.parametrize("name", ["a wall shakes", "uneven springs", "held by a contact"])
def test_a_curve_is_read_back_and_goes_on_to_the_same_bits(name, tmp_path):
    """A curve of two points that goes on to four has the file of one followed at once, and is read back whole."""
    kind = ZOO[name]
    for folder, counts in (("whole", [4]), ("parts", [2, 4])):
        (tmp_path / folder).mkdir()
        for points in counts:
            case = kind.case(points=points, harmonics=9)
            (curve,) = follow_all(case, tmp_path / folder, MPI.COMM_SELF, resume=True)
    file = f"branch-{curve.name}"
    tables = [(tmp_path / folder / f"{file}.csv").read_text() for folder in ("whole", "parts")]
    assert tables[0] == tables[1]
    assert_same_bits(datasets(tmp_path / "whole" / f"{file}.h5"), datasets(tmp_path / "parts" / f"{file}.h5"))
    again = read_branch(tmp_path / "whole" / f"{file}.h5")
    for read, point in zip(again.points, curve.points, strict=True):
        assert read.xi.tobytes() == point.xi.tobytes()
        assert read.measured.unstable == point.measured.unstable
