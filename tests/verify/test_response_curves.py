"""Curves of responses over keys and in families; special points, curves that leave them, isolated curves."""

from __future__ import annotations

import json
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

import vipetsc
from tests.rigs import TWO_MASSES, after_a_period, followed, period_map
from tests.steady_states import CUBIC_OSCILLATOR, motion_at
from vipetsc.case import NnmCase
from vipetsc.case.keys import unit_of
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.reading import put
from vipetsc.endings import Ending
from vipetsc.figures.registry import draw, every_branch
from vipetsc.figures.response_family import legend_of
from vipetsc.figures.sweep_members import Files
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.responses import ResponseMethod
from vipetsc.modes.branches.sweeps import measure, parameter_values
from vipetsc.modes.response.state import Response
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state

FREQUENCY = 1.5  # rad/s
# With this clearance the motion of the wall below closes the contact at 1.5 rad/s.
CLOSER = TWO_MASSES | {"contacts": TWO_MASSES["contacts"] | {"clearance": 0.12}}
STEPS = {"first_step": 0.2, "largest_step": 1.0, "harmonics": 11}


def over(key: str, low: float, high: float, table: dict[str, Any] = TWO_MASSES, **nfrc: Any) -> NfrcCase:
    """The case of two masses with curves over a ``key``, at 1.5 rad/s and an amplitude of 0.2 m of the wall."""
    options = {"source": "force", "over": key, "range": [low, high], "fixed": [0.2], "harmonics": 11} | nfrc
    drive = table["drive"] | {"frequency": FREQUENCY}
    return NfrcCase.from_table(table | {"drive": drive, "nfrc": options})


def equations(case: NfrcCase):
    """The equations of the only curve of a case."""
    return ResponseMethod(case).problem(0)


@pytest.fixture(scope="module")
def clearances(tmp_path_factory):
    """The case, the folder and the curve over the clearance, on which two folds and a period doubling lie."""
    folder = tmp_path_factory.mktemp("clearances")
    case = over("contacts.clearance", 0.125, 0.35, harmonics=31, largest_step=1.0)
    (curve,) = follow_all(case, folder, MPI.COMM_SELF)
    return case, folder, curve


@pytest.fixture(scope="module")
def by_frequency(tmp_path_factory):
    """The curve over the frequency, up to 1.5 rad/s, of two masses with a clearance of 0.12 m."""
    options = STEPS | {"source": "force", "over": "frequency", "range": [1.47, FREQUENCY], "fixed": [0.2]}
    folder = tmp_path_factory.mktemp("by-frequency")
    (curve,) = follow_all(NfrcCase.from_table(CLOSER | {"nfrc": options}), folder, MPI.COMM_SELF)
    return curve


@pytest.mark.parametrize(
    ("key", "low", "high"),
    [("contacts.clearance", 0.1, 0.12), ("lattice.cell.masses[1]", 0.98, 1.0), ("lattice.damping.mass", 0.05, 0.06)],
)
def test_it_comes_to_the_state_of_the_curve_over_the_frequency(key, low, high, by_frequency, tmp_path):
    """A curve over a key and one over the frequency end in the same state, at the key's upper value and 1.5 rad/s."""
    (by_key,) = follow_all(over(key, low, high, CLOSER, **STEPS), tmp_path, MPI.COMM_SELF)
    assert by_key.ended.sentence.startswith("reached the end")

    # The upper value of each key is that of the lattice of the curve over the frequency.
    case = NfrcCase.from_table(CLOSER)
    changed = case.model_dump(by_alias=True, exclude_none=True)
    assert not put(changed, key, high)
    assert NfrcCase.from_table(changed).model().chain == case.model().chain
    ends = [curve.points[-1].measured for curve in (by_key, by_frequency)]
    assert ends[0].episodes > 0
    # The frequencies are equal to the bit, since a curve ends exactly on its range.
    assert ends[0].frequency == ends[1].frequency == FREQUENCY
    np.testing.assert_allclose(ends[0].harmonics, ends[1].harmonics, atol=1e-10)
    assert ends[0].unstable == ends[1].unstable


