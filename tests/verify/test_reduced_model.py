"""Nonlinear normal modes of the paper's reduced model: grazing energies, folds, stability, limits, tongues."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from tests.models import GRAZING_ENERGY, IN_PHASE, OUT_OF_PHASE, reduced_model
from tests.verify.conftest import follow
from vipetsc.case.nnm import Guards, NnmTable
from vipetsc.endings import Ending
from vipetsc.modes.branches.branch_checks import BranchMonitor
from vipetsc.modes.continuation.arclength import Continuation, locate
from vipetsc.modes.shooting import resonance


def test_linear_modes_and_limits():
    """The linear modes have the frequencies of the paper's two masses, and large motions those with closed contacts.

    The numbers are the roots of the characteristic polynomials of the two stiffness matrices, in Hz.
    """
    system = reduced_model()

    assert system.linear_modes()[0] / (2 * np.pi) == pytest.approx([135.1209897, 474.2501016], rel=1e-9)
    assert system.closed_frequencies() / (2 * np.pi) == pytest.approx([318.1562921, 10252.6169369], rel=1e-9)


@pytest.mark.parametrize("name", ["bilinear", "hertz"])
def test_out_of_phase_branch(name, request):
    """The branch grazes once, at the energy of the linear mode that touches, and is stable above its folds."""
    branch = request.getfixturevalue(name)
    points = branch.points

    # Steps grow with the energy, so that thirteen decades take few points.
    assert len(points) <= 400
    assert points[-1].energy >= 1e9
    assert max(point.residual for point in points) <= 1e-12

    (graze,) = branch.of_kind("grazing")
    assert graze.energy == pytest.approx(GRAZING_ENERGY[OUT_OF_PHASE], rel=1e-10)
    assert all(point.multiplier == pytest.approx(1, abs=1e-9) for point in points if point.energy > 0.1)


def test_bilinear_folds_and_stability(bilinear):
    """The energy folds back twice at grazing, and orbits are unstable between the folds and nowhere else."""
    folds = bilinear.of_kind("fold-energy")

    # A pair of multipliers is at +1 where the energy is stationary: their half-trace is 1.
    assert len(folds) == 2
    for fold in folds:
        assert fold.half_traces[0] == pytest.approx(1, abs=1e-6)

    first, second = (fold.index for fold in folds)
    for point in bilinear.points:
        if first < point.index < second:
            assert point.multiplier > 1.01
        elif not first <= point.index <= second:
            assert point.multiplier == pytest.approx(1, abs=1e-6)


def test_bilinear_approaches_its_limit(bilinear):
    """The distance f_limit - f falls as E^(-1/2), as the clearance over the amplitude does."""
    limit = bilinear.problem.system.closed_frequencies()[1] / (2 * np.pi)

    lower = limit - bilinear.at_energy(1e6).frequency
    upper = limit - bilinear.at_energy(1e8).frequency

    # The next term of the expansion is smaller by D over the amplitude, 3e-3 at 1e6 J.
    assert lower / upper == pytest.approx(10, rel=2e-3)


def test_hertz_folds_only_at_200_mpa(hertz):
    """Hertz contacts of the printed 100 MPa have no fold and no instability; those of 200 MPa have both."""
    assert not hertz.of_kind("fold-energy")
    assert max(point.multiplier for point in hertz.points) == pytest.approx(1, abs=1e-6)

    stiffer = follow(reduced_model("hertz", modulus=2e8), OUT_OF_PHASE, 1e-2, energy=[1e-4, 0.1])
    assert len(stiffer.of_kind("fold-energy")) == 2
    assert max(point.multiplier for point in stiffer.points) > 1.01


def test_in_phase_through_the_first_tongues(in_phase):
    """The branch passes the grazing cascade and two resonances without a jump, and grazes at its own energy."""
    problem = in_phase.problem
    # The frequency first exceeds 333 Hz behind the tongues 7:1 and 5:1; checks of all points would take long.
    points = list(itertools.takewhile(lambda point: point.frequency < 333, in_phase.points))
    steps = list(itertools.pairwise(points))

    special = (point for a, b in steps for point in locate(problem, a, b, grazing=True))
    graze = next(point for point in special if point.kind == "grazing")
    assert graze.energy == pytest.approx(GRAZING_ENERGY[IN_PHASE], rel=1e-10)

    assert max(point.residual for point in points) <= 1e-11
    assert max(abs(a.episodes - b.episodes) for a, b in steps) == 1

    monitor = BranchMonitor(problem, Guards())
    assert not any(monitor.check(point) for point in points)


def test_in_phase_through_every_odd_tongue_towards_the_limit(in_phase):
    """At the tip of the k:1 tongue the resonator strikes (k + 1)/2 times in a quarter period, for every odd k."""
    problem = in_phase.problem
    points = in_phase.points
    assert points[-1].energy > 25
    assert max(point.residual for point in points) <= 3e-12
    assert max(abs(a.episodes - b.episodes) for a, b in itertools.pairwise(points)) == 1

    limit = problem.system.closed_frequencies()[0] / (2 * np.pi)
    tongues = set()
    distances = []
    for last, point in itertools.pairwise(points):
        # The energy turns upwards at the inner end of a tongue.
        if not (last.energy_tangent < 0 < point.energy_tangent and point.episodes > 0):
            continue
        order = resonance(problem, point)
        if point.episodes == (order + 1) // 2:
            tongues.add(order)
        if order == 1 and point.energy > 0.02:
            distances.append((limit - point.frequency) * np.sqrt(point.energy))

    assert tongues - {1} == {3, 5, 7}
    # f_limit - f falls as E^(-1/2): over these three energies the product changes little.
    assert len(distances) == 3
    assert min(distances) > 10
    assert max(distances) < 14


def test_both_directions_give_the_same_curve():
    """A branch followed down from above grazing passes both folds and returns to the linear mode, as is reported."""
    branch = follow(reduced_model(), OUT_OF_PHASE, 1e-2, energy=[1e-4, 0.5])
    top = branch.points[-1]
    down = Continuation(branch.problem, top, NnmTable(points=2000, energy=[1e-3, 1.0]), step=1e-3)
    down.point = dataclasses.replace(top, tangent=-top.tangent)

    monitor = BranchMonitor(branch.problem, Guards())
    energies = []
    report = None
    for point in down:
        energies.append(point.energy)
        report = monitor.check(point)
        if report:
            break

    assert report.ending is Ending.LINEAR_MODE
    turns = np.sum(np.diff(np.sign(np.diff(energies))) != 0)
    assert turns == 2
    assert energies[-1] == pytest.approx(GRAZING_ENERGY[OUT_OF_PHASE], rel=0.02)
