"""The engine of exact linear steps: from sample to sample, each cluster's contacts within every step.

A step is the product of the state with P(H) (sec. 1 of the derivation in the package's docstring) and, for the clusters
whose sites may touch or whose drives are on, what their forces leave behind (sec. 2 to 6). ``take_steps`` is the loop
over the steps of a block of samples; ``Propagator`` holds its records and is the engine that a simulation sees.
"""

import sys
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np

from vipetsc.case import Model
from vipetsc.compiled import kernel
from vipetsc.contact.tracker import Tracks
from vipetsc.dynamics.drives import Drives
from vipetsc.dynamics.engine import Engine, FillResult
from vipetsc.dynamics.lattice_record import create_record
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.log import PROPAGATOR
from vipetsc.dynamics.propagator.clusters import SiteClusters, follow_contacts
from vipetsc.dynamics.propagator.dof_tables import DofTables, apply_impulses, expand_free_motion
from vipetsc.dynamics.propagator.stencil import Halo, HaloRegions, Stencil, apply_propagator, create_stencil, exchange
from vipetsc.dynamics.propagator.step_choice import step_series
from vipetsc.dynamics.propagator.substeps import Cluster
from vipetsc.dynamics.samples import Samples, take_sample
from vipetsc.parallel import StopRequest, on_every_rank
from vipetsc.records import Record

PROGRESS = np.dtype([(name, np.int64) for name in ("steps", "last", "failed", "cluster")] + [("time", float)])
"""Steps done and the last one to do. Of a failure: 2 n if the state after n steps is not finite, 2 n + 1 if a cluster
could not be followed through the step after them, ``NEVER`` if there is none; that cluster, else -1; its time in s."""
NEVER = np.iinfo(np.int64).max


class States(NamedTuple):
    """Two states that steps read and write in turn; a sample interval in s has ``parts`` steps.

    ``components`` (2, component) are ordered as ``Layout`` says; ``owned`` counts the cells, ``ghosts`` the
    neighbouring ones, the last columns of ``HaloRegions``, and ``ghost_rows`` what the state has of each.
    ``progress`` (1,) is of dtype ``PROGRESS``.
    """

    components: np.ndarray
    owned: int
    ghosts: int
    ghost_rows: int
    parts: int
    sample_interval: float
    progress: np.ndarray


class Saved(NamedTuple):
    """What a rank can go back to: the ``steps`` done, its ``state`` (component,), a checkpoint of its ``clusters``."""

    steps: int
    state: np.ndarray
    clusters: dict[str, np.ndarray]


@kernel
def _complete(state: np.ndarray, states: States, ledger: np.ndarray, energies: np.ndarray, columns: np.ndarray) -> None:
    """Put the ledger's energies in J, and the ghosts from the halo's ``columns``, behind the cells of the ``state``."""
    k = columns.shape[0] * states.owned
    for dof in ledger:
        state[k] = energies[dof]
        k += 1
    for ghost in range(columns.shape[1] - states.ghosts, columns.shape[1]):
        for row in range(states.ghost_rows):
            state[k] = columns[row, ghost]
            k += 1


@kernel
def _is_driven(dofs: DofTables, c: int, drives: Drives, begin: float) -> bool:
    """Return whether a drive of cluster ``c`` is on in the step from ``begin`` in s on."""
    driven = False
    # Behind its sites and springs a cluster has its driven masses.
    for i in range(dofs.first[c] + dofs.sites[c] + dofs.springs[c], dofs.first[c + 1]):
        driven |= begin < drives.rows[i].duration
    return driven


