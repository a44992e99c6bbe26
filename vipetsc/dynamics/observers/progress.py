"""How far a run is, on stderr of rank 0."""

from __future__ import annotations

import numpy as np

from vipetsc.dynamics.observers.base import Observer, Sample, Setup
from vipetsc.parallel import Progress


class ProgressReport(Observer):
    """A bar on a terminal, a line every few seconds otherwise, in seconds of the lattice's time."""

    name = "progress"

    def begin(self, setup: Setup) -> None:
        """See ``Observer``."""
        super().begin(setup)
        self._progress = Progress(setup.layout.comm, setup.model.end, "s")

    def observe(self, sample: Sample) -> None:
        """See ``Observer``."""
        self._progress.update(sample.time)

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """See ``Observer``."""
        self._progress.start_at(self.setup.engine.time)

    def finish(self, stopped: bool) -> None:
        """See ``Observer``."""
        self._progress.close()
