"""Lattices whose cells contacts alone join: modes of a cell, features that are refused, branches and responses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vipetsc.case import Case, CaseError, NnmCase
from vipetsc.case.bodies import bodies_of
from vipetsc.case.nfrc import NfrcCase
from vipetsc.cli.verbs.bands_verb import bands_table, without_bands
from vipetsc.lattice import Chain, Spring, UnitCell, fastest_speed, four_band, modes_of_a_cell, wave_bands, waves_at
from vipetsc.lattice.chain import Pair
from vipetsc.modes.system import System

INSIDE = {"start": 1, "end": 2, "stiffness": 5e3}
CELL = UnitCell((4e-3, 2e-3), (Spring(0, 1, 5e3),), host=0, resonator=1)
LOCAL = np.sqrt(5e3 * (1 / 4e-3 + 1 / 2e-3))  # rad/s, of grain and resonator against each other
PRESSED = {"clearance": 0.0, "side": "minus", "precompression": 1e-4}
APART = {"clearance": 1e-5, "precompression": None, "side": None}


def table(**sections: dict[str, Any]) -> dict[str, Any]:
    """Return the table of four grains with resonators, pressed together; ``sections`` update it, None removes a key."""
    given: dict[str, Any] = {
        "lattice": {"cells": 4, "ends": "free", "cell": {"masses": [4e-3, 2e-3], "springs": [INSIDE]}},
        "contacts": {"stiffness": 1e7, "pair": [1, 1], "next_cell": True, "sites": [1, 2, 3]} | PRESSED,
        "drive": {"amplitude": 1.0, "frequency": 1e3, "cycles": 2},
        "time": {"end": 0.01, "sample_interval": 1e-4},
    }
    merged = given | {name: given.get(name, {}) | values for name, values in sections.items()}
    return {name: {key: value for key, value in part.items() if value is not None} for name, part in merged.items()}


def problem_of(kind: type, **sections: dict[str, Any]) -> tuple[str, str]:
    """Return key and remedy of the only problem of a case."""
    with pytest.raises(CaseError) as error:
        kind.from_table(table(**sections))
    [problem] = error.value.problems
    return problem.key, problem.remedy


def test_springs_within_cells_join_none():
    """A cell joins its neighbours only by a spring to the next cell."""
    assert four_band().joins_cells
    assert not CELL.joins_cells
    assert not UnitCell((1.0,), (), 0, 0).joins_cells


def test_a_cell_alone_has_modes_and_no_waves():
    """Cells without springs between them have the modes of one cell, at 0 and (k (1/m1 + 1/m2))^(1/2), and no bands."""
    assert modes_of_a_cell(CELL) == pytest.approx([0.0, LOCAL], rel=1e-12)
    assert wave_bands(CELL) == ()
    assert fastest_speed(CELL) == 0
    # At the frequency of its mode a band without width would have a wave at every wavenumber.
    for frequency in (0.0, LOCAL, float(modes_of_a_cell(CELL)[1])):
        assert waves_at(CELL, frequency) == ()


def test_bands_say_what_there_is():
    """The verb ``bands`` lists the modes of a cell in place of bands."""
    assert f"each cell has the modes 0.00, {LOCAL:.2f} rad/s for itself" in without_bands(CELL)
    numbers = bands_table(CELL)
    assert numbers["bands"] == numbers["gaps"] == []
    assert numbers["cell_modes"] == pytest.approx([0.0, LOCAL], rel=1e-12)
    # Tables of a cell with bands, or without any spring, have no modes of a cell.
    assert "cell_modes" not in bands_table(four_band()) | bands_table(UnitCell((1.0,), (), 0, 0))


def test_contacts_or_springs_must_join_the_cells():
    assert Case.from_table(table()).model().chain.is_joined
    for contacts in ({"sites": []}, {"pair": [1, 2], "next_cell": None}, {"pair": [0, 1], "next_cell": None}):
        key, remedy = problem_of(Case, contacts=contacts)
        assert key == "lattice.cell.springs"
        assert remedy.startswith("neither springs") and "connect the cells" in remedy


def test_every_mass_belongs_to_the_lattice():
    """A mass that neither a spring nor a contact holds is refused; one that a contact holds is not."""
    three = {"cell": {"masses": [4e-3, 2e-3, 1e-3], "springs": [INSIDE]}}
    key, remedy = problem_of(Case, lattice=three)
    assert key == "lattice.cell.springs" and remedy.startswith("mass 3 is not connected")

    for held in ([2, 3], [0, 3]):
        sites = {"sites": [1, 2, 3, 2], "pair": None, "next_cell": None}
        each = {"pair": [[1, 1]] * 3 + [held], "next_cell": [True] * 3 + [False]}
        assert Case.from_table(table(lattice=three, contacts=sites | {"each": each}))


def test_what_springs_within_cells_have_is_accepted():
    """Springs within cells may have dashpots and nonlinear parts, and cells may differ."""
    spring = INSIDE | {"damping": 0.1, "cubic": 1e9}
    lattice = {
        "cell": {"masses": [4e-3, 2e-3], "springs": [spring]},
        "profiles": {"masses[2]": {"first": 1e-3, "last": 3e-3}},
    }
    chain = Case.from_table(table(lattice=lattice)).model().chain
    assert chain.is_damped and not chain.is_linear and not chain.is_uniform()


@pytest.mark.parametrize("speed", [1e-6, 1.0])
def test_a_struck_grain_has_the_faster_of_its_spring_and_its_contact(speed):
    """A struck grain has the larger of two frequencies: (k/m)^(1/2) by its springs, and pi over the contact time."""
    struck = {"kind": "velocity", "cell": 1, "velocity": speed}
    given = table(contacts=PRESSED | {"precompression": None}, initial=struck)
    del given["drive"]
    case = Case.from_table(given)
    contact = np.pi / case.model().contact.impact_time(speed, 2e-3)
    spring = np.sqrt(5e3 / 4e-3)
    assert (contact > spring) == (speed == 1.0)
    assert case.initial.frequency == pytest.approx(max(contact, spring), rel=1e-9)


def chain_of(pairs: tuple[Pair, ...]) -> Chain:
    """Return two cells with contacts of these ``pairs`` in the first one."""
    return Chain(CELL, 2, "free", sites=(0,) * len(pairs), clearances=(0.0,) * len(pairs), pairs=pairs)


def test_bodies_are_what_springs_and_pressed_contacts_hold_together():
    """Numbers of bodies are those of the ground, then of grain and resonator of each cell."""
    between, ground = Pair(0, 0, offset=1), Pair(-1, 0)
    pressed, apart = (-1e-5, np.inf), (1e-5, np.inf)
    assert bodies_of(chain_of((between,)), [apart]) == [0, 1, 1, 2, 2]
    assert bodies_of(chain_of((between,)), [pressed]) == [0, 1, 1, 1, 1]
    assert bodies_of(chain_of((between, ground)), [pressed, pressed]) == [0, 0, 0, 0, 0]
    assert bodies_of(chain_of((between, ground)), [apart, pressed]) == [0, 0, 0, 1, 1]
    assert bodies_of(chain_of((between,)), [(1e-5, 1e-5)]) == [0, 1, 1, 2, 2]


def modes_case(modes: list[int], contacts: dict[str, Any] | None = None, ends: str = "free") -> dict[str, Any]:
    """Return the table of branches of a whole lattice of grains."""
    given = table(contacts=contacts or {}, lattice={"ends": ends}, nnm={"system": "chain", "modes": modes})
    return {name: given[name] for name in ("lattice", "contacts", "nnm")}


@pytest.mark.parametrize("ends", ["free", "fixed"])
@pytest.mark.parametrize(("contacts", "still"), [({}, 1), (APART, 4)])
def test_branches_begin_where_a_motion_oscillates(ends, contacts, still):
    """Rigid motions are refused by their numbers: one of a pressed chain with any ends, four of four separate grains.

    No spring joins an end to a wall.
    """
    modes = list(range(1, 9))
    with pytest.raises(CaseError, match="can move as a rigid body") as error:
        NnmCase.from_table(modes_case(modes, contacts, ends))
    assert error.value.problems[0].value == modes[:still]

    case = NnmCase.from_table(modes_case(modes[still:], contacts, ends))
    frequencies = System.from_case(case).linear_modes()[0]
    assert np.sum(frequencies < 1e-6 * frequencies[-1]) == still


@pytest.mark.parametrize("nnm", [{}, {"method": "condensed"}, {"system": "condensed", "start_frequency": [4e3]}])
def test_a_stop_on_one_side_pushes_loose_grains_apart(nnm):
    """No unsymmetric motion of grains repeats itself unless they are pressed together."""
    nnm = {"modes": [8]} | nnm
    for contacts in (APART | {"side": "minus"}, APART | {"clearance_minus": 2e-5}):
        given = modes_case([8], contacts)
        given["nnm"] |= nnm
        with pytest.raises(CaseError, match="its mean force pushes them apart") as error:
            NnmCase.from_table(given)
        assert error.value.problems[0].key == "contacts.clearance"
    for contacts in (APART, PRESSED):
        given = modes_case([8], contacts)
        given["nnm"] |= nnm
        assert NnmCase.from_table(given)

    # A quadratic spring makes motions unsymmetric, too.
    given = modes_case([8], APART)
    given["nnm"] |= nnm
    given["lattice"]["cell"] = {"masses": [4e-3, 2e-3], "springs": [INSIDE | {"quadratic": 1e6}]}
    with pytest.raises(CaseError, match="its mean force pushes them apart"):
        NnmCase.from_table(given)


@pytest.mark.parametrize(
    ("side", "joint", "is_refused"), [("plus", [], True), ("both", [], False), ("plus", [1], False)]
)
def test_a_stop_on_one_side_pushes_a_loose_mass_of_ones_own_system_away(side, joint, is_refused):
    """A spring that is not linear holds the mass as a linear one does."""
    own = {
        "masses": [1.0, 1.0],
        "springs": [{"start": 0, "end": 1, "stiffness": 1.0}],
        "smooth": [{"start": start, "end": 2, "cubic": 1.0} for start in joint],
        "contacts": [{"host": 1, "resonator": 2, "clearance": 0.1}],
    }
    given = {"contacts": {"stiffness": 10.0, "side": side}, "nnm": {"system": "own", "modes": [2], "own": own}}
    if not is_refused:
        assert NnmCase.from_table(given)
        return
    with pytest.raises(CaseError, match="its mean force pushes them apart"):
        NnmCase.from_table(given)


def test_modes_of_a_pressed_chain_are_those_of_masses_in_masses():
    """The modes of n pressed grains have kappa = j pi/n with free ends.

    Both branches solve (q + k2 - m1 w^2)(k2 - m2 w^2) = k2^2 with q = 4 k sin^2(kappa/2) and the slope k of the
    contact's force, 3/2 times the stiffness times the square root of the precompression.
    """
    slope = 1.5 * 1e7 * 1e-4**0.5
    expected = []
    for j in range(4):
        pull = 4 * slope * np.sin(j * np.pi / 8) ** 2
        matrix = np.array([[pull + 5e3, -5e3], [-5e3, 5e3]]) / np.array([[4e-3], [2e-3]])
        expected += np.sqrt(np.abs(np.linalg.eigvals(matrix))).tolist()
    found = System.from_case(NnmCase.from_table(modes_case([2]))).linear_modes()[0]
    assert found == pytest.approx(sorted(expected), rel=1e-9, abs=1e-4)


@pytest.mark.parametrize(
    ("springs", "mode", "is_still"),
    [
        # A spring between the pair alone lets it move as a whole; a spring to a third mass holds the resonator.
        ([INSIDE], 1, True),
        ([INSIDE], 2, False),
        ([INSIDE, {"start": 2, "end": 3, "stiffness": 1e3}], 1, False),
    ],
)
def test_the_reduced_model_of_a_cell_may_be_free(springs, mode, is_still):
    """The reduced model refuses its rigid motion as mode 1 if no spring holds the pair."""
    cell = {"masses": [4e-3, 2e-3, 1e-3], "springs": springs}
    given = {
        "lattice": {"cell": cell, "cells": 4},
        "contacts": {"stiffness": 1e7, "clearance": 1e-5},
        "nnm": {"system": "reduced", "modes": [mode]},
    }
    if not is_still:
        assert NnmCase.from_table(given)
        return
    with pytest.raises(CaseError, match="can move as a rigid body"):
        NnmCase.from_table(given)


def response(**sections: dict[str, Any]) -> dict[str, Any]:
    """Return the table of a frequency response of grains."""
    nfrc = {"source": "force", "range": [0.1, 1.0], "harmonics": 5} | sections.pop("nfrc", {})
    return table(nfrc=nfrc, **sections)


def test_responses_are_those_of_a_pressed_chain():
    """Pressed contacts are springs of the chain; contacts apart are accepted on both sides alone.

    The mean force of a contact on one side pushes grains, which no spring holds, apart.
    """
    case = NfrcCase.from_table(response())
    assert case.are_contacts_springs and not case.nfrc.infinite
    assert NfrcCase.from_table(response(contacts=APART)).nfrc.symmetric
    with pytest.raises(CaseError, match="its mean force pushes them apart"):
        NfrcCase.from_table(response(contacts=APART | {"side": "minus"}))
    # Springs hold masses that a contact within a cell would push apart.
    inside = {"sites": [1, 2, 3, 2], "pair": None, "next_cell": None, "precompression": None}
    each = {"pair": [[1, 1]] * 3 + [[1, 2]], "next_cell": [True] * 3 + [False], "precompression": [1e-4] * 3 + [0.0]}
    assert NfrcCase.from_table(response(contacts=inside | {"each": each}))