def test_states_come_back_after_a_period_and_are_stable_as_their_multipliers_are(clearances):
    """States return after a period by SciPy with their own clearance, and are stable as its multipliers say."""
    case, _, curve = clearances
    states = equations(case)
    touching = [point for point in curve.points if point.measured.episodes and point.kind == "regular"]
    unstable = set()
    for number in np.linspace(0, len(touching) - 1, 8).astype(int):
        point = touching[number]
        value = float(point.measured.outputs["parameter"])
        inner = states.states_at(value)
        assert inner.forces.contacts[0].plus == value
        # Unknowns are in units of the clearance, which varies along the curve.
        xi = np.append(point.xi[:-1] * states.clearance / inner.clearance, 0.2 / inner.parameter.scale)
        state = np.concatenate([part.ravel() for part in motion_at(inner, xi, np.arange(2))])
        period = period_map(inner, Response(xi=xi), state)
        assert np.abs(period.end - state).max() < 1e-3 * np.abs(state).max()
        grows = np.abs(period.multipliers) > 1.001
        assert point.measured.unstable == np.count_nonzero(grows)
        unstable.add(point.measured.unstable)
    # Both stable and unstable states are among them.
    assert len(unstable) > 1
    folds = parameter_values(curve)[curve.is_kind("fold")]
    values = parameter_values(curve)
    assert len(folds) == 2
    # There are three states at a clearance between the folds.
    assert np.sum(np.diff(np.sign(values - folds.mean())) != 0) == 3


@pytest.mark.parametrize(("key", "low", "high"), [("contacts.restitution", 0.9, 1.0), ("contacts.clearance", 0.1, 0.2)])
def test_a_curve_ends_on_its_range_where_no_case_lies_beyond(key, low, high, tmp_path):
    case = over(key, low, high, CLOSER, first_step=0.2, largest_step=1.0)
    (curve,) = follow_all(case, tmp_path, MPI.COMM_SELF)
    assert curve.ended.sentence == f"reached the end of nfrc.range, {high:g}"
    assert parameter_values(curve)[[0, -1]].tolist() == [low, high]

    # At a restitution of 1 the state is that of the elastic contact.
    if key == "contacts.restitution":
        alone = NfrcCase.from_table(
            CLOSER
            | {
                "drive": CLOSER["drive"] | {"frequency": FREQUENCY},
                "nfrc": {"source": "force", "range": [0.2, 0.3], "fixed": [FREQUENCY], "harmonics": 11},
            }
        )
        elastic = first_state(equations(alone))
        expected = equations(alone).measured(elastic.xi).harmonics
        np.testing.assert_allclose(curve.points[-1].measured.harmonics, expected, atol=1e-10)


SHORT = {"range": [1.2, 1.3], "harmonics": 5, "points": 4}
MASS = "lattice.cell.masses[1]"


def family_case(family: dict[str, Any], drive: dict[str, Any] | None = None, **nfrc: Any) -> NfrcCase:
    """The case of two masses with a ``family`` of curves, and with another ``drive`` if one is given."""
    options = TWO_MASSES["nfrc"] | SHORT | nfrc | {"family": family}
    return NfrcCase.from_table(TWO_MASSES | {"drive": drive or TWO_MASSES["drive"], "nfrc": options})


@pytest.fixture(scope="module")
def family(tmp_path_factory):
    """The folder and the curves of a family over a clearance and a mass."""
    folder = tmp_path_factory.mktemp("family")
    case = family_case({"contacts": {"clearance": [0.8, 0.7]}, MASS: [1.0, 1.1]})
    return folder, follow_all(case, folder, MPI.COMM_SELF)


def test_a_member_is_the_case_with_its_keys(family, tmp_path):
    _, curves = family
    names = [curve.name for curve in curves]
    assert names == [f"clearance-{gap}-masses1-{mass}-r1-0.2" for gap in ("0.8", "0.7") for mass in ("1", "1.1")]

    lattice = TWO_MASSES["lattice"] | {"cell": TWO_MASSES["lattice"]["cell"] | {"masses": [1.1]}}
    contacts = TWO_MASSES["contacts"] | {"clearance": 0.7}
    table = TWO_MASSES | {"lattice": lattice, "contacts": contacts, "nfrc": TWO_MASSES["nfrc"] | SHORT}
    (alone,) = follow_all(NfrcCase.from_table(table), tmp_path, MPI.COMM_SELF)
    assert np.array_equal(measure(alone, "harmonics"), measure(curves[3], "harmonics"))
    assert NfrcCase.from_toml(curves[3].case) == NfrcCase.from_table(table)


