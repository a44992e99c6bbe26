"""Branches of normal modes: steps, ends, special points, switching, files, a published benchmark."""

from __future__ import annotations

import itertools
import json
import tomllib
from collections.abc import Iterable
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from mpi4py import MPI

import h5py
import numpy as np
import pytest

from tests.models import IN_PHASE, KERSCHEN, OUT_OF_PHASE, kerschen_system, reduced_model
from tests.verify.conftest import follow
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.nnm import Guards, NnmCase, NnmTable
from vipetsc.endings import Ending
from vipetsc.figures.frequency_energy import backbone
from vipetsc.figures.registry import drawings
from vipetsc.figures.sweep_members import Files
from vipetsc.lattice import Contact
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.branch_checks import BranchMonitor
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import Listener, follow_all
from vipetsc.modes.branches.orbits import ShootingMethod
from vipetsc.modes.continuation.arclength import Continuation, Segment, half_trace_change, locate
from vipetsc.modes.continuation.switching import switch
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.point import Point
from vipetsc.modes.problem import ContinuationError, unit
from vipetsc.modes.shooting import Relative, Shooting, grazing_contacts, linear_start, repetitions, resonance
from vipetsc.modes.system import ContactPair, System
from vipetsc.parallel import StopRequest


def test_degenerate_tangent_is_named():
    """Two equal oscillators without coupling have no tangent: every combination of them is an orbit."""
    system = System.assemble([1.0, 1.0], [(None, 0, 1.0), (None, 1, 1.0)])
    problem = Shooting(Dop853Flow(system), MAPS["half"])
    frame = problem.relative_frame(np.array([1.0, 0.5]), 2 * np.pi)
    attempt = frame.solve(frame.xi, np.array([1.0, 0.0, 0.0]), frame.xi[0])

    # The amplitudes 1 and 0.5 have the energy E = (1^2 + 0.5^2)/2.
    with pytest.raises(ContinuationError, match=r"degenerate tangent at E = 0.625 J"):
        Continuation(problem, frame.measures(attempt), NnmTable())


def test_kerschen_benchmark():
    """Modes of Kerschen and Peeters (2009): out of phase up to E = 1e6 J, in phase through the tongues 3:1 and 5:1."""
    system = kerschen_system()
    assert system.linear_modes()[0] == pytest.approx([1.0, np.sqrt(3)], rel=1e-14)

    in_phase = follow(system, IN_PHASE, 1e-3, energy=[0.0, 1.1e5])
    assert in_phase.points[-1].energy > 1.1e5
    assert in_phase.points[0].frequency == pytest.approx(1 / (2 * np.pi), rel=1e-3)
    assert max(point.residual for point in in_phase.points) <= 1e-12

    tips = {resonance(in_phase.problem, point) for point in in_phase.of_kind("fold-energy")}
    assert {3, 5} <= tips

    out_of_phase = follow(system, OUT_OF_PHASE, 1e-3, energy=[0.0, 1e6])
    assert out_of_phase.points[-1].energy > 1e6

    # At high energy mass 1 moves on its cubic spring alone, for which f ~ E^(1/4).
    high = [point for point in out_of_phase.points if point.energy > 1e4]
    energy = np.array([point.energy for point in high])
    frequency = np.array([point.frequency for point in high])
    exponent = np.polyfit(np.log(energy), np.log(frequency), 1)[0]
    assert exponent == pytest.approx(0.25, abs=0.01)


@pytest.fixture(scope="module")
def kerschen_in_phase():
    """The in-phase branch of the benchmark as far as its first crossings of both kinds."""
    return follow(kerschen_system(), IN_PHASE, 1e-3, energy=[0.0, 4500.0], frequency=[0.0, 1.4005])


@pytest.mark.parametrize(("kind", "periods"), [("symmetry-breaking", 1), ("period-doubling", 2)])
def test_branch_switching(kind, periods, kerschen_in_phase):
    """The crossing branch starts at the special point, and its orbits have lost the symmetry of the first one."""
    point = kerschen_in_phase.of_kind(kind)[0]

    problem, first = switch(kerschen_in_phase.problem, point)
    assert first.energy == pytest.approx(point.energy, rel=1e-3)
    assert first.period == pytest.approx(periods * point.period, rel=1e-3)

    *_, far = Continuation(problem, first, NnmTable(points=10))
    assert far.residual <= 1e-11

    # An orbit of the first branch that begins at rest passes through zero after a quarter period, and one that begins
    # at zero is then at rest. Orbits of the crossing branch do neither.
    arc = problem.arc(far.x, far.period)
    quarter = problem.flow.arc(arc.start, far.period / 4, far.period).end
    dofs = problem.system.dofs
    vanishing = quarter[:dofs] if problem.map.start == "rest" else quarter[dofs:]
    assert np.abs(vanishing).max() > 1e-4 * np.abs(quarter).max()


