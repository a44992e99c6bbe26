"""Interface of the engines that advance a lattice in time."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

from petsc4py import PETSc

import numpy as np

from vipetsc.case import Model
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.samples import Samples
from vipetsc.parallel import StopRequest


class StalledError(RuntimeError):
    """The step size fell to the rounding of the time, or the state is not finite."""


class FillResult(NamedTuple):
    """Progress of an engine: ``samples`` taken, whether it was ``stopped`` on request, why it ``stalled`` or None."""

    samples: int
    stopped: bool = False
    stalled: str | None = None


class Engine(ABC):
    """Advances a lattice from sample to sample; a subclass gives its ``name`` in case files.

    ``integrates_damping`` says whether it integrates what dashpots dissipate. Where it does not, that is what the
    energies of a sample leave (``energies``).
    ``state`` (as ``Layout`` orders it, ghosts up to date) and ``time`` in s are those of the last time reached;
    ``lattice`` is the rank's part of the lattice, which compiled code reads.
    """

    name: ClassVar[str]
    integrates_damping: ClassVar[bool]
    lattice: Any
    state: PETSc.Vec
    time: float

    @abstractmethod
    def __init__(self, model: Model, layout: Layout, stop: StopRequest | None = None) -> None:
        """Create an engine for ``model`` at rest at t = 0, on all ranks; it ends early on a request to ``stop``."""

    @abstractmethod
    def set_motion(self, cells: np.ndarray, motion: np.ndarray, energy: float) -> None:
        """Begin in motion, on all ranks: own ``cells`` (cell, 2 dof), displacements in m before velocities in m/s.

        ``motion`` (site, 2) has w and w' of all sites. The work done begins with the ``energy`` in J of that state.
        """

    @abstractmethod
    def fill(self, samples: Samples) -> FillResult:
        """Advance through ``samples`` and take them with ``take_sample``; all ranks come equally far.

        On a request to stop the engine ends at one of the next samples, or where a drive is not smooth before it.
        """

    @abstractmethod
    def take_episodes(self, unfinished: bool = False) -> np.ndarray:
        """Return the episodes closed since the last call that this rank logs, as ``EPISODE``; ``unfinished`` too."""

    @abstractmethod
    def statistics(self) -> dict[str, Any]:
        """Return statistics of the engine's work, summed over ranks; all must call it."""

    @abstractmethod
    def checkpoint(self) -> dict[str, np.ndarray]:
        """Return data that a resumed run needs for the same bits: this rank's cells and sites, and common values."""

    @abstractmethod
    def restore(self, checkpoints: Sequence[Mapping[str, np.ndarray]]) -> None:
        """Go back to a checkpoint, given the parts of all ranks that wrote it, in order; their number may differ.

        A part has the arrays that ``checkpoint`` returned on its rank; all ranks must call it.
        """

    @abstractmethod
    def destroy(self) -> None:
        """Free the PETSc objects now, on all ranks together, rather than whenever each rank's collector runs."""
