"""An orbit of a lattice that nothing drives, and the motion of variations along it.

``TangentPropagator`` runs the orbit as the engine does, from any given state, and writes each substep in which contacts
were closed on a tape. From the tape it computes how variations of the orbit's beginning move to its end. Shooting for
periodic orbits of a whole lattice asks for that: for products of the monodromy matrix with vectors, never the matrix.

**Method.** A step of the length H takes the lattice's state y to P y, its free motion, plus L mu, the motion that the
forces of contacts leave (sec. 5 of the derivation in the package's docstring). The numbers mu are the moments of each
force F over the step, mu_k = integral of F (1 - s)^k dt, s from 0 to 1. The forces depend on y through few numbers: for
each cluster, the Taylor coefficients a of the free motion of its DoFs, and the approach velocities q of its sites. With
the relative displacement w of a site, q is w'_minus, the value of w' at which the present contact began; it is negative
on the side -. The law scales its damping by q. A variation dy therefore moves by

    dy+ = P dy + L dmu,    (dmu, dq+) = J (da, dq),    da = T dy,

where T is ``expand_free_motion`` and L is ``apply_impulses``. J is one small matrix for each step and cluster in
contact: the product of the linearised collocations of the step's substeps, which the tape has, one after the other
(``tangent_kernels``). It is computed once for the orbit. After that a variation costs as much as a linear step, and the
small products.

**Times of onset and separation** vary with y, too. The variation of the state has no term for them: the force is
continuous at each change of mode, zero at an onset, at a separation, and where clipping begins and ends. To act earlier
by dt changes the state by the order of dt^2, and the saltation matrix is the identity (Leine and Nijmeijer 2004,
ch. 7). Only q feels the instant: an onset at the velocity w' and acceleration w'' comes earlier by dw/w', so that
dq = dw' - w'' dw/w'. Where the orbit grazes, w' = 0, there is no such derivative; near grazing dq is large, and so are
the products with variations, if the contact dissipates. Nothing is done about that here.

In J the ends of substeps are the orbit's, fixed in time. They only divide integrals over time, on whose value they have
no influence but the error of the collocation: up to that J is the derivative of the flow. The derivative of a program
that chooses its substeps by the state would have terms for that choice.

References
----------
R. I. Leine and H. Nijmeijer, Dynamics and Bifurcations of Non-Smooth Mechanical Systems, Springer 2004.
"""

import copy
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vipetsc.case import Model
from vipetsc.contact.law import CLOSED, FREE, PERMANENT
from vipetsc.dynamics.engine import StalledError
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.clusters import expand_free_motion
from vipetsc.dynamics.propagator.engine import Propagator
from vipetsc.dynamics.propagator.nodes import NODES, at_end
from vipetsc.dynamics.propagator.stencil import Halo, exchange
from vipetsc.dynamics.propagator.step_choice import refusal as refusal_of_steps
from vipetsc.dynamics.propagator.substeps import create_tape
from vipetsc.dynamics.propagator.tangent_kernels import Variations, linearise, move_variations
from vipetsc.dynamics.propagator.unrecorded import unrecorded_samples
from vipetsc.dynamics.site_dofs import site_records
from vipetsc.parallel import on_every_rank

# Rows of the tape of a cluster, one for each closed site in each substep, 208 B each with the motion at the nodes: 1.7
# MB. A contact of the built-in case takes fewer than 30 substeps, so that there is room for hundreds of contacts in one
# orbit; one that needs more is refused with the number of rows. The system gives memory to rows as they are written:
# those that are never used cost none.
MOST_TAPE_ROWS = 8192


class _Linearisation(NamedTuple):
    """The matrices J of an orbit, ``matrices`` (number, row, column), one for each step and cluster in contact.

    ``places`` (step, cluster) is the number of the matrix, -1 without contact in that step. Columns are what J takes:
    the Taylor coefficients a of the cluster's first DoF, of the second and so on, then q of each site. Rows are what it
    gives: as many moments mu of the force on each DoF, then q of each site. All matrices have the size of the largest
    cluster's; a smaller cluster uses the first rows and columns. A DoF has some 30 of them, most of them coefficients:
    8 kB a step in contact for a site alone, 800 kB for ten sites in one cluster.
    """

    places: np.ndarray
    matrices: np.ndarray


class _Moving(NamedTuple):
    """Workspace of ``variations`` moved together, the ``halo`` for their exchanges, and the PETSc objects behind it."""

    variations: Variations
    halo: Halo
    petsc_objects: list


