"""Hill's method: zeros of the determinant by its turns along a contour, and growth where the determinant is large."""

import tracemalloc

import numpy as np
import pytest
from scipy.linalg import expm

from vipetsc.lattice import Contact, DenseCompliance
from vipetsc.modes.balance.harmonics import ForceSeries, SiteForces
from vipetsc.modes.problem import NoMotionError
from vipetsc.modes.stability import ContourLine, Hill
from vipetsc.modes.stops import Stops


@pytest.mark.parametrize(
    ("half_turns", "count"), [(0.0, 0), (-2.1, 2), (0.1, 0), (-1.5, -1), (2.0, -1), (1.0, -1), (np.nan, -1)]
)
def test_only_a_whole_number_of_turns_counts_zeros(half_turns, count):
    """Each zero beyond the line turns D by half a circle in the negative sense.

    Other turns, which a pole or a value that is not finite causes, are no count: -1.
    """
    logs = np.array([0.0, 1j * np.pi * half_turns])
    assert ContourLine(np.array([0.0, 0.5]), logs, (1.0, 1.0)).zeros_beyond() == count


class EqualOscillators:
    """The compliance of equal masses of 1 kg that nothing joins, with springs and dashpots to the ground."""

    highest = 0.8

    def __init__(self, count: int, decay: float) -> None:
        self.count = count
        self.decay = decay

    def at(self, omegas: np.ndarray) -> np.ndarray:
        gain = 1 / (self.highest**2 + 2j * self.decay * omegas - omegas**2)
        return gain[:, None, None] * np.eye(self.count)


@pytest.mark.parametrize(("stiffness", "growing"), [(2.3, 1), (0.5, 0)])
def test_each_of_several_equal_sites_counts(stiffness, growing):
    """Equal sites, whose zeros coincide, count one by one, though D turns by a whole circle between two positions."""
    for count in (1, 5, 6):
        z = np.zeros((count, 10), complex)
        z[:, 1] = 1.3
        series = SiteForces([Stops.both(Contact("bilinear", stiffness), 1.0)] * count).series(z, 1.0)
        found = Hill(EqualOscillators(count, 0.05), 1.0, 9, odd=False, finite=True, decay=0.05)
        assert found.stability(series).unstable == count * growing


def monodromy(stiffness: np.ndarray, row: np.ndarray, contact: float, amplitude: float) -> np.ndarray:
    """Return the monodromy matrix (state, state) of masses of 1 kg over a period of 2 pi s.

    A spring of ``contact`` N/m acts on ``row`` while |cos t| exceeds 1/``amplitude``.
    """
    n = len(row)

    def flow(spring: float, duration: float) -> np.ndarray:
        rate = np.zeros((2 * n, 2 * n))
        rate[:n, n:] = np.eye(n)
        rate[n:, :n] = -stiffness - spring * np.outer(row, row)
        return expm(rate * duration)

    touching = float(np.arccos(1 / amplitude))
    half = flow(contact, touching) @ flow(0.0, np.pi - 2 * touching) @ flow(contact, touching)
    return half @ half


def slow_motion(
    frequencies: tuple[float, float], contact: float, amplitude: float, order: int
) -> tuple[np.ndarray, Hill, ForceSeries]:
    """Two masses of 1 kg with a stop of ``contact`` N/m on both sides of the first, at 1 rad/s.

    Returns the growth rates (state,) over the frequency by the monodromy matrix, Hill's method for harmonics up to
    ``order``, and the forces of the motion, ``amplitude`` cos t in clearances.
    """
    turned = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    stiffness = turned @ np.diag(np.square(frequencies)) @ turned.T
    row = np.array([1.0, 0.0])
    multipliers = np.linalg.eigvals(monodromy(stiffness, row, contact, amplitude))

    z = np.zeros((1, order + 1), complex)
    z[0, 1] = amplitude
    series = SiteForces([Stops.both(Contact("bilinear", contact), 1.0)]).series(z, 1.0)
    found = Hill(DenseCompliance(np.ones(2), stiffness, row[None]), 1.0, order, odd=True, finite=True)
    return np.log(np.abs(multipliers)) / (2 * np.pi), found, series


@pytest.mark.parametrize(
    ("frequencies", "contact", "amplitude"),
    [
        # A mode lies near an order beyond 48.
        ((0.7, 59.5), 1e3, 1.3),
        ((0.7, 60.3), 1e3, 1.3),
        ((0.7, 63.2), 1e3, 1.3),
        # Both modes are slow; with a closed contact one is above 48 rad/s.
        ((0.7, 12.5), 2.6e3, 1.3),
    ],
)
def test_growth_of_a_slow_motion_is_that_of_the_monodromy_matrix(frequencies, contact, amplitude):
    """The growth is that of the monodromy matrix, as orders up to the highest frequency, also in contact, are kept."""
    growth, found, series = slow_motion(frequencies, contact, amplitude, order=171)
    assert growth.max() > 0.01
    assert found.fastest(series).real == pytest.approx(growth.max(), abs=2e-3)
    assert found.stability(series).unstable == np.count_nonzero(growth > found.least)


@pytest.mark.parametrize(("order", "is_decided"), [(161, False), (171, True)])
def test_a_motion_with_fewer_harmonics_than_perturbations_need_is_undecided(order, is_decided):
    """Orders below the highest frequency in contact decide nothing, where the growth they show may be any."""
    frequencies = (0.7, 142.0)
    contact = 142.0**2 / 3
    # The bound on the highest frequency in contact, by which the orders are judged: the stop acts on 1 kg.
    assert 161 < np.hypot(142, np.sqrt(contact)) < 165
    growth, found, series = slow_motion(frequencies, contact, amplitude=1.3, order=order)
    assert np.count_nonzero(growth > found.least) == 1
    if is_decided:
        assert found.stability(series).unstable == 1
        return
    assert found.stability(series).unstable == -1
    assert found.fastest(series) is None
    assert found.pairs(series) == []
    with pytest.raises(NoMotionError, match="no complex pair"):
        found.near(series, 0.1 + 0.2j)


def test_the_compliances_of_many_exponents_are_not_kept():
    """One determinant serves a whole curve: its memory does not grow with the exponents that were asked for."""
    order = 21
    compliance = DenseCompliance(np.ones(2), np.diag([0.49, 2.2]), np.eye(2))
    z = np.zeros((2, order + 1), complex)
    z[:, 1] = [1.3, 1.4]
    series = SiteForces([Stops.both(Contact("bilinear", 3.0), 1.0)] * 2).series(z, 1.0)
    one = Hill(compliance, 1.0, order, odd=False, finite=True)

    tracemalloc.start()
    for growth in np.linspace(0.1, 1.0, 40):
        one.determinants(series, growth + 1j * np.linspace(0, 0.5, 50))
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # Those of all 2000 exponents would take 2000 x 43 x 4 numbers of 16 bytes.
    assert kept < 1.5e6
