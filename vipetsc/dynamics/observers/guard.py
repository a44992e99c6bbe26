"""Ends a run whose state is no solution any more, before the sample is recorded."""

from __future__ import annotations

import numpy as np

from vipetsc.dynamics.observers.base import Observer, RunawayError, Sample, Setup

# A ledger that misses by this share of the largest work is no longer a solution but an instability.
RUNAWAY = 0.1


class Guard(Observer):
    """Raises RunawayError for a state that is not finite, or holds energy that nothing has put in."""

    name = "guard"

    def begin(self, setup: Setup) -> None:
        """See ``Observer``."""
        super().begin(setup)
        self._most_work = 0.0

    def observe(self, sample: Sample) -> None:
        """See ``Observer``."""
        energies, largest = sample.energies, self.setup.meter.largest
        if not (np.isfinite(energies.work) and energies.total < largest):
            raise RunawayError("the state is not finite")
        self._most_work = max(self._most_work, abs(energies.work))
        if abs(energies.residual) > RUNAWAY * self._most_work and energies.total > 1e-12 * largest:
            raise RunawayError(
                f"the energy runs away: {energies.total:.4g} J in the lattice, {energies.work:.4g} J of work done"
            )

    def checkpoint(self) -> dict[str, np.ndarray]:
        """See ``Observer``."""
        return {"most_work": np.array(self._most_work)}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """See ``Observer``."""
        self._most_work = float(state["most_work"])


def fastest_place(setup: Setup) -> str:
    """The cell that moves fastest, or is not finite, and the site nearest to it; all ranks must call it."""
    layout = setup.layout
    half = layout.dofs * layout.owned
    y = setup.engine.state.array_r
    finite = np.isfinite(y[:half]) & np.isfinite(y[half : 2 * half])
    speed = np.where(finite, np.abs(y[half : 2 * half]), np.inf).reshape(layout.dofs, layout.owned)
    local = (-1.0, layout.start)
    if layout.owned:
        local = float(speed.max()), layout.start + int(speed.max(axis=0).argmax())
    _, fastest = max(layout.comm.allgather(local))
    sites = setup.model.chain.sites
    nearest = min(range(len(sites)), key=lambda i: abs(sites[i] - fastest), default=None)
    near = "" if nearest is None else f", nearest site {nearest + 1} in cell {sites[nearest] + 1}"
    return f"cell {fastest + 1}{near}"