@kernel
def take_steps(
    states: States,
    stencil: Stencil,
    halo: Halo,
    dofs: DofTables,
    clusters: Cluster,
    each: Any,
    tracks: Tracks,
    samples: Samples,
) -> tuple[int, np.ndarray]:
    """Go on to the last step and take the ``samples`` on the way; returns PETSc's error code and the log of ``tracks``.

    Several ranks agree on failures at the block's end alone: a rank that fails goes on to it without contacts, and a
    rank that has all cells stops at once.
    """
    rows = halo.columns.shape[0]
    owned = states.owned
    progress = states.progress[0]
    sites = tracks.sites
    error = 0
    while error == 0:
        steps = progress.steps
        state = states.components[steps % 2]
        cells = state[: rows * owned].reshape(rows, owned)
        next_cells = states.components[1 - steps % 2, : rows * owned].reshape(rows, owned)
        # Counted from the last sample: times of samples are products, with no rounding of the steps between.
        begin = steps // states.parts * states.sample_interval + steps % states.parts * clusters.interval
        error = exchange(halo, steps % 2, cells)

        # The ledger and the ghosts follow the cells in the state only where it is looked at.
        k = steps // states.parts - samples.number
        is_sample = steps % states.parts == 0 and 0 <= k < samples.work.shape[0]
        if is_sample or steps == progress.last:
            _complete(state, states, dofs.ledger, clusters.energy, halo.columns)
        if is_sample:
            is_finite = take_sample(state, k, samples, clusters.contacts, dofs.acting)
            if not is_finite and progress.failed == NEVER:
                progress.failed = 2 * steps
        failed = progress.failed < NEVER
        if steps == progress.last or (failed and halo.scatter == 0):
            break

        # Free motion of all cells.
        apply_propagator(stencil, cells, halo.columns, next_cells)

        # What forces add. The clusters read the halo, that is the state before the step.
        count = clusters.state.size
        if failed:
            count = 0
        for c in range(count):
            may_touch = expand_free_motion(dofs, c, halo.columns, clusters.taylor)
            if not may_touch and not _is_driven(dofs, c, clusters.drives, begin):
                continue
            cluster = each[c]
            first = dofs.first[c]
            own_tracks = Tracks(sites[first : first + cluster.contacts.size], tracks.log, tracks.closed)
            followed, tracks = follow_contacts(cluster, own_tracks, begin)
            if not followed:
                # The others are followed all the same: ranks that do not feel this one follow theirs, too.
                if progress.failed == NEVER:
                    progress.failed = 2 * steps + 1
                    progress.cluster = c
                    progress.time = begin + cluster.state[0].position * clusters.interval
                continue
            apply_impulses(dofs, first, cluster.moments, next_cells)

        # Among others a rank that failed must keep their pace. One alone stays at the step that failed, for its state
        # to be shown, and takes no sample there again: its clusters have gone through that step, as far as they can.
        if progress.failed < NEVER and halo.scatter == 0:
            break
        progress.steps += 1
    return error, tracks.log


