"""The log of impacts: episodes of contact, and how often a limit of the contact law acted."""

from dataclasses import dataclass

import numpy as np


@dataclass
class Episode:
    """One contact of one site: 0-based site, side (+1, -1), times in s, velocity in m/s, depth in m, N, J.

    ``separation`` is NaN while the contact lasts.
    """

    site: int
    side: int
    onset: float
    approach_velocity: float
    separation: float = np.nan
    indentation: float = 0.0
    force: float = 0.0
    loss: float = 0.0


@dataclass
class ImpactCounts:
    """How often a limit of the contact law acted."""

    grazes: int = 0
    floored: int = 0
    clipped: int = 0
    pulled: int = 0
