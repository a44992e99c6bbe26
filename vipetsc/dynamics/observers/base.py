"""The contract of observers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from petsc4py import PETSc

import numpy as np

from vipetsc.case import Case, Model
from vipetsc.dynamics.engine import Engine
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.meter import Energies, EnergyMeter
from vipetsc.io.store import RunOutput


class RunawayError(RuntimeError):
    """The state is no solution any more; says why."""


@dataclass(frozen=True)
class Setup:
    """What a run is made of: the case, its model in the lattice's own terms, and who does what on which cells."""

    case: Case
    model: Model
    layout: Layout
    meter: EnergyMeter
    engine: Engine
    output: RunOutput


@dataclass(frozen=True)
class Sample:
    """The lattice at one of the uniform times: ``number`` from 0, ``time`` in s.

    ``state`` is ordered as ``Layout`` says, ghosts up to date; it changes with the next sample.
    """

    number: int
    time: float
    state: PETSc.Vec
    energies: Energies


class Observer:
    """Watches a run.

    Calls come on all ranks in the same order: ``begin``, perhaps ``restore``, then ``observe`` for every sample;
    whenever some observer is ``due``, and when the run is stopped on request, ``flush`` of all and then ``checkpoint``
    of all; at the end ``finish`` and ``statistics``.

    A subclass has a ``name``, by which ``simulate`` finds it. It must not change the state, and what it raises it must
    raise on all ranks.
    """

    name: ClassVar[str]
    registry: ClassVar[dict[str, type[Observer]]] = {}

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        Observer.registry[cls.name] = cls

    def begin(self, setup: Setup) -> None:
        """Make ready for a run from t = 0 on."""
        self.setup = setup

    def observe(self, sample: Sample) -> None:
        """Look at the next sample; raises RunawayError to end the run before it."""

    @property
    def due(self) -> bool:
        """Whether a checkpoint should be made now."""
        return False

    def flush(self) -> None:
        """Hand what was kept since the last checkpoint to the run's output."""

    def checkpoint(self) -> dict[str, np.ndarray]:
        """What a resumed run needs to go on with the same bits, this rank's share."""
        return {}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go on from what ``checkpoint`` gave; the engine is there already."""

    def finish(self, stopped: bool) -> None:
        """Come to an end; ``stopped`` on request, to be gone on with from the checkpoint just made."""

    def statistics(self) -> dict[str, Any]:
        """Numbers for ``summary.json`` and the attributes of ``run.h5``; those of rank 0 count."""
        return {}
