"""The engine of exact linear steps; the package's docstring has the method."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from vipetsc.case import Model
from vipetsc.contact.tracker import Episode
from vipetsc.dynamics.engine import Engine, StalledError
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.cluster import group_dofs
from vipetsc.dynamics.propagator.forces import Forces
from vipetsc.dynamics.propagator.halo import HaloRegions
from vipetsc.dynamics.propagator.series import LARGEST_OMEGA_H, StepSeries
from vipetsc.dynamics.propagator.stencil import apply_propagator, create_stencil
from vipetsc.parallel import StopRequest

# Steps a sample interval may be cut into.
MOST_PARTS = 16
# Sites of one cluster beyond which plain time stepping costs less.
MOST_SITES = 32
# Rough costs that decide the step's length, in us: a step, a cell in it, a sample's contacts per site of a cluster.
STEP_COST, CELL_COST, SITE_COST = 20.0, 0.03, 10.0


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


class Propagator(Engine):
    """Advances a lattice from sample to sample; see ``Engine``."""

    name = "propagator"

    def __init__(self, model: Model, layout: Layout, native: bool = True, stop: StopRequest | None = None) -> None:
        series = step_series(model)
        assert series is not None, "refused"
        self.series = series
        self._layout, self._stop = layout, stop or StopRequest()
        self._interval = model.sample_interval
        self._parts = round(model.sample_interval / series.interval)
        self.steps, self.time = 0, 0.0
        neighbours = [cell for cell in layout.neighbours() if cell is not None]
        d, n = layout.dofs, layout.owned
        # Two states in turn: each step reads one and writes the other.
        self._arrays = [np.zeros(layout.size + d * len(neighbours)) for _ in range(2)]
        self._states = [layout.create_vector(a) for a in self._arrays]
        self._cells = [a[: 2 * d * n].reshape(2 * d, n) for a in self._arrays]
        self._now = 0
        self._halo = HaloRegions(layout)
        self._forces = Forces(model, layout, series, self._halo)
        self._stencil = create_stencil(series, layout, self._halo)
        self._ghosts = [self._halo.add(cell, 1) for cell in neighbours]
        self._halo.bind_columns()
        self._status = np.zeros(2)

    @classmethod
    def refusal(cls, model: Model) -> str | None:
        """A lattice shorter than P's band, or too many sites that feel one another within a step."""
        series = step_series(model)
        if series is None:
            shortest = StepSeries(model.chain, model.sample_interval / MOST_PARTS, model.rtol)
            if model.chain.cells > 2 * shortest.reach:
                return f"drive.frequency = {model.drive.frequency:g} rad/s is too fast for the sample interval"
            return f"{model.chain.cells} cells are fewer than the propagator's band"
        groups = ([dof.cell + 1 for dof in group if dof.site >= 0] for group in group_dofs(model, series.reach))
        _, cells = max((len(cells), sorted(cells)) for cells in groups)
        if len(cells) > MOST_SITES:
            return (
                f"{len(cells)} sites between cells {cells[0]} and {cells[-1]} lie within {series.reach} cells of one"
                f" another (at most {MOST_SITES} may)"
            )
        return None

    @property
    def state(self) -> PETSc.Vec:
        """The state at ``time``, as ``Layout`` orders it."""
        return self._states[self._now]

    def advance(self, target: float) -> bool:
        """Step until the time is exactly ``target`` in s, a multiple of the sample interval; see ``Engine``."""
        failure = None
        last = round(target / self._interval) * self._parts
        while self.steps < last and failure is None:
            try:
                self._step()
            except StalledError as error:
                failure = error
            # Any rank's failure or request counts on all.
            self._status[:] = self._stop.requested, failure is not None
            self._layout.comm.Allreduce(MPI.IN_PLACE, self._status, MPI.MAX)
            if self._status[1]:
                raise failure or StalledError("contacts on another rank")
        return not self._status[0]

    def _step(self) -> None:
        old, new = self._now, 1 - self._now
        apply_propagator(self._stencil, self._cells[old], self._halo.columns, self._cells[new])
        self._forces.act(self.time, self._cells[new])
        self._now = new
        self._refresh(self.steps + 1)

    def _refresh(self, steps: int) -> None:
        """Bring the time, the halo, the ledger's components and the ghosts up to date with a state after ``steps``."""
        whole, rest = divmod(steps, self._parts)
        self.steps, self.time = steps, whole * self._interval + rest * self.series.interval
        layout, array = self._layout, self._arrays[self._now]
        self._halo.fetch(self.state, self._cells[self._now])
        array[2 * layout.dofs * layout.owned : layout.size] = self._forces.ledger
        d, at = layout.dofs, layout.size
        for column in self._ghosts:
            array[at : at + d] = self._halo.columns[:d, column]
            at += d

    def take_episodes(self, unfinished: bool = False) -> list[Episode]:
        """See ``Engine``."""
        return [episode for cluster in self._forces.clusters for episode in cluster.take_episodes(unfinished)]

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
        """All that a resumed run needs to go on with the same bits, this rank's share."""
        state = self._arrays[self._now][: self._layout.size].copy()
        return {"state": state, "steps": np.array(self.steps)} | self._forces.checkpoint()

    def restore(self, checkpoint: dict[str, np.ndarray]) -> None:
        """Go back to a checkpoint."""
        self._arrays[self._now][: self._layout.size] = checkpoint["state"]
        self._forces.restore(checkpoint)
        self._refresh(int(checkpoint["steps"]))

    def destroy(self) -> None:
        """Free the PETSc objects now, on all ranks together, rather than whenever each rank's collector runs."""
        self._halo.destroy()
        for state in self._states:
            state.destroy()
