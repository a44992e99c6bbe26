"""An orbit of a lattice that nothing drives, and the motion of variations along it.

``TangentPropagator`` runs the orbit as the engine does, but from a state of one's own, and keeps on a tape the substeps
in which contacts were closed. From them it computes, once for the orbit, one small matrix for each step and cluster in
contact. The matrix maps variations of the series of the free motion of the cluster's DoFs, and of w'_minus of its sites
(the approach velocity at which the present contact began), at the beginning of a step to those of the moments of the
forces, and of w'_minus, at its end (sec. 9 of the derivation in the package's docstring, written out in
``tangent_kernels``). After that any number of variations of the initial state are moved at the cost of linear steps.
That is what shooting for periodic orbits of a whole lattice asks for: products of the monodromy matrix with vectors,
never the matrix.
"""

import copy
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vipetsc.case import Model
from vipetsc.contact.law import CLOSED, PERMANENT
from vipetsc.dynamics.engine import StalledError
from vipetsc.dynamics.lattice_record import create_record
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.clusters import expand_free_motion
from vipetsc.dynamics.propagator.engine import Propagator
from vipetsc.dynamics.propagator.nodes import NODES, at_end
from vipetsc.dynamics.propagator.stencil import Halo, exchange
from vipetsc.dynamics.propagator.step_choice import refusal
from vipetsc.dynamics.propagator.substeps import create_tape
from vipetsc.dynamics.propagator.tangent_kernels import Variations, linearise, move_variations
from vipetsc.dynamics.samples import Samples
from vipetsc.dynamics.site_dofs import site_records
from vipetsc.parallel import on_every_rank

# Rows of the tape of a cluster, 208 B each with the motion at the nodes. A contact takes fewer than 30 of them in the
# built-in case; an orbit that needs more rows is refused with their number.
MOST_ROWS = 8192


class _Linearisation(NamedTuple):
    """``matrices`` (number, row, column) of an orbit; ``places`` (step, cluster) numbers them, -1 without contact."""

    places: np.ndarray
    matrices: np.ndarray


class _Moving(NamedTuple):
    """Workspace of so many variations, the halo for their exchanges, and the objects of PETSc behind it."""

    variations: Variations
    halo: Halo
    petsc_objects: list


class ClosedSubsteps(NamedTuple):
    """Substeps (row,) of an orbit in which contacts were closed, in the order of time at each site.

    ``site`` counts the lattice's sites from 0, ``side`` is 1 or -1; ``onset`` marks those with which a contact begins.
    They end at ``end`` in s. ``first_rate`` and ``last_rate`` are w' in m/s at both ends; ``w`` and ``rate`` (row,
    node) are w in m and w' in m/s at the nodes, whose ``weights`` (row, node) in s integrate over the substep.
    """

    site: np.ndarray
    side: np.ndarray
    onset: np.ndarray
    end: np.ndarray
    first_rate: np.ndarray
    last_rate: np.ndarray
    w: np.ndarray
    rate: np.ndarray
    weights: np.ndarray


def no_samples(model: Model, layout: Layout, number: int) -> Samples:
    """Samples of which none is stored, after which the next is that of the ``number``.

    An engine that fills them advances to the sample before that one.
    """
    return Samples(
        number=number,
        sums=np.zeros((0, 5, 2), np.int64),
        work=np.zeros((0, 0)),
        losses=np.zeros((0, 0)),
        fields=np.zeros((0, 0, 0, 0)),
        moving=np.zeros(0, np.int64),
        first_cell=0,
        every=1,
        stride=1,
        lattice=create_record(model, layout),
        unit=1.0,
        interval=1.0,
        forces=np.zeros((0, 0)),
        motion=np.zeros((0, 0, 0)),
        watched=np.zeros(0, np.int64),
    )


