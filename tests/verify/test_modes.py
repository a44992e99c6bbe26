"""Nonlinear normal modes against theory: grazing energies, limits, folds, stability, benchmark."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from vipetsc.case.nnm import Guards, NnmTable
from vipetsc.lattice import Chain, Contact, contact_stiffness, four_band
from vipetsc.modes.branches.branch_checks import BranchMonitor, is_jump, suspects
from vipetsc.modes.continuation import segment as segments
from vipetsc.modes.continuation.arclength import Continuation
from vipetsc.modes.continuation.segment import Segment
from vipetsc.modes.continuation.special import locate
from vipetsc.modes.continuation.switching import switch
from vipetsc.modes.point import Point
from vipetsc.modes.problem import ContinuationError
from vipetsc.modes.shooting import shooting as shooting_problem
from vipetsc.modes.shooting.dop853 import Dop853Flow
from vipetsc.modes.shooting.maps import MAPS
from vipetsc.modes.shooting.orbit import resonance
from vipetsc.modes.shooting.reference import FiniteDifferences, Newmark, Tsrk
from vipetsc.modes.shooting.shooting import Shooting
from vipetsc.modes.shooting.start import linear_start
from vipetsc.modes.system import SmoothSpring, System

D = 10**-2.75
IN_PHASE, OUT_OF_PHASE = 0, 1
GRAZING = {OUT_OF_PHASE: 0.0293434562302, IN_PHASE: 0.0035442314356}


def reduced(law="bilinear", modulus: float = 1e8) -> System:
    return System.reduced(four_band(), D, Contact(law, contact_stiffness(modulus, 0.005, 0.3)))


def cubic() -> System:
    springs = [(None, 0, 1.0), (0, 1, 1.0), (None, 1, 1.0)]
    return System.assemble([1.0, 1.0], springs, smooth=[SmoothSpring.between(None, 0, cubic=0.5)])


def follow(system: System, mode: int, start: float, flow=Dop853Flow, shooting: str = "quarter", **control):
    """Problem, points and special points of a branch."""
    problem = Shooting(flow(system), MAPS[shooting])
    first = linear_start(problem, mode, start)
    branch = Continuation(problem, first, NnmTable(**{"points": 20000} | control))
    points, special = [branch.point], []
    for point in branch:
        special += locate(problem, points[-1], point, control.get("chart", "relative"), grazing=True)
        points.append(point)
    return problem, points, special


def at_energy(problem: Shooting, points: list[Point], energy: float) -> Point:
    """The point of an increasing stretch of a branch at an energy, corrected there."""
    i = max(k for k, p in enumerate(points[:-1]) if p.energy <= energy < points[k + 1].energy)
    last = points[i]
    for _ in range(8):  # Newton in the energy along the branch
        share = (energy - last.energy) / last.energy_tangent
        frame = problem.frame(last, "relative")
        guess = frame.xi + share * frame.direction(last)
        attempt = frame.solve(guess, frame.tangent, frame.tangent @ guess)
        assert attempt.converged, attempt.history
        last = frame.measures(attempt, np.linalg.svd(frame.jacobian(attempt.xi))[2][-1])
    assert last.energy == pytest.approx(energy, rel=1e-12)
    return last


@pytest.fixture(scope="module")
def bilinear():
    return follow(reduced(), OUT_OF_PHASE, 3e-4, energy=[1e-4, 1e9], chart="auto")


@pytest.fixture(scope="module")
def hertz():
    return follow(reduced("hertz"), OUT_OF_PHASE, 3e-4, energy=[1e-4, 1e9], chart="auto")


@pytest.fixture(scope="module")
def in_phase():
    """Problem and points of the in-phase branch from the linear mode behind the 7:1 tongue, without special points."""
    problem = Shooting(Dop853Flow(reduced()), MAPS["quarter"])
    growing = Continuation(problem, linear_start(problem, IN_PHASE, 1e-3), NnmTable(energy=[0.0, 25.0], points=20000))
    points = [growing.point, *growing]
    assert growing.finished
    return problem, points


def of_kind(special: list[Point], kind: str) -> list[Point]:
    return [p for p in special if p.kind == kind]


def test_linear_modes_and_limits():
    system = reduced()
    assert system.linear_modes()[0] / (2 * np.pi) == pytest.approx([135.1209897, 474.2501016], rel=1e-9)
    assert system.closed_frequencies() / (2 * np.pi) == pytest.approx([318.1562921, 10252.6169369], rel=1e-9)


@pytest.mark.parametrize("branch", ["bilinear", "hertz"])
def test_out_of_phase_branch(branch, request):
    _, points, special = request.getfixturevalue(branch)
    assert len(points) <= 400
    assert points[-1].energy >= 1e9
    assert max(p.residual for p in points) <= 1e-12
    (graze,) = of_kind(special, "grazing")
    assert graze.energy == pytest.approx(GRAZING[OUT_OF_PHASE], rel=1e-10)
    assert all(p.multiplier == pytest.approx(1, abs=1e-9) for p in points if p.energy > 0.1)


def test_bilinear_folds_and_stability(bilinear):
    _, points, special = bilinear
    folds = of_kind(special, "fold-energy")
    assert len(folds) == 2
    for fold in folds:
        assert fold.half_traces[0] == pytest.approx(1, abs=1e-6)
    first, second = (fold.index for fold in folds)
    for p in points:
        if first < p.index < second:
            assert p.multiplier > 1.01
        elif not first <= p.index <= second:
            assert p.multiplier == pytest.approx(1, abs=1e-6)
    # the folds do not depend on how the branch is stepped
    _, _, again = follow(reduced(), OUT_OF_PHASE, 1e-2, energy=[1e-4, 0.1], largest_step=0.05, chart="relative")
    for fold, other in zip(folds, of_kind(again, "fold-energy"), strict=True):
        assert other.energy == pytest.approx(fold.energy, rel=1e-9)
        assert other.frequency == pytest.approx(fold.frequency, rel=1e-8)


def test_bilinear_approaches_its_limit(bilinear):
    """f_limit - f falls as E^(-1/2), the clearance over the amplitude."""
    problem, points, _ = bilinear
    limit = problem.system.closed_frequencies()[1] / (2 * np.pi)
    distance = [limit - at_energy(problem, points, e).frequency for e in (1e6, 1e8)]
    assert distance[0] / distance[1] == pytest.approx(10, rel=2e-3)


def test_hertz_folds_only_at_200_mpa(hertz):
    _, points, special = hertz
    assert not of_kind(special, "fold-energy")
    assert max(p.multiplier for p in points) == pytest.approx(1, abs=1e-6)
    _, stiffer, special = follow(reduced("hertz", 2e8), OUT_OF_PHASE, 1e-2, energy=[1e-4, 0.1])
    assert len(of_kind(special, "fold-energy")) == 2
    assert max(p.multiplier for p in stiffer) > 1.01


def test_bilinear_orbit_is_the_exact_piecewise_solution(bilinear):
    """The quarter period from modal superposition: closed, then open, with one separation between."""
    problem, points, _ = bilinear
    system = problem.system
    point = at_energy(problem, points, 1.0)
    arc = problem.arc(point.x, point.period)
    (event,) = arc.events
    row = np.array([-1.0, 1.0])
    sign = np.sign(row @ point.x)
    kc = system.contacts[0].law.stiffness
    stiff = system.stiffness + kc * np.outer(row, row)
    rest = np.linalg.solve(stiff, kc * D * sign * row)
    root = np.sqrt(system.masses)

    def propagate(k, centre, u, v, t):
        squared, modes = np.linalg.eigh(k / np.outer(root, root))
        omega = np.sqrt(squared)
        q, p = modes.T @ (root * (u - centre)), modes.T @ (root * v)
        later = modes @ (np.cos(omega * t) * q + np.sin(omega * t) / omega * p)
        rate = modes @ (-omega * np.sin(omega * t) * q + np.cos(omega * t) * p)
        return later / root + centre, rate / root

    u, v = propagate(stiff, rest, point.x, np.zeros(2), event[0])
    assert sign * (row @ u) == pytest.approx(D, rel=1e-12)
    u, _ = propagate(system.stiffness, np.zeros(2), u, v, point.period / 4 - event[0])
    assert np.abs(u).max() <= 1e-12 * np.abs(point.x).max()


@pytest.mark.parametrize("law", ["bilinear", "hertz"])
@pytest.mark.parametrize("flow", [Tsrk, Newmark])
def test_other_flows_agree(flow, law, bilinear, hertz):
    """TSRK is as exact as the compiled flow; Newmark has its own error, at the same amplitude."""
    problem, points, _ = bilinear if law == "bilinear" else hertz
    system = problem.system
    other = Shooting(flow(system), MAPS["quarter"], tolerance=1e-12)
    for energy in (0.1, 10.0, 1e4, 1e8):
        point = at_energy(problem, points, energy)
        frame = other.relative_frame(point.x, point.period)
        row = np.array([0.0, 1.0, 0.0])  # the same w
        attempt = frame.solve(frame.xi + 1e-6 * (1 - row), row, row @ frame.xi)  # begin beside the orbit
        assert attempt.converged, attempt.history
        found = frame.measures(attempt)
        accuracy = (1e-11, 1e-11) if flow is Tsrk else (1e-4, 1e-4)
        assert found.energy == pytest.approx(point.energy, rel=accuracy[0])
        assert found.frequency == pytest.approx(point.frequency, rel=accuracy[1])
        assert found.episodes == point.episodes


@pytest.mark.parametrize("law", ["bilinear", "hertz"])
def test_sensitivities(law):
    """Variational equations against central differences, and symplectic, on an arc with many contacts."""
    system = reduced(law)
    start = np.array([3 * D, 1.2 * D, 0.1, -0.2])
    flow = Dop853Flow(system)
    arc = flow.arc(start, 3e-3, 3e-3)
    assert len(arc.events) >= 8
    differences = FiniteDifferences(flow, 1e-7).arc(start, 3e-3, 3e-3).sensitivity
    assert arc.sensitivity == pytest.approx(differences, rel=1e-4, abs=1e-4 * np.abs(arc.sensitivity).max())
    m, zero = np.diag(system.masses), np.zeros((2, 2))
    form = np.block([[zero, m], [-m, zero]])
    size = np.abs(arc.sensitivity.T) @ np.abs(form) @ np.abs(arc.sensitivity)
    assert np.all(np.abs(arc.sensitivity.T @ form @ arc.sensitivity - form) <= 1e-7 * size.max())


def test_flow_conserves_energy_and_reverses():
    system = reduced()
    start = np.array([30 * D, 10 * D, 0.0, 0.0])
    flow = Dop853Flow(system)
    arc = flow.arc(start, 7e-3, 7e-3)
    assert len(arc.events) > 50
    u, v = arc.end[:2], arc.end[2:]
    assert system.energy(u, v) == pytest.approx(system.energy(start[:2], start[2:]), rel=1e-12)
    back = flow.arc(np.append(u, -v), 7e-3, 7e-3)
    assert np.abs(back.end[:2] - start[:2]).max() <= 1e-11 * np.abs(start).max()


def test_short_contacts_inside_a_step_are_found():
    """A pair of changes 1e-6 of the period apart, and a near miss that must not count."""
    system = reduced()
    omega, shapes = system.linear_modes()
    shape = shapes[:, OUT_OF_PHASE] * D / abs(shapes[1, OUT_OF_PHASE] - shapes[0, OUT_OF_PHASE])
    period = 2 * np.pi / omega[OUT_OF_PHASE]
    for excess, changes in ((1e-12, 2), (-1e-12, 0)):
        centre = np.append(np.zeros(2), omega[OUT_OF_PHASE] * (1 + excess) * shape)
        arc = Dop853Flow(system).arc(centre, period / 2, period)
        assert len(arc.events) == changes


@pytest.mark.slow
def test_in_phase_through_the_first_tongues(in_phase):
    """The grazing cascade and the 5:1 and 7:1 resonances, without a jump; grazing at its own energy."""
    problem, points = in_phase
    points = list(itertools.takewhile(lambda p: p.frequency < 333, points))
    special = (p for a, b in itertools.pairwise(points) for p in locate(problem, a, b, grazing=True))
    graze = next(p for p in special if p.kind == "grazing")
    assert graze.energy == pytest.approx(GRAZING[IN_PHASE], rel=1e-10)
    assert max(p.residual for p in points) <= 1e-11
    assert max(abs(a.episodes - b.episodes) for a, b in itertools.pairwise(points)) == 1
    assert not list(suspects(problem, points))
    monitor = BranchMonitor(problem, Guards())
    assert not [s for s in map(monitor.check, points) if s]


def test_in_phase_through_every_odd_tongue_towards_the_limit(in_phase):
    """At the tip of the k:1 tongue the resonator strikes (k + 1)/2 times in a quarter period, for every odd k."""
    problem, points = in_phase
    assert points[-1].energy > 25
    assert max(p.residual for p in points) <= 3e-12
    assert max(abs(a.episodes - b.episodes) for a, b in itertools.pairwise(points)) == 1
    assert not list(suspects(problem, points))
    limit = problem.system.closed_frequencies()[0] / (2 * np.pi)
    labels, last, distance = set(), points[0], []
    for point in points[1:]:
        if last.energy_tangent < 0 < point.energy_tangent and point.episodes > 0:  # the inner end of a tongue
            k = resonance(problem, point)
            if point.episodes == (k + 1) // 2:
                labels.add(k)
            if k == 1 and point.energy > 0.02:
                distance.append((limit - point.frequency) * np.sqrt(point.energy))
        last = point
    assert labels - {1} == {3, 5, 7}
    assert len(distance) == 3 and 10 < min(distance) < max(distance) < 14  # f_limit - f ~ E^(-1/2)


def test_degenerate_tangent_is_named():
    """Two equal oscillators without coupling: every combination is an orbit, so the start is a branch point."""
    system = System.assemble([1.0, 1.0], [(None, 0, 1.0), (None, 1, 1.0)])
    problem = Shooting(Dop853Flow(system), MAPS["half"])
    x = np.array([1.0, 0.5])
    frame = problem.relative_frame(x, 2 * np.pi)
    attempt = frame.solve(frame.xi, np.array([1.0, 0.0, 0.0]), frame.xi[0])
    with pytest.raises(ContinuationError, match=r"degenerate tangent at E = 0.625 J"):
        Continuation(problem, frame.measures(attempt), NnmTable())


def test_both_directions_give_the_same_curve():
    """Down from above grazing returns through both folds to the linear mode, which the monitor reports."""
    system = reduced()
    problem, points, _ = follow(system, OUT_OF_PHASE, 1e-2, energy=[1e-4, 0.5])
    down = Continuation(problem, points[-1], NnmTable(points=2000, energy=[1e-3, 1.0]), step=1e-3)
    down.point = dataclasses.replace(points[-1], tangent=-points[-1].tangent)
    monitor, back, said = BranchMonitor(problem, Guards()), [], None
    for point in down:
        back.append(point)
        said = monitor.check(point)
        if said:
            break
    assert "returned to linear mode 2" in said
    energies = np.array([p.energy for p in back])
    assert np.sum(np.diff(np.sign(np.diff(energies))) != 0) == 2
    assert back[-1].energy == pytest.approx(GRAZING[OUT_OF_PHASE], rel=0.02)


def test_without_guards_the_branch_jumps_and_the_detector_says_so():
    problem = Shooting(Dop853Flow(reduced()), MAPS["quarter"])
    start = linear_start(problem, IN_PHASE, 3e-3)
    control = NnmTable(points=150, guards=Guards(half_trace=0, contacts=0, corrector=0, turn=0, turn_relative=0))
    points = [start, *Continuation(problem, start, control)]
    assert max(p.residual for p in points) <= 1e-12  # no residual tells
    found = [(i, why) for i, why in suspects(problem, points) if is_jump(problem, points[i], points[i + 1], control)]
    assert found
    guarded = [start, *Continuation(problem, start, NnmTable(points=150))]
    assert not list(suspects(problem, guarded))
    assert not is_jump(problem, guarded[60], guarded[62], control)  # it is followed again with the guards on


@pytest.mark.slow
def test_cubic_benchmark():
    """Kerschen and Peeters (2009): linear frequencies, both modes to E = 1e6, the 3:1 and the 5:1 tongue."""
    system = cubic()
    assert system.linear_modes()[0] == pytest.approx([1.0, np.sqrt(3)], rel=1e-14)
    problem, points, special = follow(system, IN_PHASE, 1e-3, energy=[0.0, 1e6])
    assert points[0].frequency == pytest.approx(1 / (2 * np.pi), rel=1e-3)
    assert points[-1].energy > 1e6
    assert max(p.residual for p in points) <= 1e-12
    tips = {resonance(problem, p) for p in of_kind(special, "fold-energy")}
    assert {3, 5} <= tips
    _, points, _ = follow(system, OUT_OF_PHASE, 1e-3, energy=[0.0, 1e6])
    assert points[-1].energy > 1e6
    # mass 1 on its hardening spring alone: f ~ E^(1/4)
    high = [p for p in points if p.energy > 1e4]
    exponent = np.polyfit(np.log([p.energy for p in high]), np.log([p.frequency for p in high]), 1)[0]
    assert exponent == pytest.approx(0.25, abs=0.01)


@pytest.mark.parametrize("shooting", ["half", "whole"])
def test_maps_agree(shooting, bilinear):
    """The half and the whole period find the quarter's orbits, with the same multipliers."""
    problem, points, _ = bilinear
    point = next(p for p in points if p.energy > 1.0)
    unstable = max(points, key=lambda p: p.multiplier)
    for p in (point, unstable):
        # The residual is 3e4 times the error of the unknowns or more; of an unstable orbit's, rounding leaves 7e-9.
        other = Shooting(problem.flow, MAPS[shooting], tolerance=1e-7)
        frame = other.relative_frame(p.x, p.period)
        row = np.append(p.x / np.linalg.norm(p.x), 0.0)
        attempt = frame.solve(frame.xi + 1e-7, row, row @ frame.xi)
        assert attempt.converged, attempt.history
        found = frame.measures(attempt)
        assert found.frequency == pytest.approx(p.frequency, rel=1e-9)
        assert found.multiplier == pytest.approx(p.multiplier, rel=1e-3)