def test_files_and_legends_name_the_keys(family):
    folder, _ = family
    (picture,) = [path for path in draw("branches", [folder]) if path.stem == "responses"]
    assert picture.exists()
    curves = []
    for path in sorted(folder.glob("branch-*.h5")):
        with vipetsc.open(path) as data:
            curves.append(data.load())
    assert json.loads(curves[0].attrs["family"]) == {"contacts.clearance": 0.7, MASS: 1.0}
    legend = [text.replace("\u00a0", " ") for text in legend_of(curves)]
    assert legend[0] == "contact clearance 0.7 m, lattice cell masses[1] 1 kg"
    assert len(set(legend)) == 4
    assert unit_of("lattice.cell.springs[1].stiffness", {}) == "N/m"


def test_a_family_is_read_back_and_goes_on(family):
    folder, curves = family
    case = family_case({"contacts": {"clearance": {"linear": [0.8, 0.7], "count": 2}}, MASS: [1.0, 1.1]})
    again = NfrcCase.from_toml(case.to_toml())
    assert [curve.name for curve in again.every_curve()] == [curve.name for curve in curves]
    assert again.physics() == case.physics()
    more = family_case({"contacts": {"clearance": [0.8, 0.7]}, MASS: [1.0, 1.1]}, points=5)
    # The number of points does not belong to the physics: a folder may be continued with more.
    assert more.physics() == case.physics()
    assert other_physics() != case.physics()

    resumed = follow_all(more, folder, MPI.COMM_SELF, resume=True)
    assert [len(curve.regular()) for curve in resumed] == [5] * 4


def other_physics() -> NfrcCase:
    """The physics of a family with another value."""
    return family_case({"contacts": {"clearance": [0.8, 0.6]}, MASS: [1.0, 1.1]}).physics()


# Changes of the rig of two masses with a stop, with the ranges in rad/s in which a complex pair of multipliers passes
# the unit circle, one passes -1, and one passes +1, beyond which the motion is asymmetric.
PAIR = {"nfrc": {"range": [1.12, 1.24]}}
FLIP = {"contacts": {"clearance": 0.1}, "nfrc": {"range": [1.05, 1.15]}}
UNEVEN = {"contacts": {"side": "both", "clearance": 0.05}, "nfrc": {"range": [0.9, 0.95]}}


def case_of(changes: dict[str, Any], **nfrc: Any) -> NfrcCase:
    """The case of two masses with ``changes`` by section, in long steps; ``nfrc`` updates the table [nfrc]."""
    table = TWO_MASSES | {"nfrc": TWO_MASSES["nfrc"] | {"harmonics": 41, "largest_step": 1.0}}
    table |= {section: table[section] | values for section, values in changes.items()}
    return NfrcCase.from_table(table | {"nfrc": table["nfrc"] | nfrc})


@pytest.fixture(scope="module")
def with_pair(tmp_path_factory):
    """The steady states and the points of the curve on which a pair of multipliers passes the unit circle."""
    return followed(case_of(PAIR), tmp_path_factory.mktemp("pair") / "rig")


def multipliers_at(states, point) -> np.ndarray:
    """The Floquet multipliers (4,) of a state, by differences of the period map."""
    state = np.ravel(motion_at(states, point.xi, np.arange(2)))
    return period_map(states, point, state).multipliers


@pytest.mark.parametrize(
    ("changes", "kind", "count"),
    [(PAIR, "neimark-sacker", 2), (FLIP, "period-doubling", 2), (UNEVEN, "branch-point", 1)],
)
def test_a_special_point_has_the_multiplier_of_its_kind(changes, kind, count, tmp_path, request):
    """SciPy's period map at a special point has the multiplier of its kind: -1, 1, or a pair on the unit circle."""
    if changes is PAIR:
        states, points = request.getfixturevalue("with_pair")
    else:
        states, points = followed(case_of(changes), tmp_path / "rig")
    special = [point for point in points if point.kind != "regular"]
    assert [point.kind for point in special] == [kind] * count
    for point in special:
        found = multipliers_at(states, point)
        if kind == "neimark-sacker":
            pair = found[np.argsort(np.abs(np.abs(found) - 1))[:2]]
            np.testing.assert_allclose(np.abs(pair), 1, atol=3e-3)
            np.testing.assert_allclose(np.abs(np.angle(pair)) / (2 * np.pi), point.measured.sideband, atol=1e-3)
        else:
            critical = -1 if kind == "period-doubling" else 1
            assert np.abs(found - critical).min() < 1e-2
            assert point.measured.sideband == (0.5 if critical < 0 else 0.0)
        # Only the critical multipliers have a modulus of 1.
        assert point.measured.unstable == 0
        assert np.abs(found).max() < 1.01

    # On one side of a special point its multipliers exceed 1, on the other side none does.
    places = [points.index(point) for point in special]
    for place in places:
        around = sorted(points[near].measured.unstable for near in (place - 1, place + 1))
        assert around == [0, 2 if kind == "neimark-sacker" else 1]


