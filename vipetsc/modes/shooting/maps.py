"""Arcs of a periodic orbit that are integrated: from a section to a section, over a fraction of the period."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ShootingMap:
    """Sections at which an arc starts and ends, and the fraction of the period that it takes.

    ``rest`` is v = 0, ``centre`` is u = 0. An odd system's symmetric orbit goes from rest to the centre in a
    quarter period; any reversible one from rest to rest in a half.
    """

    name: str
    start: str
    end: str
    fraction: float

    @property
    def starts_at_rest(self) -> bool:
        """Whether an arc starts with v = 0, else with u = 0: its initial values are displacements, else velocities."""
        return self.start == "rest"

    @property
    def ends_at_rest(self) -> bool:
        """Whether an arc ends with v = 0, else with u = 0."""
        return self.end == "rest"

    @property
    def quarter(self) -> bool:
        """Whether an arc goes from one section to the other; the orbit is then odd about the arc's end."""
        return self.start != self.end

    def end_unit(self, period: float) -> float:
        """Unit of what vanishes at the end over that of the initial values, for an orbit of that ``period`` in s.

        From rest to rest, velocities over displacements, it is the frequency in rad/s, rounded to a power of two, by
        which numbers are multiplied without rounding.
        """
        if self.quarter:
            return 1.0
        frequency = float(2.0 ** np.round(np.log2(2 * np.pi / period)))
        if not self.starts_at_rest:
            return 1 / frequency
        return frequency


# The whole period is for comparison, by the case key ``nnm.map``. The derivative of its equations has a condition
# number 4 to 55 times that of the quarter (median), 4e5 times at most, on the paper's branches up to 100 J.
MAPS = {
    "quarter": ShootingMap("quarter", "rest", "centre", 0.25),
    "half": ShootingMap("half", "rest", "rest", 0.5),
    "whole": ShootingMap("whole", "rest", "rest", 1.0),
    "half-centre": ShootingMap("half-centre", "centre", "centre", 0.5),
}
