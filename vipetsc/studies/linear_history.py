"""Histories of linear runs, from which the members of a sweep begin that differ in amplitude and contacts alone.

Whether members begin so depends on the sweep's case, not on which members are missing nor on the number of ranks: a
member has the same bits in every call of the sweep, after an interruption, and where it is repeated alone. In a sweep
with fewer than ``FEWEST_MEMBERS`` of its linear run it begins by itself, and its run differs by rounding.
"""

from functools import cached_property
from typing import Any, NamedTuple, Self

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case import Case, Sweep
from vipetsc.dynamics import simulate
from vipetsc.dynamics.engine_choice import PROPAGATOR
from vipetsc.dynamics.opening import Opening
from vipetsc.io.atomic import Arrays
from vipetsc.io.store import RunMemory
from vipetsc.parallel import StopRequest, on_root
from vipetsc.studies.linear_run import (
    MARGIN,
    LinearRun,
    envelope_squares,
    first_site_cell,
    is_proportional,
    linear_case,
    other_pairs,
    reached,
    signed_factor,
)
from vipetsc.studies.opening_entropies import Computed, OpeningEntropies
from vipetsc.studies.recorded_runs import completed

# Members, at least, that differ in amplitude and contacts alone, for a history of their linear run: it costs a run, and
# saves a part of each member's.
FEWEST_MEMBERS = 3
# Samples from one state at which members may begin to the next. On average a member computes half as many samples
# twice, under 1 % of the built-in run; a state takes as much memory as one sample.
STATES_EVERY = 64
MOST_BYTES = 2**28  # of the histories that are kept, a quarter of a GB: six of the built-in lattice's, 42 MB each
# Keys of contacts and of the amplitude, in which members of one linear run differ; those drawn for contacts.
CONTACTS = "contacts."
AMPLITUDE = "drive.amplitude"
SEED = "disorder.seed"
DRAWN_OF_CONTACTS = {"seed", "clearance", "sites", "restitution", "stiffness", "modulus"}


class LinearHistory(NamedTuple):
    """A linear run with all samples of its motion: the dataset ``run``, empty on all ranks but the first.

    ``checkpoints`` are the parts of all ranks; ``envelope`` (checkpoint, cell) in m is that of ``LinearRun``, of the
    samples before each checkpoint. ``statistics`` are the run's, ``entropies`` those that members have asked for.
    """

    run: xr.Dataset
    checkpoints: list[list[Arrays]]
    envelope: np.ndarray
    statistics: dict[str, Any]
    entropies: Computed

    @classmethod
    def of(cls, case: Case, comm: MPI.Comm, stop: StopRequest) -> Self:
        """Simulate the linear run of ``case`` on all ranks of ``comm``; raises StoppedError, or RuntimeError."""
        memory = RunMemory(comm, states_every=STATES_EVERY)
        result = completed(simulate(linear_case(case), memory, comm, stop=stop))

        def take_envelope() -> np.ndarray:
            assert memory.dataset is not None
            stops = [int(parts[0]["samples"]) for parts in memory.states]
            return np.sqrt(np.maximum.accumulate(envelope_squares(memory.dataset, stops), axis=0))

        envelope = on_root(comm, take_envelope)
        run = xr.Dataset() if memory.dataset is None else memory.dataset
        return cls(run, memory.states, envelope, result.statistics, entropies={})

    def with_velocity_alone(self) -> Self:
        """The history without displacements, which takes half of the memory."""
        run = self.run.drop_vars("displacement", errors="ignore")
        # A copy: both fields lie in one array.
        return self._replace(run=run.copy(deep=True))

    def opening(self, case: Case) -> Opening | None:
        """The samples before the first contact with which ``case`` begins; None without any, or without exact steps."""
        if self.statistics["engine"] != PROPAGATOR:
            return None
        waves = reached(self.envelope, case)
        # The envelope is that of all samples before a checkpoint, so that the condition, once violated, stays so.
        before_contact = np.count_nonzero((waves < MARGIN).all(axis=1))
        if not before_contact:
            return None
        return Opening(self.run, self.checkpoints[before_contact - 1], signed_factor(case))

    def opening_entropies(self, samples: int, factor: float) -> OpeningEntropies:
        """The entropies of the first ``samples`` of a run that is this one times a ``factor``; on the first rank."""
        return OpeningEntropies(self.run["velocity"].values, self.entropies, samples, factor)


def begins_linearly(plan: Sweep, case: Case) -> bool:
    """Whether the member ``case`` of ``plan`` begins from a linear run, which enough members have in common."""
    if other_pairs(case):
        return False
    members = 1
    for axis in plan.axes:
        if all(_keeps_linear_run(key, plan, case) for key in axis):
            members *= len(next(iter(axis.values())))
    return members >= FEWEST_MEMBERS and history_bytes(case) <= MOST_BYTES


class MemberHistory:
    """The linear run of the member ``case`` of ``plan``, which is repeated outside of its sweep.

    It is simulated on all ranks of ``comm`` when it is first asked for; all ranks must call every method.
    """

    def __init__(self, plan: Sweep, case: Case, comm: MPI.Comm, stop: StopRequest) -> None:
        self._plan = plan
        self._case = case
        self._comm = comm
        self._stop = stop

    def opening(self) -> Opening | None:
        """The samples with which the member begins as in its sweep; None if it begins without any."""
        if not begins_linearly(self._plan, self._case):
            return None
        return self._history.opening(self._case)

    def arrival(self) -> float | None:
        """The time in s at which the linear wave arrives at the member's first site; None without sites."""

        def arrival_on_root() -> float | None:
            linear = LinearRun.of(self._history.run, self._history.statistics, sites=(), names=())
            return linear.arrival_at(first_site_cell(self._case))

        # All ranks simulate the run together, before the first one, which has its dataset, reads the time from it.
        _ = self._history
        return on_root(self._comm, arrival_on_root)

    @cached_property
    def _history(self) -> LinearHistory:
        return LinearHistory.of(self._case, self._comm, self._stop)


def _keeps_linear_run(key: str, plan: Sweep, case: Case) -> bool:
    """Whether members that differ in ``key`` have one linear run."""
    if key == AMPLITUDE:
        return is_proportional(case)
    if key == SEED:
        return plan.table.get("disorder", {}).keys() <= DRAWN_OF_CONTACTS
    return key.startswith(CONTACTS)


def history_bytes(case: Case, fields: int = 2) -> int:
    """Bytes of the motion in the history of the linear run of ``case``, of which so many ``fields`` are kept."""
    model = case.model()
    return 8 * fields * model.samples * model.chain.cells * model.chain.cell.dofs


class LinearHistories:
    """The histories of a team of ranks by the names of the linear runs: the latest ones, up to ``MOST_BYTES``."""

    def __init__(self) -> None:
        self._histories: dict[str, LinearHistory] = {}
        self._bytes: dict[str, int] = {}

    def get(self, name: str) -> LinearHistory | None:
        """The history of that ``name``, if it is kept."""
        return self._histories.get(name)

    def keep(self, name: str, history: LinearHistory, size: int) -> None:
        """Keep the ``history``, which has ``size`` bytes on the first rank; the oldest ones are dropped to make room.

        The size is the same on all ranks: they drop the same histories, which they simulate together.
        """
        self._histories[name] = history
        self._bytes[name] = size
        while sum(self._bytes.values()) > MOST_BYTES:
            # A dictionary keeps the order of insertion.
            oldest = next(iter(self._histories))
            del self._histories[oldest]
            del self._bytes[oldest]