DAMPING = 0.1


def folding(**nfrc) -> NfrcCase:
    """Return the case of the cubic oscillator by one harmonic, with the curve of its folds."""
    options = {
        "source": "force",
        "over": "frequency",
        "range": [0.5, 2.0],
        "fixed": [0.2],
        "harmonics": 1,
        "isola_reach": 4.5,
    }
    drive = {"waveform": "harmonic", "frequency": 1.0, "amplitude": 1.0, "cell": 1}
    tables = CUBIC_OSCILLATOR | {"name": "duffing", "drive": drive, "time": {"end": 1.0}}
    return NfrcCase.from_table(tables | {"nfrc": options | {"curves_of": ["fold"]} | nfrc})


def test_folds_of_the_duffing_oscillator(tmp_path):
    """On the curve (s - 3A/4)(s - 9A/4) + (c w)^2 = 0 with s = w^2 - 1; its cusp has s = sqrt(3) c w, A = 8s/9.

    A is the square of the motion's amplitude: of one harmonic F^2 = A ((3A/4 - s)^2 + (c w)^2), and dF/dA = 0.
    """
    curve, *special = follow_all(folding(), tmp_path, MPI.COMM_SELF)
    # Both folds lie on one curve, which is followed in both directions.
    assert [branch.name for branch in special] == [f"{curve.name}-fold-curve-1{end}" for end in ("", "-back")]
    for branch in special:
        for point in branch.points:
            omega = point.measured.frequency
            shift = omega**2 - 1
            z = point.measured.outputs["spring_harmonics"] + 1j * point.measured.outputs["spring_harmonics_imaginary"]
            square = abs(z[0, 1]) ** 2
            loss = (DAMPING * omega) ** 2
            assert (shift - 0.75 * square) * (shift - 2.25 * square) + loss == pytest.approx(0, abs=1e-8)
            force = np.sqrt(square * ((0.75 * square - shift) ** 2 + loss))
            assert point.measured.amplitude == pytest.approx(force, rel=1e-9)

    (cusp,) = [point for branch in special for point in branch.points if point.kind == "cusp"]
    omega = (np.sqrt(3) * DAMPING + np.sqrt(3 * DAMPING**2 + 4)) / 2
    shift = omega**2 - 1
    force = np.sqrt(8 * shift / 9 * ((2 * shift / 3 - shift) ** 2 + (DAMPING * omega) ** 2))
    assert [cusp.measured.frequency, cusp.measured.amplitude] == pytest.approx([omega, force], rel=1e-8)
    stored = read_branch(tmp_path / f"branch-{special[1].name}.h5")
    assert [point.kind for point in stored.points] == [point.kind for point in special[1].points]


@pytest.mark.parametrize("changes, kind", [(FLIP, "period-doubling"), (PAIR, "neimark-sacker")], ids=["flip", "pair"])
def test_the_curve_meets_special_points_of_other_amplitudes(changes, kind):
    """A special point that a curve over the frequency has at another amplitude lies on the curve of special points."""
    options = {"harmonics": 21, "isola_reach": 1.03, "points": 300}
    _, *special = follow_all(case_of(changes, curves_of=[kind], largest_step=0.05, **options), None, MPI.COMM_SELF)
    amplitude = 0.205
    (other,) = follow_all(case_of(changes, fixed=[amplitude], **options), None, MPI.COMM_SELF)
    expected = next(point.measured.frequency for point in other.points if point.kind == kind)

    passed = []
    for branch in special:
        assert branch.about["special"] == kind
        frequencies = np.array([point.measured.frequency for point in branch.points])
        amplitudes = np.array([point.measured.amplitude for point in branch.points])
        # A short step: a line errs by its square.
        for i in np.flatnonzero(np.diff(np.sign(amplitudes - amplitude))):
            place = (amplitude - amplitudes[i]) / (amplitudes[i + 1] - amplitudes[i])
            passed.append(frequencies[i] + place * (frequencies[i + 1] - frequencies[i]))
    assert np.abs(np.array(passed) - expected).min() < 2e-4
    at_first = [branch.points[0].measured.frequency for branch in special]
    assert abs(min(at_first, key=lambda value: abs(value - expected)) - expected) > 1e-3


