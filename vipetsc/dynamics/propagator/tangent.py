"""An orbit of a lattice that nothing drives, with variations that are moved beside it: see ``tangent_kernels``."""

import copy

import numpy as np

from vipetsc.case import Model
from vipetsc.contact.law import CLOSED, PERMANENT
from vipetsc.dynamics.engine import StalledError
from vipetsc.dynamics.lattice_record import create_record
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.clusters import expand_free_motion
from vipetsc.dynamics.propagator.engine import Propagator
from vipetsc.dynamics.propagator.nodes import NODES
from vipetsc.dynamics.propagator.stencil import Halo, exchange
from vipetsc.dynamics.propagator.substeps import create_tape
from vipetsc.dynamics.propagator.tangent_kernels import Variations, linearise, move_variations
from vipetsc.dynamics.samples import Samples
from vipetsc.dynamics.site_dofs import site_records
from vipetsc.parallel import on_every_rank

# Rows of the tape of a cluster.
MOST_ROWS = 8192


class TangentPropagator(Propagator):
    """The engine for a lattice that nothing drives, from a state of one's own, with the motion beside its orbit.

    ``cells`` are arrays (2 dof, owned cell), displacements before velocities. A contact that dissipates must be open
    at the beginning: its w'_minus is not part of the state.
    """

    def __init__(self, model: Model, layout: Layout) -> None:
        super().__init__(model, layout)
        self._model, forces, clusters = model, self._forces, self._forces.clusters
        tape = create_tape(len(clusters.state), MOST_ROWS, NODES)
        clusters.drives.rows["duration"] = 0.0
        forces.clusters = clusters._replace(tape=tape)
        self._linear: tuple[np.ndarray, np.ndarray] | None = None
        self._moved: tuple[Variations, Halo, list] | None = None

    @classmethod
    def refusal(cls, model: Model) -> str | None:
        """As of the engine; contacts that touch or are pressed at rest, too."""
        sites = site_records(model, np.arange(len(model.chain.sites)))
        if (np.abs(sites["mode"]) == PERMANENT).any():
            return "contacts touch or are pressed at rest, beside which no variations are moved"
        return super().refusal(model)

    def place(self, cells: np.ndarray, speed: float) -> None:
        """Begin at ``cells``; ``speed`` in m/s is that of relative motion, for the accuracy of closed contacts.

        Raises StalledError, on all ranks, for a closed contact that dissipates.
        """
        here, clusters, dofs = self._components[0], self._forces.clusters, self._forces.dofs
        here[: cells.size] = cells.ravel()
        exchange(self._halo, 0, here[: cells.size].reshape(cells.shape))
        for c in range(len(clusters.state)):
            expand_free_motion(dofs, c, self._halo.columns, clusters.taylor)
        w, sites, history = clusters.taylor[:, 0], clusters.contacts, clusters.history
        closed = np.where(w < 0, -w - sites["clearance_minus"], w - sites["clearance"]) > 0
        if self._layout.comm.allreduce(bool((closed & (sites["damping"] != 0)).any())):
            raise StalledError("a contact that dissipates is closed at the beginning")
        sites["mode"] = np.where(closed, np.sign(w) * CLOSED, 0)
        sites["approach"] = np.where(closed, np.sign(w) * speed, 1.0)
        history["onset"], history["duration"] = -np.inf, 1.0

    def run(self, samples: int) -> np.ndarray:
        """Go on to the sample of that number from the start; the cells there. Raises StalledError on all ranks."""
        model, layout, none = self._model, self._layout, np.zeros(0)
        fields = np.zeros((0, 0, 0, 0)), np.zeros(0, np.int64), 0, 1, 1
        sums, losses, record = np.zeros((0, 5, 2), np.int64), none.reshape(0, 0), create_record(model, layout)
        result = self.fill(Samples(samples + 1, sums, losses, losses, *fields, record, 1.0, 1.0))
        needed = layout.comm.allreduce(int(self._forces.clusters.tape.used.max(initial=0)), max)
        if result.stalled or needed > MOST_ROWS:
            raise StalledError(result.stalled or f"an orbit needs {needed} substeps in contact, of {MOST_ROWS}")
        cells = self._components[self.steps % 2][: 2 * layout.dofs * layout.owned]
        return cells.reshape(2 * layout.dofs, layout.owned).copy()

    def contacts(self) -> tuple[np.ndarray, int]:
        """Times (interval, 2) in s in which a site that this rank logs was closed, and the number of its contacts."""
        tape, spans, episodes = self._forces.clusters.tape, [np.zeros((0, 2))], 0
        for c in np.flatnonzero(self._forces.logs):
            rows = tape.rows[c, : tape.used[c]]
            begin = rows["begin"] + rows["position"] * self.series.interval
            spans.append(np.column_stack([begin, begin + rows["length"] * self.series.interval]))
            episodes += int(np.sum((rows["onset"] > 0) | (begin == 0.0)))
        return np.concatenate(spans), episodes

    def _linearised(self) -> tuple[np.ndarray, np.ndarray]:
        """The matrices of the orbit, and where they belong."""
        clusters, dofs, tape = self._forces.clusters, self._forces.dofs, self._forces.clusters.tape
        places, energy = np.full((self.steps, len(clusters.state)), -1), clusters.energy.copy()
        matrices: list[np.ndarray] = []
        largest = int(np.diff(dofs.first).max(initial=0)) * (clusters.taylor.shape[1] + 1)
        for c in range(len(clusters.state)):
            rows, motion = tape.rows[c, : tape.used[c]], tape.motion[c, : tape.used[c]]
            steps, first = np.unique(np.rint(rows["begin"] / self.series.interval), return_index=True)
            for step, a, b in zip(steps.astype(int), first, np.append(first, len(rows))[1:], strict=True):
                places[step, c] = len(matrices)
                matrices.append(np.zeros((largest, largest)))
                linearise(clusters, dofs, c, rows[a:b], motion[a:b], matrices[-1])
        clusters.energy[:] = energy
        return places, np.array(matrices).reshape(len(matrices), largest, largest)

    def move(self, cells: np.ndarray) -> np.ndarray:
        """Where variations (variation, 2 dof, owned cell) of the beginning are at the orbit's end; collective."""
        count, rows, layout = len(cells), 2 * self._layout.dofs, self._layout
        if self._linear is None:
            self._linear = on_every_rank(layout.comm, self._linearised)
        if self._moved is None or len(self._moved[0].components) != count:
            self._release()
            components = np.zeros((count, 2, self._components.shape[1]))
            states, regions = [layout.create_vector(a) for pair in components for a in pair], copy.copy(self._regions)
            taylor = self._forces.clusters.taylor.copy()
            variations = Variations(components, np.zeros((count, len(taylor))), *self._linear, taylor)
            self._moved = variations, regions.bind_columns(states), [regions, *states]
        variations, halo, _ = self._moved
        variations.components[:, 0, : rows * layout.owned] = cells.reshape(count, -1)
        variations.approach[:] = 0.0
        if error := move_variations(variations, self._stencil, halo, self._forces.dofs, layout.owned):
            raise RuntimeError(f"PETSc could not exchange cells: error {error}")
        moved = variations.components[:, len(variations.places) % 2, : rows * layout.owned]
        return moved.reshape(count, rows, layout.owned).copy()

    def _release(self) -> None:
        for petsc_object in self._moved[2] if self._moved else []:
            petsc_object.destroy()
        self._moved = None

    def destroy(self) -> None:
        """Free the variations' objects as well."""
        self._release()
        super().destroy()