@pytest.mark.parametrize("nudge", [0.0, 1e-9, -1e-9])
def test_a_crossing_at_a_regular_point_is_found(nudge):
    """A regular point on a special one, or within rounding of it, hides neither: it is found once."""
    branch = follow(kerschen_system(), IN_PHASE, 1e-3, energy=[0.0, 500.0])
    problem = branch.problem
    points = branch.points
    for before, left, right in zip(points, points[1:], points[2:], strict=False):
        special = [p for p in locate(problem, left, right, before=before) if p.kind == "symmetry-breaking"]
        if special:
            break
    (known,) = special

    segment = Segment(problem, "relative", left, right)
    on_it = replace(segment.at(known.step + nudge * segment.length), kind="regular", step=known.step)
    first = locate(problem, left, on_it, before=before)
    second = locate(problem, on_it, replace(right, step=segment.length - known.step), before=left)
    (found,) = [p for p in [*first, *second] if p.kind == "symmetry-breaking"]
    assert found.energy == pytest.approx(known.energy, rel=1e-8)


def test_three_branch_points_about_one_change_of_contact_are_found():
    """Where a contact ends within a step, branch points on both sides are found: the half-trace bends up to 1 there."""
    contacts = {"law": "bilinear", "modulus": 1e8, "restitution": 1.0}
    lattice = {"preset": "four-band", "reading": "printed"}
    method = ShootingMethod(NnmCase.from_table({"lattice": lattice, "contacts": contacts, "nnm": {"modes": [1]}}))
    problem = method.shooting
    # The step of the in-phase branch from 633 kJ down to 620 kJ, with a contact less from 625.8 kJ on.
    x = np.array([7.959026812140146, 7.96178915057509])
    frame = problem.relative_frame(x, 0.003143283122999154)
    row = np.append(frame.xi[:-1], 0.0)
    left = frame.measures(frame.solve(frame.xi, row, row @ frame.xi))
    left = replace(left, tangent=np.array([-0.7446639488, -0.7421625468, 4.172e-8]))
    frame = problem.frame(left, "relative")
    left = frame.measures(frame.correct(frame.xi, 0.0), frame.tangent_at(frame.xi))
    frame = problem.frame(left, "relative")
    attempt = frame.correct(frame.xi + 0.1 * frame.tangent, 0.1)
    right = frame.measures(attempt, frame.tangent_at(attempt.xi))
    right = replace(right, index=left.index + 1, step=0.1)

    special = locate(problem, left, right, grazing=True)

    assert [p.kind for p in special] == ["branch-point", "branch-point", "grazing", "branch-point"]
    assert [p.energy for p in special] == pytest.approx([626351.3, 625914.8, 625837.1, 625656.3], rel=1e-6)
    for point in special:
        if point.kind == "branch-point":
            assert point.half_traces[0] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(
    ("name", "bound", "sentence"),
    [
        ("energy", [0.0, 0.0294], "left the energy range 0 to 0.0294 J"),
        ("frequency", [0.0, 2981.4], "left the frequency range 0 to 2981.4 rad/s"),
    ],
)
def test_a_branch_ends_with_the_first_point_beyond_a_range(name, bound, sentence):
    """The last point of a branch, and no other, is beyond the range that it says it has left."""
    problem = Shooting(Dop853Flow(reduced_model()), MAPS["quarter"])
    continuation = Continuation(problem, linear_start(problem, OUT_OF_PHASE, 0.02), NnmTable(**{name: bound}))

    points = list(continuation)

    assert continuation.ended.sentence == sentence
    assert continuation.finished
    unit = {"energy": 1.0, "frequency": 2 * np.pi}[name]  # frequencies of points are in Hz
    outside = [number for number, point in enumerate(points, 1) if unit * getattr(point, name) > bound[1]]
    assert outside == [len(points)]