@pytest.mark.parametrize(
    "changes, kind, multiplier, curves, odd_one",
    [(UNEVEN, "branch-point", 1.0, 2, 0), (FLIP, "period-doubling", -1.0, 2, 1)],
    ids=["symmetry", "period"],
)
def test_the_curve_that_leaves(changes, kind, multiplier, curves, odd_one, tmp_path):
    """It begins where a multiplier is +1 or -1; its motions are periodic, and grow as the root of the distance."""
    case = case_of(changes, switch=[kind], harmonics=21, points=60)
    followed = follow_all(case, tmp_path, MPI.COMM_SELF)
    assert len(followed) == curves
    trunk, crossing = followed
    assert crossing.name == f"{trunk.name}-{kind}-1"
    with Files() as files:
        # Pictures of all curves name the first one first.
        assert [path.stem for path in every_branch([tmp_path], files)] == [f"branch-{curve.name}" for curve in followed]
    point = next(point for point in trunk.points if point.kind == kind)
    states = SteadyStates(case, 1.0, case.nfrc.fixed[0])
    state = np.ravel(motion_at(states, point.xi, np.arange(2)))
    multipliers = period_map(states, point, state).multipliers
    # With 21 harmonics the motion itself has an error of 1e-3.
    assert np.abs(multipliers - multiplier).min() < 0.03

    # The square of the new harmonic is linear in the frequency, and vanishes at the special point.
    first = crossing.points[:3]
    frequencies = np.array([p.measured.frequency for p in first])
    squares = np.array([abs(p.measured.harmonics[0, odd_one]) ** 2 for p in first])
    line = np.polyfit(squares, frequencies, 1)
    assert line[1] == pytest.approx(point.measured.frequency, abs=2e-4)
    assert abs(frequencies[-1] - line[1]) > 1e-4

    # The file has the case with the harmonics of the crossing curve. Its motions are those of the equations in time.
    stored = read_branch(tmp_path / f"branch-{crossing.name}.h5")
    case = type(case).from_toml(stored.case)
    assert case.nfrc.subharmonic == (2 if kind == "period-doubling" else 1)
    assert case.nfrc.symmetric is False
    states = SteadyStates(case, 1.0, case.nfrc.fixed[0])
    for p in crossing.regular()[4:12:4]:
        state = np.ravel(motion_at(states, p.xi, np.arange(2)))
        after = state
        for _ in range(case.nfrc.subharmonic):
            before = after
            after = after_a_period(states, p, before)
        size = np.abs(state).max()
        assert np.abs(after - state).max() < 0.02 * size
        if kind == "period-doubling":
            assert np.abs(before - state).max() > 0.05 * size


# A hardening oscillator with a nonlinear tuned vibration absorber of a twentieth of its mass, from Detroux et al.
# (2015). The dashpot is ten times theirs, so that the isolated curve is short.
PRIMARY = {"start": 1, "end": 1, "stiffness": 0.5, "cubic": 0.5, "damping": 0.01, "next_cell": True}
ABSORBER = {"start": 1, "end": 2, "stiffness": 0.0454, "cubic": 0.0042, "damping": 0.0128}
TABLE: dict[str, Any] = {
    "name": "absorber",
    "lattice": {"cells": 1, "cell": {"masses": [1.0, 0.05], "springs": [PRIMARY, ABSORBER], "contact": [1, 2]}},
    "contacts": {"sites": []},
    "drive": {"waveform": "harmonic", "amplitude": 0.18, "frequency": 1.0, "cell": 1, "mass": 1},
    "time": {"end": 10.0},
}


def absorber(force: float = 0.18, **nfrc: Any) -> NfrcCase:
    """The case of curves over the frequency at a ``force`` in N; isolated ones are looked for at 1.725 rad/s."""
    options = {"source": "force", "over": "frequency", "range": [1.55, 1.9], "fixed": [force], "harmonics": 7}
    return NfrcCase.from_table(TABLE | {"nfrc": options | {"isolas": 1, "largest_step": 0.3} | nfrc})


