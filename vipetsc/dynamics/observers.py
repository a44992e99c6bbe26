"""Observers of a run, which see it block by block of samples without changing it: interface, and those of every run.

``guard`` ends a run whose state is no longer a solution, ``ledger`` records the error of the energy balance,
``progress`` reports the progress, ``recorder`` (a module of its own) stores its samples. A further observer is a
subclass of ``Observer``, passed to ``simulate``.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from vipetsc.case import Case, Model
from vipetsc.dynamics.energies import EnergyMeter
from vipetsc.dynamics.engine import Engine
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.samples import Block
from vipetsc.io.store import RunOutput
from vipetsc.progress import Progress

# A run whose energy balance misses by this fraction of the largest work so far is no longer a solution.
RUNAWAY = 0.1
# Error of the energy balance over the largest work above which a run warns: so many relative tolerances, 1e-8 at the
# default tolerance of 1e-10; never less than the second number, nor more than the third. The built-in run has an error
# of 8e-11 with ``ts`` and of 1e-13 with the propagator. The third number acts at tolerances above 1e-6: a small lattice
# with contacts has errors of 3e-8 to 9e-6 at 1e-6 to 1e-3 with ``ts``, and gives no warning with half of it either.
LEDGER_PER_RTOL = 100.0
LEAST_LEDGER = 1e-8
MOST_LEDGER = 1e-4


class RunawayError(RuntimeError):
    """The state is no longer a solution from the ``sample`` of a block on; the message gives the reason."""

    def __init__(self, reason: str, sample: int) -> None:
        super().__init__(reason)
        self.sample = sample


@dataclass(frozen=True)
class Setup:
    """Parts of a run: the case and its model, the partition of cells, the engine, the energy meter and the output."""

    case: Case
    model: Model
    layout: Layout
    meter: EnergyMeter
    engine: Engine
    output: RunOutput


class Observer:
    """Watches a run.

    Calls come on all ranks in the same order: ``begin``, perhaps ``restore``, then ``observe`` for every block of
    samples; whenever some observer is ``due``, and when the run is stopped on request, ``flush`` of all and then, where
    the output keeps checkpoints, ``checkpoint`` of all; at the end ``finish`` and ``statistics``.

    A subclass has a ``name``, its prefix in checkpoints, and may want blocks of at most ``longest`` samples: with 1 it
    sees the state at every sample. It must not change the state, and what it raises it must raise on all ranks.
    """

    name: ClassVar[str]
    longest: int = sys.maxsize  # read after ``begin``
    saved: ClassVar[tuple[str, ...]] = ()  # numbers among its attributes that a checkpoint keeps

    def begin(self, setup: Setup) -> None:
        """Prepare for a run from t = 0 on."""
        self.setup = setup

    def observe(self, block: Block) -> None:
        """Process the next samples; raises RunawayError to end the run before one of them."""

    @property
    def due(self) -> bool:
        """Whether a checkpoint should be written now."""
        return False

    def flush(self) -> None:
        """Pass the data collected since the last checkpoint to the run's output."""

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Return the data with which a resumed run has the same bits; equal on all ranks, whose number may change."""
        return {key: np.array(getattr(self, key)) for key in self.saved}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from ``state``, the arrays that ``checkpoint`` returned; the engine has been restored before."""
        for key in self.saved:
            setattr(self, key, state[key].item())

    def finish(self, stopped: bool) -> None:
        """End the observation; a run ``stopped`` on request will be resumed from the checkpoint just written."""

    def statistics(self) -> dict[str, Any]:
        """Return numbers for ``summary.json`` and the attributes of ``run.h5``; those of rank 0 count."""
        return {}

    def warnings(self) -> list[str]:
        """Return warnings about a result that needs care; those of rank 0 count."""
        return []


class Guard(Observer):
    """Raises RunawayError, on all ranks, for a state that is not finite, or whose energy balance does not close.

    The balance may miss by the fraction ``RUNAWAY`` of the largest work so far, unless the lattice has hardly any
    energy (``EnergyMeter.negligible``). An energy from ``EnergyMeter.largest`` on counts as not finite.
    """

    name = "guard"
    saved = ("most_work",)
    most_work = 0.0

    def observe(self, block: Block) -> None:
        energies = block.energies
        meter = self.setup.meter
        most_work = np.maximum.accumulate(np.append(self.most_work, np.abs(energies.work)))[1:]
        finite = np.isfinite(energies.work) & (energies.total < meter.largest)
        runs_away = (np.abs(energies.residual) > RUNAWAY * most_work) & (energies.total > meter.negligible)

        # The samples before the first refused one are good.
        refused = np.flatnonzero(~finite | runs_away)
        if refused.size:
            k = int(refused[0])
            reason = "the state is not finite"
            if finite[k]:
                total = energies.total[k]
                work = energies.work[k]
                reason = f"the energy diverges: {total:.4g} J in the lattice, {work:.4g} J of work done"
            raise RunawayError(reason, k)
        self.most_work = float(most_work[-1])