def test_guards_are_what_the_points_obey(short_branch):
    """No step strains a guard beyond its bound; some are held back by the half-trace, some by the turn."""
    guards = Guards()
    turns = []
    changes = []
    for before, after in itertools.pairwise(short_branch.points):
        chart = Relative(reduced_model(), before.x, before.period)
        derivative = chart.derivative(chart.encode(before.x, before.period))
        first, second = (unit(np.linalg.solve(derivative, point.tangent)) for point in (before, after))

        turns.append(np.arccos(np.clip(first @ second, -1, 1)))
        changes.append(half_trace_change(before, after))

    # Bounds that no step comes near would not be tested by this branch.
    assert 0.3 * guards.half_trace < max(changes) <= guards.half_trace
    assert 0.3 * guards.turn < max(turns) <= guards.turn


def in_phase_hertz(**control) -> tuple[Shooting, list[Point]]:
    """Follow the in-phase Hertz branch in the chart auto, up to just behind the tip of its 3:1 tongue."""
    system = reduced_model("hertz")
    problem = Shooting(Dop853Flow(system), MAPS["quarter"])
    start = linear_start(problem, IN_PHASE, system.grazing_energy(IN_PHASE) / 100)
    table = {"points": 150, "chart": "auto", "energy": [0, 6e9]} | control
    continuation = Continuation(problem, start, NnmTable(**table))
    return problem, [continuation.point, *continuation]


def findings(problem: Shooting, points: list[Point]) -> list[str]:
    """Return what the monitor of a growing branch reports at its points."""
    monitor = BranchMonitor(problem, Guards())
    return [ended.sentence for ended in map(monitor.check, points) if ended]


# The tip of the in-phase Hertz branch's 3:1 tongue lies on the out-of-phase branch. A step too long for the turn at the
# tip leads onto the out-of-phase branch, and the grazing chart hides that turn. The true branch comes back from the
# tip, where it passes c = 1, and none of its orbits repeats another one.
def test_guarded_the_in_phase_hertz_branch_comes_back_from_the_tip():
    """With the guard on turns the in-phase branch comes back from the tip, and no check reports anything."""
    problem, points = in_phase_hertz()

    assert max(problem.turn(a, b) for a, b in itertools.pairwise(points)) > 0.2
    assert findings(problem, points) == []
    assert points[-1].energy < points[124].energy < 0.031


def of_kind(kind: str, points: Iterable[Point]) -> list[Point]:
    """Return the points of one kind."""
    return [point for point in points if point.kind == kind]


def folding_steps(points: list[Point]) -> list[tuple[Point, Point]]:
    """Return the steps in contact over which the energy turns."""
    steps = itertools.pairwise(points)
    return [(a, b) for a, b in steps if a.energy_tangent * b.energy_tangent < 0 and a.episodes > 0]


@pytest.mark.parametrize("sign", [1, -1])
def test_energy_folds_are_where_the_energy_turns(short_branch, sign):
    """Two folds are found in both directions along a branch, where the energy is stationary and a half-trace is 1."""
    problem = short_branch.problem
    points = [
        replace(point, tangent=sign * point.tangent, energy_tangent=sign * point.energy_tangent)
        for point in short_branch.points[::sign]
    ]

    turning = folding_steps(points)
    assert len(turning) == 2
    for a, b in turning:
        (fold,) = of_kind("fold-energy", locate(problem, a, b))
        assert abs(fold.energy_tangent) <= 1e-9 * abs(a.energy_tangent)
        assert fold.half_traces[0] == pytest.approx(1, abs=1e-6)

    # No fold is found far from these two.
    for a, b in itertools.pairwise(points[-20:]):
        assert not of_kind("fold-energy", locate(problem, a, b))


class RoundedPoint(NamedTuple):
    """A point of a branch in few digits: displacements in m, period in s, and the arclength of the step to it."""

    x: list[float]
    period: float
    step: float

    def on_branch(self, problem: Shooting) -> Point:
        """Return the point of the branch nearby, with falling period along its tangent."""
        frame = problem.relative_frame(np.array(self.x), self.period)
        tangent = np.linalg.svd(frame.jacobian(frame.xi))[2][-1]
        attempt = frame.solve(frame.xi, tangent, tangent @ frame.xi)
        assert attempt.converged
        return replace(frame.measures(attempt, -tangent * np.sign(tangent[-1])), step=self.step)