@pytest.fixture(scope="module")
def curves(tmp_path_factory):
    """The folder of the curves at 0.18 N, and the curves: the main one and the isolated one."""
    folder = tmp_path_factory.mktemp("isolas")
    return folder, follow_all(absorber(), folder, MPI.COMM_SELF)


def absorber_equations() -> SteadyStates:
    """The steady states of the oscillator with an absorber at 0.18 N."""
    return SteadyStates(absorber(), 1.0, 0.18)


def state_of(states: SteadyStates, point: Response) -> np.ndarray:
    """The displacements in m and velocities in m/s (4,) of a state at phase 0."""
    return np.concatenate([part.ravel() for part in motion_at(states, point.xi, np.arange(1))])


def test_an_isolated_curve_is_closed_and_has_a_file_of_its_own(curves):
    """The isolated curve ends at its first state, lies apart from the main curve, and has a file and a picture."""
    folder, (main, isola) = curves
    assert main.ended.ending is Ending.END_OF_RANGE
    assert (isola.name, isola.ended.ending) == (f"{main.name}-isola-1", Ending.CLOSED)
    np.testing.assert_array_equal(isola.points[0].xi, isola.points[-1].xi)
    # The elongations of the isolated curve are all larger than those of the main one, so that they do not meet.
    assert measure(main, "largest_elongation")[:, 0].max() < 1.0 < measure(isola, "largest_elongation")[:, 0].min()
    with vipetsc.open(folder / f"branch-{isola.name}.h5") as data:
        assert data.attrs["isola"] == "1"
    with vipetsc.open(folder / f"branch-{main.name}.h5") as data:
        assert "isola" not in data.attrs
    assert sorted(path.stem for path in draw("branches", [folder])) == [
        f"branch-{main.name}",
        f"branch-{isola.name}",
        "responses",
    ]


def test_its_two_ends_are_folds_of_the_flow(curves):
    """At the lowest and the highest frequency of an isola, SciPy's map of a period returns the state.

    The map has a multiplier of 1 there, as at any fold.
    """
    _, (_, isola) = curves
    states = absorber_equations()
    folds = [point for point in isola.points if point.kind == "fold"]
    frequencies = measure(isola, "frequency")
    found = sorted(point.measured.frequency for point in folds)
    assert found == [frequencies.min(), frequencies.max()]
    for point in folds:
        state = state_of(states, point)
        period = period_map(states, point, state)
        assert np.abs(period.end - state).max() < 1e-5 * np.abs(state).max()
        assert np.abs(period.multipliers - 1).min() < 1e-2


# The oscillator under a force of 0.3 N. The range of frequencies ends between its two folds, which are at 1.32 and
# 1.83 rad/s.
DUFFING: dict[str, Any] = CUBIC_OSCILLATOR | {
    "name": "duffing",
    "drive": {"waveform": "harmonic", "amplitude": 0.3, "frequency": 1.0, "cell": 1},
    "time": {"end": 10.0},
}


def duffing(**nfrc: Any) -> NfrcCase:
    """The case of the cubic oscillator's curve, with isolated ones sought at four places; ``nfrc`` updates [nfrc]."""
    options = {"source": "force", "over": "frequency", "range": [0.8, 1.6], "fixed": [0.3], "harmonics": 9}
    return NfrcCase.from_table(DUFFING | {"nfrc": options | {"isolas": 4} | nfrc})


def test_other_amplitudes_find_the_states_that_the_curve_from_below_does_not_meet(tmp_path):
    """They find the small motion at 1.6 rad/s, where the curve from below has the large one."""
    main, isola, back = follow_all(duffing(), tmp_path, MPI.COMM_SELF)
    assert (isola.name, back.name) == (f"{main.name}-isola-1", f"{main.name}-isola-1-back")
    first = isola.points[0]
    assert first.measured.frequency == pytest.approx(1.5)
    # The isolated curve goes up to the end of the range, and down to the fold at which a sweep down jumps.
    assert measure(isola, "frequency").max() == pytest.approx(1.6)
    (fold,) = [point.measured.frequency for point in back.points if point.kind == "fold"]
    assert fold == measure(back, "frequency").min()
    assert back.points[-1].measured.frequency == pytest.approx(1.6)

    # The first harmonic a of the cubic oscillator satisfies |1 - Om^2 + 3/4 a^2 + i c Om| a = F, up to a small
    # correction by the third harmonic.
    ends = [curve.points[-1].measured.outputs for curve in (isola, back)]
    a = min(np.hypot(end["spring_harmonics"][0, 1], end["spring_harmonics_imaginary"][0, 1]) for end in ends)
    stiffness = 1 - 1.6**2 + 0.75 * a**2
    assert a == pytest.approx(0.3 / abs(stiffness + 0.16j), rel=1e-3)


