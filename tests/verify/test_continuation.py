"""Continuation of branches: guards against jumps, special points, switching, failures, a published benchmark."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.models import IN_PHASE, OUT_OF_PHASE, kerschen_system, reduced_model
from tests.verify.conftest import follow
from vipetsc.case import NnmCase
from vipetsc.case.nnm import NnmTable
from vipetsc.modes.branches.orbits import ShootingMethod
from vipetsc.modes.continuation.arclength import Continuation, Segment, locate
from vipetsc.modes.continuation.switching import switch
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.problem import ContinuationError
from vipetsc.modes.shooting import Shooting, linear_start, resonance
from vipetsc.modes.system import System


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


def test_a_failure_states_where_it_stopped_why_and_what_to_change():
    problem = Shooting(Dop853Flow(reduced_model()), MAPS["quarter"], max_newton=1)
    start = linear_start(problem, OUT_OF_PHASE, 2.9e-2)

    points = []
    with pytest.raises(ContinuationError) as caught:
        for point in Continuation(problem, start, NnmTable(smallest_step=1e-6, first_step=1e-2)):
            points.append(point)

    text = str(caught.value)
    assert points
    assert f"E = {points[-1].energy:.9g} J" in text
    assert "residuals of the last attempt" in text
    assert "change nnm." in text


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