# Three successive points of the in-phase Hertz branch for each kind, near 1.0e6 J for the first and 1.7e7 J for the
# second.
PAIRS = {
    "symmetry-breaking": [
        RoundedPoint([-9.151145747905344, -9.226299568925315], 0.003148020146748403, 0.0986),
        RoundedPoint([-9.869904521950374, -9.949778169710124], 0.0031478468939554415, 0.1),
        RoundedPoint([-10.564752182727462, -10.650004848960046], 0.0031476911959756027, 0.0969),
    ],
    "fold-energy": [
        RoundedPoint([-41.58157519928831, -41.827813151364275], 0.003145313850191308, 0.0109),
        RoundedPoint([-41.592476734313195, -41.841905100306086], 0.003145304127065715, 0.013),
        RoundedPoint([-41.58941483494171, -41.843776559314165], 0.0031452884555063713, 0.0198),
    ],
}


@pytest.mark.parametrize("kind", PAIRS)
def test_two_special_points_within_a_step_are_found(kind):
    """Two special points within one step are found by means of the step before."""
    problem = Shooting(Dop853Flow(reduced_model("hertz")), MAPS["quarter"])
    before, left, right = (rounded.on_branch(problem) for rounded in PAIRS[kind])

    pair = of_kind(kind, locate(problem, left, right, before=before))

    assert len(pair) == 2
    assert 0 < pair[0].step < pair[1].step < right.step
    for point in pair:
        residuals = {"symmetry-breaking": point.half_traces[0] + 1, "fold-energy": point.energy_tangent / point.energy}
        assert abs(residuals[kind]) <= 1e-8

    # Without the point before, the turn of the test function is not seen.
    assert not of_kind(kind, locate(problem, left, right))


def first_doubling(problem: Shooting, points: list[Point]) -> Point:
    """Return the first period doubling in contact near the grazing energy, 0.02934 J."""
    for a, b in itertools.pairwise(points):
        if a.energy < 0.02935 and b.episodes:
            doublings = of_kind("period-doubling", locate(problem, a, b))
            if doublings:
                return doublings[0]
    pytest.fail("the branch has no period doubling near grazing")


def test_a_period_doubled_orbit_is_off_its_parent(short_branch):
    """The switch at a period doubling ends on an orbit of the doubled period, not on the parent passed twice."""
    problem = short_branch.problem
    point = first_doubling(problem, short_branch.points)

    doubled_problem, first = switch(problem, point)

    assert repetitions(doubled_problem, first) == 1
    assert first.energy == pytest.approx(point.energy, rel=1e-3)
    assert first.period == pytest.approx(2 * point.period, rel=1e-3)
    # The doubled period passes the parent twice.
    parent = replace(first, x=point.x, period=2 * point.period)
    assert repetitions(doubled_problem, parent) == 2


NAME = "branch-out-of-phase"


def follow_stops(folder: Path, listener=None, stop=None, resume=False, saves_all=False, **nnm) -> Branch:
    """Follow the out-of-phase branch of linear stops as a case asks for it; ``nnm`` updates its table [nnm].

    With ``saves_all`` the branch is written after every point, whatever the clock says.
    """
    folder.mkdir(exist_ok=True)
    table = {
        "name": "x",
        "lattice": {"preset": "four-band", "reading": "printed"},
        "contacts": {"law": "bilinear", "modulus": 1e8},
        "nnm": {"modes": [2], "chart": "auto"} | nnm,
    }
    case = NnmCase.from_table(table)
    with pytest.MonkeyPatch.context() as patch:
        if saves_all:
            patch.setattr("vipetsc.modes.branches.follow.SAVE_EVERY", 0.0)
        return follow_all(case, folder, MPI.COMM_SELF, resume=resume, listener=listener, stop=stop)[0]


def test_orbits_have_the_energies_that_are_asked_for(tmp_path):
    """A branch samples its orbits at the energies asked for: three orbits between its folds at 0.0264 and 0.02934 J."""
    branch = follow_stops(tmp_path / "a", energy=[0.0, 0.05], orbits_at=[0.028, 0.0316, 9.0], locate=False)

    # The orbits asked for come after the orbits that every branch samples.
    energies = branch.extra["orbits/energy"].values[-4:]
    periods = branch.extra["orbits/period"].values[-4:]
    assert energies == pytest.approx([0.028] * 3 + [0.0316], rel=1e-12)
    assert len(set(periods)) == 4
    assert branch.missing == ["the branch has no orbit of 9 J"]


BOTH = {"direction": "both", "start_energy": 0.029, "energy": [0.01, 0.0295], "locate": False}