@pytest.mark.parametrize("kind", ["symmetry-breaking", "period-doubling"])
def test_branch_switching(kind):
    """The crossing branch starts at the special point and its orbits have lost the old symmetry."""
    problem, _, special = follow(cubic(), IN_PHASE, 1e-3, energy=[0.0, 4500.0], frequency=[0.0, 0.2229])
    point = of_kind(special, kind)[0]
    fresh, first = switch(problem, point, amplitude=1e-3)
    assert first.energy == pytest.approx(point.energy, rel=1e-3)
    times = 2 if kind == "period-doubling" else 1
    assert first.period == pytest.approx(times * point.period, rel=1e-3)
    crossing = list(Continuation(fresh, first, NnmTable(points=10)))
    far = crossing[-1]
    assert far.residual <= 1e-11
    arc = fresh.arc(far.x, far.period)
    quarter = fresh.flow.arc(arc.start, far.period / 4, far.period).end
    n = fresh.system.dofs
    old = quarter[:n] if fresh.map.start == "rest" else quarter[n:]
    assert np.abs(old).max() > 1e-4 * np.abs(quarter).max()  # not the quarter-symmetric orbit


@pytest.mark.parametrize("law", ["bilinear", "hertz"])
@pytest.mark.parametrize("mode", [0, 1])
def test_three_cells_through_grazing(law, mode):
    chain = Chain(four_band(), 3, "fixed", (0, 1, 2), (10**-2.65, 10**-2.7, 10**-2.75))
    system = System.from_chain(chain, Contact(law, contact_stiffness(1e8, 0.005, 0.3)))
    graze = system.grazing_energy(mode)
    _, points, special = follow(system, mode, graze / 2, energy=[0.0, 1.05 * graze], points=400)
    assert points[-1].energy > 1.05 * graze
    assert of_kind(special, "grazing")[0].energy == pytest.approx(graze, rel=1e-10)
    assert max(p.residual for p in points) <= 1e-12


