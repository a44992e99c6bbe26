"""Profiles of the misfit follow a valley; motions on either side of the valley lack a contact."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vipetsc.identification.least_squares import Minimum
from vipetsc.identification.misfit_profile import MisfitProfile, profile_costs

# The lattice has its second contact within this distance of the valley b = a + BEND a^2.
WIDTH = 1.0
BEND = 0.3
JUMP = 50.0


class BentValley:
    """A fit of two coordinates (a, b) with the cost a^2 + (b - a - BEND a^2)^2, plus JUMP if one contact is missing."""

    def __init__(self) -> None:
        self.misfit = SimpleNamespace(records=[None], cost=self.cost)
        self.last = [1.0]
        self.low = np.full(2, -9.0)
        self.high = np.full(2, 9.0)
        self.solutions = 0

    def distance(self, z: np.ndarray) -> float:
        return float(z[1] - z[0] - BEND * z[0] ** 2)

    def onsets(self, z: np.ndarray, number: int, end: float) -> np.ndarray:
        return np.zeros(2 if abs(self.distance(z)) < WIDTH else 1)

    def minimum(self, z: np.ndarray, ends: Any, active: list[int], precision: Any, slopes: np.ndarray) -> Minimum:
        """Return the point of the valley at the same a, or ``z`` beyond the jump, where no derivative leads back."""
        assert active == [1]
        self.solutions += 1
        if abs(self.distance(z)) >= WIDTH:
            return Minimum(z, slopes)
        return Minimum(np.array([z[0], z[1] - self.distance(z)]), slopes)

    def cost(self, z: np.ndarray, ends: Any) -> float:
        missing = len(self.onsets(z, 0, 1.0)) < 2
        return float(z[0] ** 2 + self.distance(z) ** 2 + JUMP * missing)


@pytest.mark.parametrize("side, places", [("below", [-1.5, -3.0]), ("above", [0.0, 1.5, 3.0])])
def test_a_profile_keeps_the_contacts_of_the_fit(side, places):
    """A profile along the bent valley has the costs a^2, without the jump, and few solutions are needed."""
    windows = BentValley()
    profile = MisfitProfile(np.linspace(-3, 3, 5)[None], np.ones((1, 2)), np.zeros((0, 2)))
    costs = profile_costs(windows, np.zeros(2), profile, 0, side)
    assert costs == pytest.approx(np.square(places), abs=1e-12)
    # The lines of the covariance and through two fits leave the valley, hence some steps are halved.
    assert windows.solutions <= 5