def test_both_directions_are_two_branches(tmp_path):
    """Each has files of its own, and both begin at one point; the picture joins them in the order of the curve."""
    whole = follow_stops(tmp_path, **BOTH)
    down = read_branch(tmp_path / f"{NAME}-down.h5")
    assert whole.complete
    assert down.complete
    assert whole.points[0].energy == down.points[0].energy
    assert whole.points[1].energy > whole.points[0].energy
    assert down.points[-1].energy < 0.01 < down.points[-2].energy
    energies = [point.energy for point in [*reversed(down.points[1:]), *whole.points]]
    for name, expected in ((NAME, energies), (f"{NAME}-down", [point.energy for point in down.points])):
        drawn = backbone([tmp_path / f"{name}.h5"]).get_axes()[0]
        assert drawn.get_xlim() == (min(expected), max(expected))
        curve = max((line.get_xdata() for line in drawn.lines), key=len)
        distances = np.abs(np.subtract.outer(expected, curve) / curve)
        assert distances.min(axis=1).max() < 1e-12
        assert (np.diff(distances.argmin(axis=1)) > 0).all()

    # Warnings of the part towards smaller energies are those of the joined picture, too.
    with h5py.File(tmp_path / f"{NAME}-down.h5", "r+") as file:
        file.attrs["warnings"] = json.dumps(["a warning"])
    with Files() as files:
        labels = {one.stem: one.draw().get_label() for one in drawings("branches", [tmp_path], files, ["branch"])}
    assert set(labels) == {NAME, f"{NAME}-down"}
    assert all("a warning" in label for label in labels.values())


@pytest.mark.parametrize("method", ["balance", "damped"])
def test_pictures_of_harmonics_join_both_directions(method, tmp_path):
    """The curve of a branch that begins in its middle has all energies, also with other numbers of harmonics."""
    ground = {"start": 0, "end": 1}
    own = {
        "masses": [1.0],
        "springs": [ground | {"stiffness": 1.0}],
        "smooth": [ground | {"cubic": 1.0}],
        "dashpots": [ground | {"damping": 0.02}],
    }
    nnm = {"system": "own", "method": method, "modes": [1], "own": own, "energy": [0.01, 10.0], "start_energy": 0.1}
    case = NnmCase.from_table({"nnm": nnm | {"direction": "both"}})
    up, down = follow_all(case, tmp_path, MPI.COMM_SELF)

    with Files() as files:
        pictures = {one.stem: one.draw() for one in drawings("branches", [tmp_path], files, ["branch"])}
    for branch, parts in ((up, [up, down]), (down, [down])):
        energies = np.concatenate([[point.energy for point in part.points] for part in parts])
        low, high = pictures[f"branch-{branch.name}"].get_axes()[0].dataLim.intervalx
        assert (low, high) == pytest.approx((energies.min(), energies.max()))


def follow_masses(
    folder: Path, listener: Listener | None = None, stop: StopRequest | None = None, **nnm: Any
) -> Branch[Any]:
    """The out-of-phase branch of the two masses in ``folder``, begun or continued; ``nnm`` updates its table [nnm]."""
    folder.mkdir(exist_ok=True)
    nnm = {"modes": [2], "start_energy": 1.0, "energy": [0.5, 20.0], "first_step": 0.05} | nnm
    case = NnmCase.from_table({"name": "x", "nnm": {"system": "own", "own": KERSCHEN} | nnm})
    (branch,) = follow_all(case, folder, MPI.COMM_SELF, resume=True, listener=listener, stop=stop)
    return branch


def stopped_at(folder: Path, index: int, **nnm: Any) -> Branch[Any]:
    """The branch that was stopped at its point ``index``."""
    stop = StopRequest()

    def listener(branch: Branch[Any], point: Any) -> None:
        stop.requested = point.index == index

    branch = follow_masses(folder, listener, stop, **nnm)
    assert branch.ended.sentence == f"stopped on request after point {index}; continue with --resume"
    return branch


def test_a_branch_that_other_sources_began_is_computed_again(tmp_path):
    """The points of other sources are dropped while a branch is not complete, and stay where it is."""
    stopped_at(tmp_path, 3)
    path = tmp_path / "branch-out-of-phase.h5"
    with h5py.File(path, "r+") as file:
        file.attrs["source"] = "0.1.0+other"
        file["energy"][0] = -1.0
    whole = follow_masses(tmp_path)
    assert whole.complete and whole.points[0].energy > 0

    with h5py.File(path, "r+") as file:
        file.attrs["source"] = "0.1.0+other"
    before = path.read_bytes()
    follow_masses(tmp_path)
    assert path.read_bytes() == before