LARGE_FORCE = 16.0


def subharmonic(small: float, **nfrc) -> NfrcCase:
    """Return the case u'' + 2 small DAMPING u' + u + small u^3 = LARGE_FORCE cos(Om t)."""
    spring = {"start": 1, "end": 1, "stiffness": 0.5, "cubic": 0.5 * small, "damping": DAMPING * small}
    cell = {"masses": [1.0], "springs": [spring | {"next_cell": True}], "contact": [1, 1]}
    options = {"source": "force", "over": "frequency", "fixed": [LARGE_FORCE], "subharmonic": 3, "isolas": 2}
    drive = {"waveform": "harmonic", "frequency": 3.0, "amplitude": 1.0, "cell": 1}
    tables = {"lattice": {"cells": 1, "cell": cell}, "contacts": {"sites": []}, "drive": drive, "time": {"end": 1.0}}
    return NfrcCase.from_table(tables | {"name": "duffing", "nfrc": options | nfrc})


def test_the_fold_is_that_of_multiple_scales():
    """For small terms the fold and its amplitude are those of Nayfeh and Mook (1979), section 4.1.4.

    With Om = 3 + small s: 9 mu^2 + (s - 9 L^2 - 9 a^2/8)^2 = 81 L^2 a^2/16, L = LARGE_FORCE/(2 (1 - 9)), mu = DAMPING.
    """
    folds = []
    for small in (1e-3, 1e-4):
        case = subharmonic(small, range=[3 + 7 * small, 3 + 12 * small], harmonics=9)
        curves = follow_all(case, None, MPI.COMM_SELF)
        assert curves[0].about["drive_harmonic"] == 3
        # All shifts in time of a motion are one curve, which leaves the range at both ends.
        assert len(curves) == 3
        assert [point.kind for point in curves[0].points if point.kind != "regular"] == []
        (fold,) = [point for curve in curves for point in curve.points if point.kind == "fold"]
        first = fold.measured.outputs["spring_harmonics"] + 1j * fold.measured.outputs["spring_harmonics_imaginary"]
        folds.append([(fold.measured.frequency - 3) / small, abs(first[0, 1])])

    rho = 9 / 8
    level = LARGE_FORCE**2 / (2 * (1 - 9)) ** 2
    slope = 81 * level / 16
    detuning = (36 * (rho * DAMPING) ** 2 - slope**2) / (4 * rho * slope)
    amplitude = np.sqrt((2 * rho * detuning + slope) / (2 * rho**2))
    # The method's error is of first order in ``small``.
    extrapolated = (10 * np.array(folds[1]) - folds[0]) / 9
    np.testing.assert_allclose(extrapolated, [detuning + 9 * level, amplitude], rtol=3e-4)


def test_motions_close_after_three_periods_and_have_their_stability():
    """Integrated in time, states return after three periods and not after one, and as many multipliers grow as said."""
    small = 0.05
    curves = follow_all(subharmonic(small, range=[3.1, 3.6], harmonics=27), None, MPI.COMM_SELF)
    numbers = set()
    for point in [point for curve in curves[1:] for point in curve.regular()[::16]]:
        omega = point.measured.frequency
        z = (point.measured.outputs["spring_harmonics"] + 1j * point.measured.outputs["spring_harmonics_imaginary"])[0]
        rates = 1j * omega / 3 * np.arange(len(z))
        begin = np.array([z.real.sum(), (rates * z).real.sum()])

        def after(periods, state, omega=omega):
            def rate(t, y):
                return [y[1], LARGE_FORCE * np.cos(omega * t) - 2 * small * DAMPING * y[1] - y[0] - small * y[0] ** 3]

            end = periods * 2 * np.pi / omega
            return solve_ivp(rate, (0, end), state, rtol=1e-10, atol=1e-12).y[:, -1]

        np.testing.assert_allclose(after(3, begin), begin, atol=1e-5)
        assert np.abs(after(1, begin) - begin).max() > 0.1
        step = 1e-5 * np.eye(2)
        monodromy = np.column_stack([after(3, begin + d) - after(3, begin - d) for d in step]) / 2e-5
        growing = int(np.sum(np.abs(np.linalg.eigvals(monodromy)) > 1))
        assert point.measured.unstable == growing
        numbers.add(growing)
    assert numbers == {0, 1}