class TangentPropagator(Propagator):
    """The engine for a lattice that nothing drives, from a state of one's own, with the motion of variations of it.

    ``cells`` are arrays (2 dof, owned cell), displacements before velocities. A contact that dissipates must be open
    at the beginning: the approach velocity w'_minus with which it began is not part of the state. An engine is for one
    orbit: ``place``, then ``run``, then ``move`` any number of times. The tape of a cluster has so many ``rows``; an
    engine without any runs the orbit alone.
    """

    def __init__(self, model: Model, layout: Layout, rows: int = MOST_ROWS) -> None:
        super().__init__(model, layout)
        self._model = model
        clusters = self._forces.clusters
        # Clusters with a drive that acts are solved in every step; without one only those whose sites may touch.
        clusters.drives.rows["duration"] = 0.0
        self._forces.clusters = clusters._replace(tape=create_tape(len(clusters.state), rows))
        self._linear: _Linearisation | None = None
        self._moving: _Moving | None = None

    @classmethod
    def refusal(cls, model: Model) -> str | None:
        """Why it does not suit ``model``: what the engine refuses, nonlinear springs, contacts that touch at rest.

        About such a contact no motion is linear, however small; one that is pressed at rest has a slope.
        """
        if not model.chain.is_linear:
            return "springs have a quadratic or cubic part; variations are not supported for them"
        sites = site_records(model, np.arange(len(model.chain.sites)))
        if ((np.abs(sites["mode"]) == PERMANENT) & (sites["preload"] == 0)).any():
            return "contacts touch at rest; variations are not supported for them"
        return refusal(model)

    def place(self, cells: np.ndarray, speed: float) -> None:
        """Begin at ``cells``; ``speed`` in m/s is a typical one of relative motion.

        Errors of substeps in contact are relative to the approach velocity, which a contact that is closed already does
        not have: it gets ``speed``.

        Raises StalledError, on all ranks, for a closed contact that dissipates.
        """
        clusters = self._forces.clusters
        sites = clusters.contacts
        state = self._components[0]
        state[: cells.size] = cells.ravel()

        # The zeroth coefficients of free motion are the relative displacements themselves.
        exchange(self._halo, 0, state[: cells.size].reshape(cells.shape))
        for c in range(len(clusters.state)):
            expand_free_motion(self._forces.dofs, c, self._halo.columns, clusters.taylor)
        w = clusters.taylor[:, 0]
        closed = np.where(w < 0, -w - sites["clearance_minus"], w - sites["clearance"]) > 0
        if self._layout.comm.allreduce(bool((closed & (sites["damping"] != 0)).any())):
            raise StalledError("a contact that dissipates is closed at the beginning")

        # Contacts that are pressed at rest stay as they are, closed or open: substeps end where they open and close.
        is_held = np.abs(sites["mode"]) == PERMANENT
        side = np.where(is_held, np.sign(sites["mode"]), np.sign(w))
        sites["mode"] = np.where(is_held, sites["mode"], np.where(closed, side * CLOSED, 0))
        sites["approach"] = np.where(closed | is_held, side * speed, 1.0)
        # No contact has just begun or ended, where forces are not smooth and the first substeps are short.
        clusters.history["onset"] = -np.inf
        clusters.history["duration"] = 1.0

    def run(self, samples: int, look: Callable[[np.ndarray], None] | None = None) -> np.ndarray:
        """Advance to the sample of that number, counted from the start; returns the cells there.

        ``look`` sees the cells of every sample on the way. Raises StalledError on all ranks, also where the orbit needs
        more substeps in contact than the tape has rows.
        """
        layout = self._layout
        tape = self._forces.clusters.tape
        # Without anything to show the engine goes to the last sample at once.
        numbers = range(samples, samples + 1)
        if look:
            numbers = range(1, samples + 1)
        for number in numbers:
            # Nothing is stored: the engine goes to the sample before the one that would be.
            result = self.fill(no_samples(self._model, layout, number + 1))
            needed = layout.comm.allreduce(int(tape.used.max(initial=0)), max)
            room = tape.rows.shape[1]
            if result.stalled or needed > room:
                raise StalledError(result.stalled or f"an orbit needs {needed} substeps in contact, of {room}")
            cells = self._components[self.steps % 2][: 2 * layout.dofs * layout.owned]
            cells = cells.reshape(2 * layout.dofs, layout.owned).copy()
            if look:
                look(cells)
        return cells

    def contacts(self) -> tuple[np.ndarray, int]:
        """Begin and end (substep, 2) in s of the substeps in which a site was closed, and the number of contacts.

        They are those of the sites that this rank logs; one contact takes several substeps, which follow each other.
        Of contacts that are pressed at rest the number is that of their openings.
        """
        tape = self._forces.clusters.tape
        spans = [np.zeros((0, 2))]
        episodes = 0
        for c in np.flatnonzero(self._forces.logs):
            rows = tape.rows[c, : tape.used[c]]
            begin = rows["begin"] + rows["position"] * self.series.interval
            is_held = np.abs(rows["mode"]) >= PERMANENT
            is_open = self._open_rows(c, rows, is_held)
            intervals = np.column_stack([begin, begin + rows["length"] * self.series.interval])
            spans.append(intervals[~is_open])
            # The first substep after an onset is marked; a contact that is closed from the start has none on the tape.
            episodes += int(np.sum(((rows["onset"] > 0) | (begin == 0.0)) & ~is_held))
            for site in np.unique(rows["site"][is_held]):
                of_site = is_open[rows["site"] == site]
                episodes += int(np.sum(of_site & ~np.append(False, of_site[:-1])))
        return np.concatenate(spans), episodes

    def closed_substeps(self) -> list[ClosedSubsteps]:
        """The substeps in which contacts were closed, of each cluster that this rank logs."""
        clusters = self._forces.clusters
        tables = clusters.nodes
        interval = self.series.interval
        substeps = []
        for c in np.flatnonzero(self._forces.logs):
            rows = clusters.tape.rows[c, : clusters.tape.used[c]]
            w, rate = clusters.tape.motion[c, : len(rows)].swapaxes(0, 1)
            length = rows["length"] * interval
            of_cluster = ClosedSubsteps(
                site=np.array(self._forces.sites(int(c)), int)[rows["site"]] - 1,
                side=np.sign(rows["mode"]),
                onset=rows["onset"] > 0,
                end=rows["begin"] + rows["position"] * interval + length,
                first_rate=rows["rate"],
                last_rate=rate @ at_end(),
                w=w,
                rate=rate,
                weights=tables.weight[rows["kind"]] * length[:, None],
            )
            substeps.append(of_cluster)
        return substeps

    def _open_rows(self, c: int, rows: np.ndarray, is_held: np.ndarray) -> np.ndarray:
        """Which ``rows`` (row,) of the tape of cluster ``c`` are of an open site, as those that ``is_held`` may be."""
        # A substep ends where such a site opens or closes: in its middle the site is what it is all through.
        w = self._forces.clusters.tape.motion[c, : len(rows), 0, NODES // 2]
        sites = self._forces.clusters.contacts[self._forces.dofs.first[c] + rows["site"]]
        side = np.sign(rows["mode"])
        clearance = np.where(side > 0, sites["clearance"], sites["clearance_minus"])
        return np.asarray(is_held & (side * w < clearance))

    def _linearise(self) -> _Linearisation:
        """Compute the matrices of the orbit from the tape."""
        clusters = self._forces.clusters
        dofs = self._forces.dofs
        tape = clusters.tape
        places = np.full((self.steps, len(clusters.state)), -1)
        matrices: list[np.ndarray] = []
        # Coefficients of every DoF of the largest cluster, and w'_minus of every site: each has a DoF of its own.
        largest = int(np.diff(dofs.first).max(initial=0)) * (clusters.taylor.shape[1] + 1)

        energy = clusters.energy.copy()
        for c in range(len(clusters.state)):
            rows = tape.rows[c, : tape.used[c]]
            motion = tape.motion[c, : tape.used[c]]
            steps, first = np.unique(np.rint(rows["begin"] / self.series.interval), return_index=True)
            stop = np.append(first, len(rows))[1:]
            for step, a, b in zip(steps.astype(int), first, stop, strict=True):
                places[step, c] = len(matrices)
                matrices.append(np.zeros((largest, largest)))
                linearise(clusters, dofs, c, rows[a:b], motion[a:b], matrices[-1])
        # The kernels that carry variations through a substep are those of the motion itself, and change its energies.
        clusters.energy[:] = energy
        return _Linearisation(places, np.array(matrices).reshape(len(matrices), largest, largest))

    def move(self, cells: np.ndarray) -> np.ndarray:
        """Move variations (variation, 2 dof, owned cell) of the beginning to the orbit's end; collective."""
        layout = self._layout
        count = len(cells)
        rows = 2 * layout.dofs
        if self._linear is None:
            self._linear = on_every_rank(layout.comm, self._linearise)
        if self._moving is None or len(self._moving.variations.components) != count:
            self._release()
            self._moving = self._create_moving(count, self._linear)

        variations = self._moving.variations
        variations.components[:, 0, : rows * layout.owned] = cells.reshape(count, -1)
        variations.approach[:] = 0.0
        error = move_variations(variations, self._stencil, self._moving.halo, self._forces.dofs, layout.owned)
        if error:
            raise RuntimeError(f"PETSc could not exchange cells: error {error}")
        moved = variations.components[:, len(variations.places) % 2, : rows * layout.owned]
        return moved.reshape(count, rows, layout.owned).copy()

    def _create_moving(self, count: int, linear: _Linearisation) -> _Moving:
        """Create the workspace of ``count`` variations; collective."""
        components = np.zeros((count, 2, self._components.shape[1]))
        states = [self._layout.create_vector(array) for pair in components for array in pair]
        # The same cells as the engine's, in columns of its own.
        regions = copy.copy(self._regions)
        halo = regions.bind_columns(states)
        taylor = self._forces.clusters.taylor.copy()
        variations = Variations(
            components=components,
            approach=np.zeros((count, len(taylor))),
            places=linear.places,
            matrices=linear.matrices,
            taylor=taylor,
        )
        return _Moving(variations, halo, [regions, *states])

    def _release(self) -> None:
        """Free the workspace of variations, if there is one."""
        if self._moving is not None:
            for petsc_object in self._moving.petsc_objects:
                petsc_object.destroy()
        self._moving = None

    def destroy(self) -> None:
        """Free the variations' objects as well."""
        self._release()
        super().destroy()