def test_a_closed_curve_that_is_resumed_ends_where_it_began(tmp_path):
    """A closed curve of doubled periods that had used up its points ends at its first point, as a whole one does."""
    with (files("vipetsc.examples") / "period-doubling.toml").open("rb") as file:
        table = tomllib.load(file)
    curves = []
    for points in (100, 200):
        table["nfrc"] |= {"points": points, "harmonics": 11}
        case = NfrcCase.from_table(table)
        _, crossing, *_ = follow_all(case, tmp_path, MPI.COMM_SELF, resume=True)
        curves.append(crossing)

    used_up, closed = curves
    assert used_up.ended.ending is Ending.POINTS_USED
    assert "increase nfrc.points" in used_up.ended.sentence and "--resume" in used_up.ended.sentence
    assert closed.ended.ending is Ending.CLOSED
    assert closed.points[-1].xi.tolist() == closed.points[0].xi.tolist()


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


def duffing_pair(mass: float, stiffness: float, cubic: float, method: str) -> Branch[Any]:
    """The lower mode of two equal masses on three equal springs, one of which hardens; 15 points."""
    own = {
        "masses": [mass, mass],
        "springs": [{"start": a, "end": b, "stiffness": stiffness} for a, b in ((0, 1), (1, 2), (0, 2))],
        "smooth": [{"start": 0, "end": 1, "cubic": cubic}],
    }
    nnm = {"system": "own", "own": own, "modes": [1], "points": 15, "method": method, "energy": [0.0, 1e40]}
    (branch,) = follow_all(NnmCase.from_table({"nnm": nnm}), None, MPI.COMM_SELF)
    return branch


@pytest.mark.parametrize("method", ["shooting", "balance"])
@pytest.mark.parametrize(("mass", "stiffness", "cubic"), [(1e-12, 1e-3, 1e9), (1e6, 1e9, 1e-4)])
def test_a_branch_is_the_same_in_any_units(method, mass, stiffness, cubic):
    """With energies over k^2/c and frequencies over (k/m)^1/2 a branch is that of numbers of order one."""
    ones = duffing_pair(1.0, 1.0, 1.0, method)
    branch = duffing_pair(mass, stiffness, cubic, method)
    energies = [p.energy * cubic / stiffness**2 for p in branch.points]
    frequencies = [p.frequency * np.sqrt(mass / stiffness) for p in branch.points]
    assert energies == pytest.approx([p.energy for p in ones.points], rel=1e-7)
    assert frequencies == pytest.approx([p.frequency for p in ones.points], rel=1e-9)
    # The first motion is almost linear: the spring's largest force is 1e-4 of the linear one.
    assert ones.points[0].frequency == pytest.approx(np.sqrt(1.0) / (2 * np.pi), rel=1e-4)


THREE: dict[str, Any] = {
    "masses": [1.0, 1.0, 1.0],
    "springs": [{"start": a, "end": b, "stiffness": 1.0} for a, b in ((0, 1), (1, 2), (2, 3), (0, 3))],
}


@pytest.mark.parametrize(
    "own",
    [
        pytest.param({"contacts": [{"host": 0, "resonator": 2, "clearance": 0.1}]}, id="contact"),
        pytest.param({"smooth": [{"start": 0, "end": 2, "cubic": 1.0}]}, id="spring"),
        pytest.param({"smooth": [{"start": 0, "end": 2, "quadratic": 1.0, "cubic": 1.0}]}, id="quadratic"),
    ],
)
def test_a_mode_with_a_node_where_it_could_touch_begins_no_condensed_branch(own):
    """The second mode of three masses has a node in the middle; its branch is refused, not that of another mode."""
    table = {
        "contacts": {"law": "bilinear", "stiffness": 10.0},
        "nnm": {"system": "own", "own": THREE | own, "modes": [2], "points": 3, "method": "balance"},
    }
    if "contacts" not in own:
        del table["contacts"]
    (branch,) = follow_all(NnmCase.from_table(table), None, MPI.COMM_SELF)
    assert not branch.points
    assert "node" in branch.ended.sentence
    # Shooting follows the linear motion.
    table["nnm"]["method"] = "shooting"
    (branch,) = follow_all(NnmCase.from_table(table), None, MPI.COMM_SELF)
    assert branch.points[0].frequency == pytest.approx(np.sqrt(2) / (2 * np.pi), rel=1e-9)