def test_failure_says_where_why_and_what_to_turn():
    problem = Shooting(Dop853Flow(reduced()), MAPS["quarter"], max_newton=1)
    start = linear_start(problem, OUT_OF_PHASE, 2.9e-2)
    points = []
    with pytest.raises(ContinuationError) as caught:
        for point in Continuation(problem, start, NnmTable(smallest_step=1e-6, first_step=1e-2)):
            points.append(point)
    text = str(caught.value)
    assert points
    assert f"E = {points[-1].energy:.9g} J" in text
    assert "residuals of the last attempt" in text
    assert "turn nnm." in text


def test_contacts_change_at_grazing_points(in_phase, monkeypatch):
    """Beside a grazing point the contacts are those of either end of its step; bisection finds the same points."""
    problem, points = in_phase
    steps = [(a, b) for a, b in itertools.pairwise(points) if a.episodes != b.episodes][:12]

    def located() -> list[Point]:
        return [p for a, b in steps for p in locate(problem, a, b, grazing=True) if p.kind == "grazing"]

    with monkeypatch.context() as patch:
        patch.setattr(segments, "brentq", lambda *_, **__: 1 / 0)  # nothing is bisected
        touching = located()
    assert len(touching) == len(steps)
    for (a, b), point in zip(steps, touching, strict=True):
        segment = Segment(problem, "relative", a, b)
        beside = [segment.at(point.step + shift * segment.length).episodes for shift in (-1e-4, 1e-4)]
        assert beside == [a.episodes, b.episodes]
        assert point.episodes == min(beside)
    monkeypatch.setattr(shooting_problem, "graze", lambda *_: (_ for _ in ()).throw(ArithmeticError("no luck")))
    steps = steps[:3]
    for point, same in zip(touching, located(), strict=False):
        assert point.energy == pytest.approx(same.energy, rel=1e-9)
