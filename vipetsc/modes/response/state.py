"""A steady state on a curve, with the measures that its file holds."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from vipetsc.modes.problem import Solution


class Measures(NamedTuple):
    """Measures of a steady state; ``spectra.responses`` has the units and texts of the file.

    ``frequency`` Om is in rad/s, ``amplitude`` in the unit of the drive. ``largest`` (site,) is the largest relative
    displacement in m, ``harmonics`` (site, order) are its harmonics, complex, in m, and ``closed`` (site,) is the
    fraction of the period in contact, in ``episodes`` contact episodes altogether. ``truncation`` is the estimated size
    of what the harmonics leave out, over the motion.

    ``fractions`` (4,) of the energy that comes in are transmitted, reflected, at higher harmonics, and lost. There are
    ``unstable`` perturbations that grow (-1: undecided), the fastest as exp(lambda t) with lambda = (``growth`` +
    i ``sideband``) Om. ``outputs`` are what ``[output]`` of the case asks for, by the names in the file (``outputs``).
    """

    frequency: float
    amplitude: float
    largest: np.ndarray
    fractions: np.ndarray
    unstable: int
    growth: float
    sideband: float
    closed: np.ndarray
    episodes: int
    truncation: float
    harmonics: np.ndarray
    outputs: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False, kw_only=True)
class Response(Solution):
    """A steady state: unknowns ``xi`` (n + 1,), the last of which is the parameter, and the unit ``tangent`` (n + 1,).

    ``measures`` are None until the state is accepted.
    """

    xi: np.ndarray
    tangent: np.ndarray = field(default_factory=lambda: np.empty(0))
    index: int = 0
    step: float = 0.0
    next_step: float = np.nan
    kind: str = "regular"
    measures: Measures | None = None

    @property
    def measured(self) -> Measures:
        """The measures, which every state has before it is written to a file."""
        assert self.measures is not None
        return self.measures


def returned(first: Response, before: Response, point: Response) -> bool:
    """Return whether a curve comes back to its ``first`` state in the step from the state ``before`` to ``point``.

    There t . (xi - xi_first), with the tangent t at the first state, turns positive, and the state is not farther from
    the first one than a step.
    """
    beyond = first.tangent @ (before.xi - first.xi)
    now = first.tangent @ (point.xi - first.xi)
    return bool(beyond < 0 <= now and np.linalg.norm(point.xi - first.xi) <= point.step)