class OrbitContacts(NamedTuple):
    """Begins and ends (number, 2) in s of times in contact in an orbit.

    One contact takes several ``closed_substeps``, which follow each other. ``departures`` are the times in which a site
    is closed, or open if it is pressed at rest.
    """

    closed_substeps: np.ndarray
    departures: np.ndarray


class ClosedSubsteps(NamedTuple):
    """Substeps (row,) of an orbit in which contacts were closed, in the order of time at each site.

    A substep in which several sites were closed has a row for each. ``site`` counts the lattice's sites from 0,
    ``side`` is 1 or -1; ``onset`` marks substeps with which a contact begins. A substep ends at ``end`` in s, counted
    from the orbit's beginning. ``first_rate`` and ``last_rate`` are w' in m/s at both ends; ``w`` and ``rate`` (row,
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


class TangentPropagator(Propagator):
    """The engine of a lattice that nothing drives: one orbit from a given state, and the motion of its variations.

    Call ``place`` once, then ``run`` once, then ``move`` any number of times. States are arrays (2 mass, owned cell)
    over the masses of a cell, displacements in m before velocities in m/s. The drives of ``model`` are switched off.
    ``tape_rows`` is the length of each cluster's tape, which takes a row for each closed site in each substep; with 0
    there is no tape, and ``move`` raises ValueError.
    """

    def __init__(self, model: Model, layout: Layout, tape_rows: int = MOST_TAPE_ROWS) -> None:
        super().__init__(model, layout)
        self._model = model
        clusters = self._forces.clusters
        # A drive of no duration never acts. Its DoF stays in its cluster, which is then solved only in steps in which a
        # site may touch, as all others are.
        clusters.drives.rows["duration"] = 0.0
        self._forces.clusters = clusters._replace(tape=create_tape(len(clusters.state), tape_rows))
        self._linear: _Linearisation | None = None
        self._moving: _Moving | None = None

    @classmethod
    def refusal(cls, model: Model) -> str | None:
        """Why this engine does not suit ``model``, in words, or None.

        It refuses what ``Propagator`` refuses; nonlinear springs, whose force is collocated but not linearised here;
        contacts that touch at rest, about which no motion is linear, however small: their stiffness jumps from 0 to
        that of the contact; and contacts that are pressed at rest and dissipate, as they have no approach velocity. The
        stiffness of other pressed contacts does not jump at rest: they are not refused.
        """
        if not model.chain.is_linear:
            return "springs have a quadratic or cubic part; variations are not supported for them"
        sites = site_records(model, np.arange(len(model.chain.sites)))
        # The clearance is 0 of a site that touches at rest, negative of one that is pressed, which has this one stop.
        clearance = np.minimum(sites["clearance"], sites["clearance_minus"])
        if (clearance == 0).any():
            return "contacts touch at rest; variations are not supported for them"
        if ((clearance < 0) & (sites["damping"] != 0)).any():
            return "contacts that are pressed at rest dissipate, which needs an approach velocity that they do not have"
        return refusal_of_steps(model)

    def place(self, cells: np.ndarray, speed: float) -> None:
        """Begin at the state ``cells`` (2 mass, owned cell); ``speed`` in m/s is a typical one of relative motion.

        The errors of substeps in contact are relative to the approach velocity. That of a contact that is closed at the
        beginning is not part of the state: ``speed`` takes its place. All ranks must call it.

        Raises StalledError, on all ranks, for a closed contact that dissipates, whose force depends on it.
        """
        clusters = self._forces.clusters
        sites = clusters.contacts
        state = self._present_cells()
        state[:] = cells

        # The zeroth coefficients of free motion are the relative displacements themselves.
        exchange(self._halo, 0, state)
        for c in range(len(clusters.state)):
            expand_free_motion(self._forces.dofs, c, self._halo.columns, clusters.taylor)
        w = clusters.taylor[:, 0]

        # Every DoF has a row among ``sites``: those of drives have no stops, their clearances are inf. A mode has the
        # sign of the side that touches. A contact that is pressed at rest has one side, the others that of w.
        is_pressed = np.abs(sites["mode"]) == PERMANENT
        side = np.where(is_pressed, np.sign(sites["mode"]), np.sign(w))
        closed = side * w > _clearance_on(side, sites)
        if self._layout.comm.allreduce(bool((closed & (sites["damping"] != 0)).any())):
            raise StalledError("a contact that dissipates is closed at the beginning")

        # Contacts that are pressed at rest keep the mode PERMANENT, closed or open: their force has a kink where they
        # open and close, and substeps end there (``kinks``).
        sites["mode"] = np.where(is_pressed, sites["mode"], np.where(closed, side * CLOSED, FREE))
        # An open contact gets its velocity at its onset. Until then it is not read; 1 is what ``create_contacts`` sets.
        sites["approach"] = np.where(closed | is_pressed, side * speed, 1.0)
        # The engine takes a contact for new, with short substeps, while the time since its onset is a small fraction of
        # its expected duration (``advance``). Contacts that are closed already began long ago, whatever the duration.
        clusters.history["onset"] = -np.inf
        clusters.history["duration"] = 1.0

    def run(self, samples: int, look: Callable[[np.ndarray], None] | None = None) -> np.ndarray:
        """Advance to the sample number ``samples``, at least 1, counted from 0 at the start; returns the cells there.

        Cells are states (2 mass, owned cell). ``look`` is called with those of the samples 1 to ``samples``. All ranks
        must call it. Raises StalledError, on all ranks, where the engine stalls, and where the orbit needs more
        substeps in contact than the tape has rows; ValueError for fewer samples than 1.
        """
        if samples < 1:
            raise ValueError(f"samples is {samples}: an orbit needs at least 1")
        tape = self._forces.clusters.tape
        # Without anything to show the engine goes to the last sample at once.
        numbers = range(samples, samples + 1)
        if look:
            numbers = range(1, samples + 1)
        for number in numbers:
            result = self.fill(unrecorded_samples(self._model, self._layout, goal=number))
            # A full tape goes on to count the rows that it lacks; one without rows counts none.
            needed = self._layout.comm.allreduce(int(tape.used.max(initial=0)), max)
            room = tape.rows.shape[1]
            if result.stalled or needed > room:
                raise StalledError(result.stalled or f"an orbit needs {needed} substeps in contact, of {room}")
            if look:
                look(self._present_cells().copy())
        return self._present_cells().copy()

    def _present_cells(self) -> np.ndarray:
        """The engine's present state (2 mass, owned cell), a view: steps read and write two states in turn."""
        rows = 2 * self._layout.dofs
        owned = self._layout.owned
        return self._components[self.steps % 2][: rows * owned].reshape(rows, owned)

    def contacts(self) -> OrbitContacts:
        """The times in contact of the sites that this rank logs."""
        spans = [np.zeros((0, 2))]
        departures = []
        for c in np.flatnonzero(self._forces.logs).tolist():
            rows = self._tape_rows(c)
            is_open = self._is_open(c)
            begin, end = self._times(rows)
            spans.append(np.column_stack([begin, end])[~is_open])

            # The first substep after an onset is marked. One that begins with the orbit is not, though it begins a
            # contact as well: that of a site which is closed at the start.
            is_pressed = np.abs(rows["mode"]) == PERMANENT
            begins = (rows["onset"] > 0) | (begin == 0.0)
            is_away = is_open | ~is_pressed
            for site in np.unique(rows["site"]):
                here = rows["site"] == site
                # An opening begins behind a substep in which the contact is closed.
                opens = is_open[here] & ~np.append(False, is_open[here][:-1])
                is_first = np.where(is_pressed[here], opens, begins[here])
                number = np.cumsum(is_first)
                for departure in range(1, number.max(initial=0) + 1):
                    of_it = is_away[here] & (number == departure)
                    departures.append((begin[here][of_it].min(), end[here][of_it].max()))
        return OrbitContacts(np.concatenate(spans), np.reshape(departures, (-1, 2)))

    def closed_substeps(self) -> list[ClosedSubsteps]:
        """The substeps in which contacts were closed, one record for each cluster that this rank logs."""
        clusters = self._forces.clusters
        substeps = []
        for c in np.flatnonzero(self._forces.logs).tolist():
            is_closed = ~self._is_open(c)
            rows = self._tape_rows(c)[is_closed]
            motion = clusters.tape.motion[c, : clusters.tape.used[c]][is_closed]
            rate = motion[:, 1]
            _, end = self._times(rows)
            length = rows["length"] * self.series.interval
            # Rows have a site's number in its cluster; ``Forces.sites`` gives those in the lattice, from 1.
            of_cluster = ClosedSubsteps(
                site=np.array(self._forces.sites(c), int)[rows["site"]] - 1,
                side=np.sign(rows["mode"]),
                onset=rows["onset"] > 0,
                end=end,
                first_rate=rows["rate"],
                last_rate=rate @ at_end(),
                w=motion[:, 0],
                rate=rate,
                weights=clusters.nodes.weight[rows["kind"]] * length[:, None],
            )
            substeps.append(of_cluster)
        return substeps

    def _tape_rows(self, c: int) -> np.ndarray:
        """The rows (row,) of the tape of cluster ``c`` that are written, of dtype ``TAPE_ROW``."""
        tape = self._forces.clusters.tape
        return np.asarray(tape.rows[c, : tape.used[c]])

    def _times(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Begin and end (row,) in s of the substeps in ``rows`` of a tape."""
        # "begin" is that of the linear step in s; position and length of the substep in it are in units of the step.
        step = self.series.interval
        begin = rows["begin"] + rows["position"] * step
        return begin, begin + rows["length"] * step

    def _is_open(self, c: int) -> np.ndarray:
        """Mask (row,) of the rows of the tape of cluster ``c`` that belong to an open site.

        The tape has the sites that are not free. Of these only a contact that is pressed at rest may be open.
        """
        tape = self._forces.clusters.tape
        rows = self._tape_rows(c)
        # A substep ends where such a contact opens or closes: at all nodes it is what it is at one. A node in the
        # middle is farthest from the ends, where rounding decides.
        w = tape.motion[c, : tape.used[c], 0, NODES // 2]
        sites = self._forces.clusters.contacts[self._forces.dofs.first[c] + rows["site"]]
        side = np.sign(rows["mode"])
        return np.asarray((np.abs(rows["mode"]) == PERMANENT) & (side * w < _clearance_on(side, sites)))

    def _linearise(self) -> _Linearisation:
        """Compute the matrices J of the orbit from the tape."""
        clusters = self._forces.clusters
        dofs = self._forces.dofs
        tape = clusters.tape
        places = np.full((self.steps, len(clusters.state)), -1)
        matrices: list[np.ndarray] = []
        # Rows and columns as in ``_Linearisation``. Every site is a DoF, and drives are DoFs without q: one number more
        # than the coefficients of each DoF is enough.
        coefficients = clusters.taylor.shape[1]
        largest = int(np.diff(dofs.first).max(initial=0)) * (coefficients + 1)

        # The kernels that carry variations through a substep are those of the motion itself: they add to the energies
        # what the variations' forces would dissipate, which is taken off again.
        energy = clusters.energy.copy()
        for c in range(len(clusters.state)):
            rows = self._tape_rows(c)
            motion = tape.motion[c, : tape.used[c]]
            # Rows are in the order of time: those of one step follow each other.
            steps, first = np.unique(np.rint(rows["begin"] / self.series.interval), return_index=True)
            stop = np.append(first, len(rows))[1:]
            for step, a, b in zip(steps.astype(int), first, stop, strict=True):
                places[step, c] = len(matrices)
                matrices.append(np.zeros((largest, largest)))
                linearise(clusters, dofs, c, rows[a:b], motion[a:b], matrices[-1])
        clusters.energy[:] = energy
        return _Linearisation(places, np.array(matrices).reshape(len(matrices), largest, largest))

    def move(self, cells: np.ndarray) -> np.ndarray:
        """Move variations (variation, 2 mass, owned cell) of the beginning to the orbit's end; all ranks must call it.

        The map is linear: variations may have any size, with velocities per s in the unit of the displacements. Raises
        ValueError for an engine without a tape, and RuntimeError where PETSc fails to exchange cells.
        """
        if self._forces.clusters.tape.rows.shape[1] == 0:
            raise ValueError("tape_rows is 0: an orbit without a tape has no variations; tape_rows must be at least 1")
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
        # dq = 0: of contacts that are closed at the beginning q is the fixed ``speed``, and the others have none yet.
        variations.approach[:] = 0.0
        error = move_variations(variations, self._stencil, self._moving.halo, self._forces.dofs, layout.owned)
        if error:
            raise RuntimeError(f"PETSc could not exchange cells: error {error}")
        moved = variations.components[:, len(variations.places) % 2, : rows * layout.owned]
        return moved.reshape(count, rows, layout.owned).copy()

    def _create_moving(self, count: int, linear: _Linearisation) -> _Moving:
        """Create the workspace of ``count`` variations; all ranks must call it."""
        components = np.zeros((count, 2, self._components.shape[1]))
        states = [self._layout.create_vector(array) for pair in components for array in pair]
        # A shallow copy has the engine's ranges of cells, and binds columns and a scatter of its own to them.
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
        """Free the PETSc objects of the variations and of the engine; all ranks must call it."""
        self._release()
        super().destroy()


def _clearance_on(side: np.ndarray, sites: np.ndarray) -> np.ndarray:
    """The clearances (site,) in m of ``sites`` of dtype ``SITE``, each on its ``side``: + above 0, else -."""
    return np.where(side > 0, sites["clearance"], sites["clearance_minus"])