class Propagator(Engine):
    """Advances a lattice from sample to sample; see ``Engine``."""

    name = "propagator"
    integrates_damping = False

    def __init__(self, model: Model, layout: Layout, stop: StopRequest | None = None) -> None:
        series = step_series(model)
        assert series is not None, "refused"
        self.series = series
        self._layout = layout
        self.lattice = create_record(model, layout)
        self._stop = stop or StopRequest()

        # Everything that reads cells of other ranks says which before the halo is bound; the ghosts come last.
        self._regions = HaloRegions(layout)
        self._clusters = on_every_rank(layout.comm, lambda: SiteClusters(model, layout, series, self._regions))
        self._stencil = create_stencil(series, layout, self._regions)
        for cell in layout.ghosts:
            self._regions.add(cell, 1)

        self._components = np.zeros((2, layout.size + layout.ghost_rows * len(layout.ghosts)))
        self._states = [layout.create_vector(components) for components in self._components]
        self._halo = self._regions.bind_columns(self._states)
        self._record = Record(
            States(
                components=self._components,
                owned=layout.owned,
                ghosts=len(layout.ghosts),
                ghost_rows=layout.ghost_rows,
                parts=round(model.sample_interval / series.interval),
                sample_interval=model.sample_interval,
                progress=np.zeros(1, PROGRESS),
            )
        )
        self._saved: Saved | None = None
        self.state = self._states[0]
        self.time = 0.0

    @property
    def steps(self) -> int:
        """Linear steps done."""
        return int(self._record.progress["steps"][0])

    def set_motion(self, cells: np.ndarray, motion: np.ndarray, energy: float) -> None:
        self._layout.place(cells, energy, self._components[0])
        self._clusters.set_motion(motion, energy)

    def fill(self, samples: Samples) -> FillResult:
        """Fill ``samples`` as ``Engine`` says; without room, go to the sample before the first. All ranks must call it.

        A stop on request is at the last sample. Raises RuntimeError where PETSc fails to exchange cells.
        """
        sys.audit("vipetsc.step")
        parts = self._record.parts
        comm = self._layout.comm
        # The log has no episode then: it has just been taken, or nothing has happened yet.
        if comm.size > 1 and self._saved is None:
            state = self._components[self.steps % 2].copy()
            self._saved = Saved(steps=self.steps, state=state, clusters=self._clusters.checkpoint())
        self._go_to((samples.number + len(samples.work) - 1) * parts, samples)

        # The earliest failure of a rank, and any rank's request, count on all.
        status = np.array([self._record.progress["failed"][0], -int(self._stop.requested)])
        comm.Allreduce(MPI.IN_PLACE, status, MPI.MIN)
        failed, stop = status.tolist()
        taken = len(samples.work)
        stalled = None
        if failed < NEVER:
            stalled = self._first_reason()
            # One rank stands at the failure. Several have gone on to the block's end.
            if self._saved is not None:
                self._repeat(self._saved, failed, samples)
            taken = self.steps // parts - samples.number + 1
        self.state = self._states[self.steps % 2]
        self.time = self._time_after(self.steps)
        return FillResult(samples=taken, stopped=bool(stop), stalled=stalled)

    def _go_to(self, last: int, samples: Samples) -> None:
        """Go on to the step ``last`` and take the ``samples`` on the way; all ranks must call it."""
        clusters = self._clusters
        progress = self._record.progress[0]
        progress["last"] = last
        progress["failed"] = NEVER
        progress["cluster"] = -1
        tracks = clusters.tracker.tracks
        with PROPAGATOR:
            error, log = take_steps(
                self._record,
                self._stencil,
                self._halo,
                clusters.dofs,
                clusters.record,
                clusters.each,
                tracks,
                Record(samples),
            )
        if error:
            raise RuntimeError(f"PETSc could not exchange cells: error {error}")
        clusters.tracker.tracks = tracks._replace(log=log)

    def _first_reason(self) -> str:
        """Return the reason of the first failure; all ranks must call it."""
        progress = self._record.progress[0]
        cluster = int(progress["cluster"])
        reason = "the state is not finite"
        acting = self._clusters.describe(cluster)
        if acting:
            reason = f"{acting} at {progress['time']:.9g} s"
        # Of several clusters in one step the first of the lattice counts, as on one rank, which follows them in order.
        place = int(progress["failed"]), self._clusters.first_cell(cluster)
        _, reason = min(self._layout.comm.allgather((place, reason)))
        return reason

    def _repeat(self, saved: Saved, failed: int, samples: Samples) -> None:
        """Go back to what was ``saved`` and on to the failure ``failed`` of ``PROGRESS``; all ranks must call it.

        As on one rank, the engine then stands at the beginning of the step that failed, its contacts at the end.
        """
        self._components[saved.steps % 2] = saved.state
        self._record.progress["steps"] = saved.steps
        self._clusters.restore(self._layout.comm.allgather(saved.clusters))
        steps, in_contact = divmod(failed, 2)
        self._go_to(steps, samples)
        if in_contact:
            self._go_to(steps + 1, samples)
            self._record.progress["steps"] = steps

    def _time_after(self, steps: int) -> float:
        """Return time in s after so many ``steps``, summed as in ``take_steps``."""
        record = self._record
        return steps // record.parts * record.sample_interval + steps % record.parts * self.series.interval

    def take_episodes(self, unfinished: bool = False) -> np.ndarray:
        # Steps that are repeated from before would log these episodes once more.
        self._saved = None
        return self._clusters.take_episodes(unfinished)

    def statistics(self) -> dict[str, Any]:
        """Return linear steps and what the clusters did, the step and its band."""
        series = self.series
        band = {
            "method": f"P({series.interval:.6g} s)",
            "interval": series.interval,
            "bandwidth": series.reach,
            "terms": series.terms,
            "nonzeros": int(np.count_nonzero(series.interior())),
            "truncation": series.truncation,
        }
        return {"steps": self.steps} | self._clusters.statistics() | band

    def checkpoint(self) -> dict[str, np.ndarray]:
        state = self._layout.checkpoint(self._components[self.steps % 2])
        return state | {"steps": np.array(self.steps)} | self._clusters.checkpoint()

    def restore(self, checkpoints: Sequence[Mapping[str, np.ndarray]]) -> None:
        self._clusters.restore(checkpoints)
        steps = int(checkpoints[0]["steps"])
        self._saved = None
        self._layout.restore(checkpoints, self._components[steps % 2])
        self._record.progress["steps"] = steps
        self.state = self._states[steps % 2]
        self.time = self._time_after(steps)

    def destroy(self) -> None:
        self._regions.destroy()
        for state in self._states:
            state.destroy()