class Ledger(Observer):
    """Keeps the largest residual in J of the energy balance.

    Where the loss of dashpots is what the balance leaves, the residual cannot show errors of the motion. That loss is
    then checked in two ways. It must never fall: by how much it does counts as a residual. And it is compared with
    ``quadrature``, the trapezoidal rule over the dashpots' power at the samples; how far this is from ``coarse``, the
    rule over every other sample, says what the comparison is worth. All are in J.
    """

    name = "ledger"
    saved = (
        "worst",
        "most_work",
        "work",
        "dissipated",
        "dissipated_by_damping",
        "most_damped",
        "quadrature",
        "quadrature_error",
        "coarse",
        "last_power",
        "last_even_power",
    )
    worst = most_work = most_damped = 0.0
    work = dissipated = dissipated_by_damping = float("nan")
    quadrature = quadrature_error = coarse = 0.0
    last_power = last_even_power = float("nan")

    def observe(self, block: Block) -> None:
        energies = block.energies
        self.work = float(energies.work[-1])
        self.dissipated = float(energies.dissipated[-1])
        self.dissipated_by_damping = float(energies.dissipated_by_damping[-1])
        self.worst = max(self.worst, float(np.abs(energies.residual).max()))
        self.most_work = max(self.most_work, float(np.abs(energies.work).max()))
        if energies.damping is not None:
            self._check_damping(energies.dissipated_by_damping, energies.damping, block.first)

    def _check_damping(self, lost: np.ndarray, powers: np.ndarray, first: int) -> None:
        """Compare what dashpots have ``lost`` in J with the sums of their ``powers`` (sample,) in J per sample."""
        most_lost = np.maximum.accumulate(np.append(self.most_damped, lost))
        self.worst = max(self.worst, float((most_lost[1:] - lost).max()))
        self.most_damped = float(most_lost[-1])

        # A run's first sample has none before it: what the sums below add for it is taken off beforehand.
        if first == 0:
            self.last_power = float(powers[0])
            self.last_even_power = self.last_power
            self.quadrature = -self.last_power
            self.coarse = -2 * self.last_power
        before = np.append(self.last_power, powers[:-1])
        # From the sum so far on, one term after the other: the number of ranks, on which the length of a block depends,
        # changes no bit.
        quadrature = np.cumsum(np.append(self.quadrature, (before + powers) / 2))[1:]
        self.quadrature = float(quadrature[-1])
        self.last_power = float(powers[-1])

        even = slice(first % 2, None, 2)
        if powers[even].size:
            before = np.append(self.last_even_power, powers[even][:-1])
            coarse = np.cumsum(np.append(self.coarse, before + powers[even]))[1:]
            self.quadrature_error = max(self.quadrature_error, float(np.abs(quadrature[even] - coarse).max()))
            self.coarse = float(coarse[-1])
            self.last_even_power = float(powers[even][-1])

    def statistics(self) -> dict[str, Any]:
        """Return ``ledger_error``, largest residual over the largest work, if any; ``work``, ``dissipated`` at the end.

        Where the loss of dashpots is what the balance leaves, ``damping_quadrature`` in J is that of the trapezoidal
        rule, and ``damping_quadrature_error`` its estimated error.
        """
        numbers = {"ledger_error": 0.0}
        if self.most_work:
            # Where hardly any work is done, as by a force that holds a mass to its stop, both are rounding.
            numbers["ledger_error"] = self.worst / max(self.most_work, self.setup.meter.negligible)
        if np.isnan(self.work):
            return numbers

        numbers |= {"work": self.work, "dissipated": self.dissipated}
        if self.setup.model.chain.is_damped:
            numbers["dissipated_by_damping"] = self.dissipated_by_damping
        if not np.isnan(self.last_power):
            numbers |= {"damping_quadrature": self.quadrature, "damping_quadrature_error": self.quadrature_error}
        return numbers

    def warnings(self) -> list[str]:
        """Return a sentence where the balance has a larger error than a trajectory of the tolerance asked explains."""
        error = self.statistics()["ledger_error"]
        rtol = self.setup.model.rtol
        bound = min(max(LEDGER_PER_RTOL * rtol, LEAST_LEDGER), MOST_LEDGER)
        if error <= bound:
            return []
        missing = f"the error of the energy balance is {error:.2g} of the work, above {bound:.2g}"
        return [f"{missing}: the trajectory is no more accurate than that; reduce time.rtol = {rtol:g}"]


class ProgressReport(Observer):
    """Reports the lattice's time on stderr of rank 0."""

    name = "progress"

    def begin(self, setup: Setup) -> None:
        super().begin(setup)
        self._progress = Progress(setup.layout.comm, setup.model.end, "s")

    def observe(self, block: Block) -> None:
        self._progress.update(float(block.times[-1]))

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        self._progress.start_at(self.setup.engine.time)

    def finish(self, stopped: bool) -> None:
        self._progress.close()
