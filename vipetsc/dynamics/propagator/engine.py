"""The engine of exact linear steps; the package's docstring has the method."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np

from vipetsc.case import Model
from vipetsc.compiled import njit
from vipetsc.contact.tracker import Episode
from vipetsc.dynamics.engine import Engine, StalledError
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.advance import CHANGED, DONE, FAILED, advance_cluster
from vipetsc.dynamics.propagator.collocation import Cluster
from vipetsc.dynamics.propagator.forces import Forces, group_dofs, select_cluster
from vipetsc.dynamics.propagator.series import DofTables, StepSeries, apply_impulses, expand_free_motion
from vipetsc.dynamics.propagator.stencil import HaloRegions, Stencil, apply_propagator, create_stencil
from vipetsc.parallel import StopRequest

# Terms grow as (omega H)^k / k! before they fall: beyond this omega H rounding would show.
LARGEST_OMEGA_H = 3.2
# Steps a sample interval may be cut into.
MOST_PARTS = 16
# Sites of one cluster beyond which plain time stepping costs less.
MOST_SITES = 32
# Changes of one cluster in one step beyond which it counts as stalled.
MOST_CHANGES = 5_000
# Rough costs that decide the step's length, in us: a step, a cell in it, a sample's contacts per site of a cluster.
STEP_COST, CELL_COST, SITE_COST = 20.0, 0.03, 10.0
# What steps hand over; CHANGED and FAILED are those of ``advance_cluster``.
ARRIVED, STEPPED = 3, 4


@lru_cache(maxsize=4)
def step_series(model: Model) -> StepSeries | None:
    """The step that divides the sample interval and fits the lattice at the least cost; None if there is none.

    Long steps are few, but sites that feel one another within a step must be followed together.
    """
    tolerance = max(1e-4 * model.rtol, 1e-15)
    fastest = model.drive.frequency * (1 + 1 / model.drive.cycles)
    best, least = None, np.inf
    for parts in range(1, MOST_PARTS + 1):
        cost = parts * (STEP_COST + CELL_COST * model.chain.cells)
        if cost >= least:
            break
        series = StepSeries(model.chain, model.sample_interval / parts, tolerance)
        too_long = max(series.omega_max_h, fastest * series.interval) > LARGEST_OMEGA_H
        if too_long or model.chain.cells <= 2 * series.reach:
            continue
        sizes = np.array([len(group) for group in group_dofs(model, series.reach)])
        cost += SITE_COST * float((sizes**2).sum() / sizes.sum())
        if cost < least:
            best, least = series, cost
    return best


class States(NamedTuple):
    """Two states that steps read and write in turn; a sample interval in s has ``parts`` steps.

    ``components`` (2, component) are ordered as ``Layout`` says; ``owned`` counts the cells, ``ghosts`` the
    neighbouring ones, the last columns of ``HaloRegions``.
    """

    components: np.ndarray
    owned: int
    ghosts: int
    parts: int
    sample_interval: float


@njit(error_model="numpy")
def take_steps(
    states: States, steps: int, stencil: Stencil, columns: np.ndarray, dofs: DofTables, clusters: Cluster
) -> Iterator[tuple[int, int, float]]:
    """Go on after so many linear ``steps``; hand over to Python where needed: why, for which cluster, the time in s.

    ``ARRIVED``: the state is complete. ``STEPPED``: a step is done, the columns are to be exchanged.
    ``CHANGED``: sites of a cluster are to be switched. ``FAILED``: the contacts of a cluster cannot be followed.
    """
    rows, owned = columns.shape[0], states.owned
    while True:
        state, out = states.components[steps % 2], states.components[1 - steps % 2]
        cells, next_cells = state[: rows * owned].reshape(rows, owned), out[: rows * owned].reshape(rows, owned)
        begin = steps // states.parts * states.sample_interval + steps % states.parts * clusters.interval
        ghosts = columns[: rows // 2, columns.shape[1] - states.ghosts :]
        state[rows * owned :] = np.concatenate((clusters.energy[dofs.ledger], ghosts.T.flatten()))
        yield ARRIVED, -1, begin
        apply_propagator(stencil, cells, columns, next_cells)
        for c in range(clusters.state.size):
            may_touch = expand_free_motion(dofs, c, columns, clusters.taylor)
            is_driven = dofs.first[c + 1] - 1 == dofs.driven and begin < clusters.burst.duration
            if not (may_touch or is_driven):
                continue
            cluster = select_cluster(clusters, dofs, c)
            substep_state = cluster.state[0]
            substep_state.begin, substep_state.position = begin, 0.0
            substep_state.drive_end = (clusters.burst.duration - begin) / clusters.interval
            cluster.moments[:] = 0.0
            for change in range(MOST_CHANGES):
                outcome = advance_cluster(cluster)
                if outcome == DONE:
                    break
                now = begin + cluster.state[0].position * clusters.interval
                yield (outcome if change < MOST_CHANGES - 1 else FAILED), c, now
            apply_impulses(dofs, dofs.first[c], cluster.moments, next_cells)
        steps += 1
        yield STEPPED, -1, begin


class Propagator(Engine):
    """Advances a lattice from sample to sample; see ``Engine``."""

    name = "propagator"

    def __init__(self, model: Model, layout: Layout, native: bool = True, stop: StopRequest | None = None) -> None:
        series = step_series(model)
        assert series is not None, "refused"
        self.series = series
        self._layout, self._stop = layout, stop or StopRequest()
        self._halo = HaloRegions(layout)
        self._forces = Forces(model, layout, series, self._halo)
        self._stencil = create_stencil(series, layout, self._halo)
        ghosts = [self._halo.add(cell, 1) for cell in layout.neighbours() if cell is not None]
        self._halo.bind_columns()
        self._components = np.zeros((2, layout.size + layout.dofs * len(ghosts)))
        self._states = [layout.create_vector(components) for components in self._components]
        parts = round(model.sample_interval / series.interval)
        self._record = States(self._components, layout.owned, len(ghosts), parts, model.sample_interval)
        self._status = np.zeros(2)
        self._start(0)

    def _start(self, steps: int) -> None:
        """Go on from the state after so many ``steps``."""
        self.steps, forces = steps, self._forces
        self._events = take_steps(self._record, steps, self._stencil, self._halo.columns, forces.dofs, forces.clusters)
        self._arrive()

    def _arrive(self) -> None:
        """Exchange cells, and complete the state with the ghosts and the ledger."""
        self.state = self._states[self.steps % 2]
        self._halo.exchange(self.state)
        _, _, self.time = next(self._events)

    @classmethod
    def refusal(cls, model: Model) -> str | None:
        """A lattice shorter than P's band, or too many sites that feel one another within a step."""
        series = step_series(model)
        if series is None:
            shortest = StepSeries(model.chain, model.sample_interval / MOST_PARTS, model.rtol)
            if model.chain.cells > 2 * shortest.reach:
                return f"drive.frequency = {model.drive.frequency:g} rad/s is too fast for the sample interval"
            return f"{model.chain.cells} cells are fewer than the propagator's band"
        groups = ([model.chain.sites[i] + 1 for i in group if i >= 0] for group in group_dofs(model, series.reach))
        _, cells = max((len(cells), sorted(cells)) for cells in groups)
        if len(cells) > MOST_SITES:
            return (
                f"{len(cells)} sites between cells {cells[0]} and {cells[-1]} lie within {series.reach} cells of one"
                f" another (at most {MOST_SITES} may)"
            )
        return None

    def advance(self, target: float) -> bool:
        """Step until the time is exactly ``target`` in s, a multiple of the sample interval; see ``Engine``."""
        last = round(target / self._record.sample_interval) * self._record.parts
        while self.steps < last:
            for event, cluster, now in self._events:
                if event != CHANGED:
                    break
                sys.audit("vipetsc.landing")
                self._forces.switch(cluster, now)
            # Any rank's failure or request counts on all.
            self._status[:] = self._stop.requested, event == FAILED
            self._layout.comm.Allreduce(MPI.IN_PLACE, self._status, MPI.MAX)
            if event == FAILED:
                sites = ", ".join(str(site + 1) for site in self._forces.trackers[cluster].numbers)
                raise StalledError(f"the contacts of sites {sites} at {now:.9g} s")
            if self._status[1]:
                raise StalledError("contacts on another rank")
            self.steps += 1
            self._arrive()
        return not self._status[0]

    def take_episodes(self, unfinished: bool = False) -> list[Episode]:
        """See ``Engine``."""
        return self._forces.take_episodes(unfinished)

    def statistics(self) -> dict[str, Any]:
        """Linear steps and what the clusters did, the step and its band."""
        return {"steps": self.steps} | self._forces.statistics() | {
            "method": f"P({self.series.interval:.6g} s)",
            "right_hand_side": "none",
            "interval": self.series.interval,
            "bandwidth": self.series.reach,
            "terms": self.series.terms,
            "nonzeros": int(np.count_nonzero(self._stencil.values)),
            "truncation": self.series.truncation,
        }  # fmt: skip

    def checkpoint(self) -> dict[str, np.ndarray]:
        """See ``Engine``."""
        state = self._layout.checkpoint(self._components[self.steps % 2])
        return state | {"steps": np.array(self.steps)} | self._forces.checkpoint()

    def restore(self, shares: Sequence[Mapping[str, np.ndarray]]) -> None:
        """See ``Engine``."""
        steps = int(shares[0]["steps"])
        self._layout.restore(shares, self._components[steps % 2])
        self._forces.restore(shares)
        self._start(steps)

    def destroy(self) -> None:
        """Free the PETSc objects now, on all ranks together, rather than whenever each rank's collector runs."""
        self._halo.destroy()
        for state in self._states:
            state.destroy()
