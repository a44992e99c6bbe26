"""What every engine offers to a simulation."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from petsc4py import PETSc

import numpy as np

from vipetsc.case import Model
from vipetsc.contact.tracker import Episode
from vipetsc.dynamics.layout import Layout
from vipetsc.parallel import StopRequest


class StalledError(RuntimeError):
    """The step size fell to the rounding of the time, or the state is not finite."""


class Engine(ABC):
    """Advances a lattice exactly onto given times; a subclass gives its ``name`` in case files.

    ``state`` (as ``Layout`` orders it, ghosts up to date) and ``time`` in s are those of the last time reached.
    """

    name: ClassVar[str]
    state: PETSc.Vec
    time: float

    @abstractmethod
    def __init__(self, model: Model, layout: Layout, native: bool = True, stop: StopRequest | None = None) -> None:
        """An engine for ``model`` at rest at t = 0, on all ranks; ``native``: no Python in the right-hand side."""

    @classmethod
    def refusal(cls, model: Model) -> str | None:
        """Why this engine is not the one for ``model``, in words; None if it is."""
        return None

    @abstractmethod
    def advance(self, target: float) -> bool:
        """Go on until the time is exactly ``target`` in s, the next sample; False if a stop was requested.

        Raises StalledError, on all ranks, where no step can be taken.
        """

    @abstractmethod
    def take_episodes(self, unfinished: bool = False) -> list[Episode]:
        """Episodes closed since the last call that this rank logs; and copies of ``unfinished`` ones, as they are."""

    @abstractmethod
    def statistics(self) -> dict[str, Any]:
        """What the engine did, summed over ranks; all must call it."""

    @abstractmethod
    def checkpoint(self) -> dict[str, np.ndarray]:
        """All that a resumed run needs to go on with the same bits: this rank's cells and sites, and what all share."""

    @abstractmethod
    def restore(self, shares: Sequence[Mapping[str, np.ndarray]]) -> None:
        """Go back to a checkpoint, given the shares of all ranks that wrote it, in their order, however many."""

    @abstractmethod
    def destroy(self) -> None:
        """Free the PETSc objects now, on all ranks together, rather than whenever each rank's collector runs."""