SMALL_FORCE = 0.2


def response(points_at, **output) -> NfrcCase:
    """Return the case of the cubic oscillator by one harmonic, over the frequency."""
    nfrc = {"source": "force", "over": "frequency", "range": [0.5, 2.0], "fixed": [SMALL_FORCE], "harmonics": 1}
    drive = {"waveform": "harmonic", "frequency": 1.0, "amplitude": 1.0, "cell": 1}
    tables = CUBIC_OSCILLATOR | {"name": "duffing", "drive": drive, "time": {"end": 1.0}, "output": output}
    return NfrcCase.from_table(tables | {"nfrc": nfrc | {"points_at": points_at}})


def frequencies_at(a: float) -> list[float]:
    """Return the frequencies of the one-harmonic motion of amplitude a: ((1 - w^2 + 3a^2/4)^2 + (cw)^2) a^2 = F^2."""
    b = 1 + 0.75 * a**2
    squares = np.roots([1, DAMPING**2 - 2 * b, b**2 - (SMALL_FORCE / a) ** 2])
    return sorted(float(w) for w in np.sqrt(squares.astype(complex)) if abs(w.imag) < 1e-12 for w in [w.real])


def test_a_response_at_values_of_three_quantities(tmp_path):
    """States of an amplitude, a frequency and a velocity are those of the closed form, with their names in the file."""
    a = 0.6
    points = [{"name": "mass", "cell": 1}]
    case = response({"first_displacement/mass": [a], "frequency": [1.3], "first_velocity/mass": [0.9]}, points=points)
    (curve,) = follow_all(case, tmp_path, MPI.COMM_SELF)

    at = [point for point in curve.points if point.kind == f"first_displacement/mass@{a}"]
    np.testing.assert_allclose([point.measured.frequency for point in at], frequencies_at(a), rtol=1e-9)
    # Three states have this frequency, between the folds.
    sizes = [p.measured.outputs["first_displacement"][0] for p in curve.points if p.kind == "frequency@1.3"]
    assert len(sizes) == 3
    for size in sizes:
        assert np.abs(np.array(frequencies_at(size)) - 1.3).min() < 1e-9
    speeds = [p.measured for p in curve.points if p.kind == "first_velocity/mass@0.9"]
    assert len(speeds) == 2
    for state in speeds:
        assert state.outputs["first_displacement"][0] * state.frequency == pytest.approx(0.9, rel=1e-9)

    stored = read_branch(tmp_path / f"branch-{curve.name}.h5")
    assert [point.kind for point in stored.points] == [point.kind for point in curve.points]


@pytest.mark.parametrize("method", ["shooting", "balance"])
def test_a_mode_at_an_energy_and_a_frequency(method):
    """The mode of u'' + u + u^3 = 0 has the period of the elliptic integral at both points."""
    spring = {"start": 0, "end": 1}
    system = {"masses": [1.0], "springs": [spring | {"stiffness": 1.0}], "smooth": [spring | {"cubic": 1.0}]}
    nnm = {"system": "own", "own": system, "modes": [1], "energy": [0.0, 1.0], "method": method}
    nnm["points_at"] = {"energy": [0.25], "frequency": [1.2]}
    (branch,) = follow_all(NnmCase.from_table({"name": "x", "nnm": nnm}), None, MPI.COMM_SELF)
    (at_energy,) = [point for point in branch.points if point.kind == "energy@0.25"]
    (at_frequency,) = [point for point in branch.points if point.kind == "frequency@1.2"]
    assert at_energy.energy == pytest.approx(0.25, rel=1e-9)
    assert 2 * np.pi * at_frequency.frequency == pytest.approx(1.2, rel=1e-9)
    for point in (at_energy, at_frequency):
        square = np.sqrt(1 + 4 * point.energy) - 1
        period = 4 * ellipk(square / (2 * (1 + square))) / np.sqrt(1 + square)
        assert point.period == pytest.approx(period, rel=1e-7)
