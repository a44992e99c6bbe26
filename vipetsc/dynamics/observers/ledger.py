"""The energy ledger of a run: what the drive put in, what contacts dissipated, what is missing."""

from __future__ import annotations

from typing import Any

import numpy as np

from vipetsc.dynamics.observers.base import Observer, Sample, Setup


class Ledger(Observer):
    """Keeps the largest residual of the energy balance, work - dissipated - (kinetic + spring + contact)."""

    name = "ledger"

    def begin(self, setup: Setup) -> None:
        """See ``Observer``."""
        super().begin(setup)
        self._worst = self._most_work = 0.0
        self._work = self._dissipated = float("nan")

    def observe(self, sample: Sample) -> None:
        """See ``Observer``."""
        energies = sample.energies
        self._worst = max(self._worst, abs(energies.residual))
        self._most_work = max(self._most_work, abs(energies.work))
        self._work, self._dissipated = energies.work, energies.dissipated

    def checkpoint(self) -> dict[str, np.ndarray]:
        """See ``Observer``."""
        return {"sums": np.array([self._worst, self._most_work, self._work, self._dissipated])}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """See ``Observer``."""
        self._worst, self._most_work, self._work, self._dissipated = state["sums"].tolist()

    def statistics(self) -> dict[str, Any]:
        """``ledger_error``: largest residual over the largest work; ``work`` and ``dissipated`` in J at the end."""
        error = self._worst / self._most_work if self._most_work else 0.0
        if np.isnan(self._work):
            return {"ledger_error": error}
        return {"ledger_error": error, "work": self._work, "dissipated": self._dissipated}
