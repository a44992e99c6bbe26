"""An orbit of a lattice that nothing drives, and the motion of variations along it.

``TangentPropagator`` runs the orbit as the engine does, from any given state, and writes each substep in which contacts
were closed on a tape (``orbit_tape``). From the tape it computes how variations of the orbit's beginning move to its
end. Shooting for periodic orbits of a whole lattice asks for that: for products of the monodromy matrix with vectors,
never the matrix.

Sections are those of the derivation in ``vipetsc.dynamics.propagator``. A *DoF* is the relative displacement w = c u of
the two masses between which a contact acts, the contact being a *site*, or the displacement of a driven mass; the row c
has an entry for each of these masses. A *cluster* is a set of DoFs that are solved for together, since they feel one
another within a step (sec. 6). The *mode* of a site says whether it is free, closed on the side sigma = + or -, or
closed with its force clipped to 0. A *substep* is a part of a step in which no mode changes (secs. 3, 4).

**A step** goes from t_0 to t_0 + H, with s = (t - t_0)/H. The lattice obeys M u'' + K u = sum of c^T F over the DoFs,
where F in N is the force of a contact on its w, positive where it raises w. The state y = (u, u') becomes

    y+ = P y + L mu,    mu_k = integral of F (1 - s)^k dt over the step.

P y is the free motion (sec. 1), and L mu the motion that all forces leave. To find it, variation of constants is
expanded in powers of the time 1 - s that remains after each impulse F dt: with A = H^2 M^-1 K, sec. 5 gives

    L mu = (M^-1 sum_m (c (-A)^m)^T H mu_(2m+1)/(2m+1)!,    M^-1 sum_m (c (-A)^m)^T mu_2m/(2m)!),

summed over the DoFs. There are as many moments mu_k of each as Taylor coefficients in P, 2 ``StepSeries.terms``: what
is left out is below the truncation of sec. 1. In a lattice with dashpots the rows of sec. 7 replace c (-A)^m.

**Forces** depend on y through few numbers: for each cluster, the *approach velocities* q of its sites and the Taylor
coefficients a = T y of the free motion w(s) = sum_k a_k s^k of its DoFs,

    a_2m = c (-A)^m u/(2m)!,    a_(2m+1) = H c (-A)^m u'/(2m+1)!    (sec. 2).

The approach velocity of a contact is w' at its onset, positive on the side + and negative on the side -. The law scales
its damping by it:

    F = -sigma f(x) (1 + beta w'/q),    x = sigma w - D >= 0,

with the elastic force f of the indentation x, f(0) = 0, the clearance D and the dimensionless damping beta, which the
code calls ``damping``. A law with clipping has F = 0 where the bracket is negative. For a contact that is pressed at
rest D is negative and beta = 0, and the force that it has at rest is taken off.

**Variations.** A variation dy of y moves by the derivative of these lines,

    dy+ = P dy + L dmu,    (dmu, dq+) = J (da, dq),    da = T dy.

J is one small matrix for each step and cluster in contact. In a substep F is the interpolant of its values at the
nodes. These solve the equation of the law there, in which w is the free motion and what F adds to it. The derivative of
that equation is a linear system for dF at the nodes, and from dF follow dmu and the variation at the substep's end.
Unit vectors (da, dq) are carried in this way through the substeps that the tape has of the step, one after the other
(``tangent_kernels``). Their q stays as it is but at an onset within the step (below). J is computed once for the orbit.
After that a variation costs as much as a linear step, and the small products. In the code T is ``expand_free_motion``,
L is ``apply_impulses``, and ``c`` is the number of a cluster.

**Times of onset and separation** vary with y, too. The variation of the state has no term for them, since the force is
continuous in time at each of these instants: f(0) = 0 at onsets and separations, also where a contact that is pressed
at rest opens or closes, and the bracket is 0 where clipping begins and ends. To act earlier by dt changes the state by
the order of dt^2, and the saltation matrix is the identity (Leine and Nijmeijer 2004, ch. 7). Only q depends on the
instant: an onset at the velocity w' and acceleration w'' comes earlier by dw/w', so that dq = dw' - w'' dw/w'. Where
the orbit grazes, w' = 0, there is no such derivative; near grazing dq is large, and so are the products with
variations, if the contact dissipates. Nothing is done about that here.

J treats the ends of substeps as constants. To move an end by dt changes the integrals by the order of dt^2 where a mode
changes, since F is continuous there. Elsewhere it divides one smooth integrand in another way, which changes them by no
more than the error of the collocation. J is therefore the derivative of the exact flow, and not of the program, which
chooses its substeps by the state.

References
----------
R. I. Leine and H. Nijmeijer, Dynamics and Bifurcations of Non-Smooth Mechanical Systems, Springer 2004.
"""

import copy
from collections.abc import Callable
from typing import NamedTuple

from mpi4py import MPI

import numpy as np

from vipetsc.case import Model
from vipetsc.contact.law import CLOSED, FREE, PERMANENT
from vipetsc.dynamics.engine import StalledError
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.clusters import expand_free_motion
from vipetsc.dynamics.propagator.engine import Propagator
from vipetsc.dynamics.propagator.orbit_tape import ClosedSubsteps, OrbitContacts, OrbitTape, clearance_on
from vipetsc.dynamics.propagator.stencil import exchange
from vipetsc.dynamics.propagator.step_choice import refusal as refusal_of_steps
from vipetsc.dynamics.propagator.substeps import create_tape
from vipetsc.dynamics.propagator.tangent_kernels import Variations, linearise, move_variations
from vipetsc.dynamics.propagator.unrecorded import unrecorded_samples
from vipetsc.dynamics.site_dofs import site_records
from vipetsc.parallel import on_every_rank
from vipetsc.records import Record

# Rows of the tape of a cluster unless the caller gives another number. A site that is not free has a row in each
# substep, of 208 B with the motion at the nodes: 1.7 MB. A contact of the built-in case takes fewer than 30 substeps,
# so that there is room for hundreds of contacts in one orbit; a contact that is pressed at rest has a row in every
# substep of the orbit. An orbit that needs more is refused at the next sample that is looked at, or at its end, with
# the number of rows up to there. The system gives memory to rows as they are written: those never used cost none.
MOST_TAPE_ROWS = 8192


class _Linearisation(NamedTuple):
    """The matrices J of an orbit, ``matrices`` (number, row, column), one for each step and cluster in contact.

    ``places`` (step, cluster) is the number of the matrix, -1 without contact in that step. Columns are what J takes:
    the Taylor coefficients a of the cluster's first DoF, of the second and so on, then q of each site. Rows are what it
    gives: as many moments mu of the force on each DoF, then q of each site. All matrices have the size of the largest
    cluster's; a smaller cluster uses the first rows and columns. A DoF has some 30 of them, most of them coefficients:
    8 kB a step in contact if no cluster has more than a site, 800 kB if one has ten sites, and then 0.8 GB for 1000
    steps in contact.
    """

    places: np.ndarray
    matrices: np.ndarray


class _Workspace(NamedTuple):
    """Workspace of ``variations`` that move together, the ``halo`` for their exchanges, the PETSc objects behind it."""

    variations: Variations
    halo: Record
    petsc_objects: list


class TangentPropagator(Propagator):
    """The engine of a lattice that nothing drives: one orbit from a given state, and the motion of its variations.

    It has one orbit: call ``place``, then ``run`` once, then ``move`` any number of times. ``run`` without a state that
    is placed, ``place`` or a second ``run`` after it, and ``move`` without a ``run`` that has reached the orbit's end
    raise RuntimeError. Of several calls of ``place`` the last one counts. The drives of ``model`` are switched off.

    States are arrays (2 mass, owned cell) over the masses of a cell, displacements in m before velocities in m/s.
    ``tape_rows``, the same on all ranks, is the length of each cluster's tape, which takes a row for each site that is
    not free in each substep; with 0 there is no tape, and ``move`` raises ValueError.

    Where PETSc fails to exchange cells, RuntimeError is raised on the rank where it does. The others may wait for that
    rank within the exchange, so that they cannot agree on it: the front door ends all ranks then
    (``parallel.install_abort_hook``).
    """

    def __init__(self, model: Model, layout: Layout, tape_rows: int = MOST_TAPE_ROWS) -> None:
        super().__init__(model, layout)
        self._model = model
        clusters = self._forces.clusters
        # A drive of no duration never acts. Its DoF stays in its cluster, which is then solved only in steps in which a
        # site may touch, as all others are.
        clusters.drives.rows["duration"] = 0.0
        self._forces.use(clusters._replace(tape=create_tape(len(clusters.state), tape_rows)))
        self._tape = OrbitTape(self._forces, self.series.interval)
        self._is_placed = False
        self._has_begun = False
        self._has_orbit = False
        self._linearisation: _Linearisation | None = None
        self._workspace: _Workspace | None = None

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
        # A site that touches at rest has the clearance 0. A pressed one has a negative clearance, and the other one is
        # inf: it has only that stop.
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

        Raises StalledError, on all ranks, for a closed contact that dissipates, whose force depends on it; RuntimeError
        after ``run``, or where PETSc fails to exchange cells.
        """
        if self._has_begun:
            raise RuntimeError("the engine has run its orbit: place a state before, or in another engine")
        clusters = self._forces.clusters
        sites = clusters.contacts
        state = self._present_cells()
        state[:] = cells

        # The zeroth coefficients of free motion are the relative displacements themselves.
        _raise_failed(exchange(self._halo, 0, state))
        for c in range(len(clusters.state)):
            expand_free_motion(self._forces.dofs, c, self._halo.columns, clusters.taylor)
        w = clusters.taylor[:, 0]

        # Every DoF has a row among ``sites``: those of drives have no stops, their clearances are inf. A mode has the
        # sign of the side that touches. A contact that is pressed at rest has one side, the others that of w.
        is_pressed = np.abs(sites["mode"]) == PERMANENT
        side = np.where(is_pressed, np.sign(sites["mode"]), np.sign(w))
        closed = side * w > clearance_on(side, sites)
        if self._layout.comm.allreduce(bool((closed & (sites["damping"] != 0)).any())):
            raise StalledError("a contact that dissipates is closed at the beginning")

        # Contacts that are pressed at rest keep the mode PERMANENT, closed or open: their force has a kink where they
        # open and close, and substeps end there (``advance``).
        sites["mode"] = np.where(is_pressed, sites["mode"], np.where(closed, side * CLOSED, FREE))
        # An open contact gets its velocity at its onset. Until then it is not read; 1 is what ``create_contacts`` sets.
        sites["approach"] = np.where(closed | is_pressed, side * speed, 1.0)
        # The engine takes a contact for new, with short substeps, while the time since its onset is a small fraction of
        # its expected duration (``advance``). Contacts that are closed already began long ago, whatever the duration.
        clusters.history["onset"] = -np.inf
        clusters.history["duration"] = 1.0
        self._is_placed = True

    def run(
        self, samples: int, look: Callable[[np.ndarray], None] | None = None, pause: Callable[[int], int] | None = None
    ) -> np.ndarray:
        """Advance to the sample number ``samples``, at least 1; returns the cells there.

        The sample n is the state at the time n ``model.sample_interval``, which is a whole number of steps, with n = 0
        at the start. Cells are states (2 mass, owned cell). ``look``, which some ranks may not have, is called with
        those of the samples 1 to ``samples``. Without it ``pause``, which all ranks have or none, is called with the
        number of the present sample, 0 at first, and returns that of the sample at which it is called next; what it
        raises on all ranks ends the run. All ranks must call ``run``. Raises StalledError, on all ranks, where the
        engine stalls, and where the orbit needs more rows than the tape has; ValueError for fewer samples than 1;
        RuntimeError before ``place``, and for a second orbit.
        """
        if samples < 1:
            raise ValueError(f"samples is {samples}: an orbit needs at least 1")
        if self._has_begun:
            raise RuntimeError("the engine has run its orbit: run another one in another engine")
        if not self._is_placed:
            raise RuntimeError("the engine has no state to begin with: call place before run")
        self._has_begun = True
        tape = self._forces.clusters.tape
        shows_each = self._layout.comm.allreduce(look is not None, MPI.LOR)
        number = 0
        while number < samples:
            # Where no rank has a state to show the engine goes to the next pause, or to the last sample, at once.
            goal = samples
            if shows_each:
                goal = number + 1
            elif pause:
                goal = min(pause(number), samples)
            number = goal
            # ``fill`` goes on to the sample ``number``, all ranks alike; without records there is nothing to fill.
            result = self.fill(unrecorded_samples(self.lattice, goal=number))
            # A full tape goes on to count the rows that it lacks; one without rows counts none.
            needed = self._layout.comm.allreduce(int(tape.used.max(initial=0)), max)
            room = tape.rows.shape[1]
            if result.stalled:
                raise StalledError(result.stalled)
            if needed > room:
                raise StalledError(
                    f"the tape of a cluster has {room} rows (tape_rows), and {needed} are needed up to sample {number} "
                    f"of {samples}: one for each site that is not free in each substep"
                )
            if look:
                look(self._present_cells().copy())
        self._has_orbit = True
        return self._present_cells().copy()

    def _present_cells(self) -> np.ndarray:
        """The engine's present state (2 mass, owned cell), a view: steps read and write two states in turn."""
        rows = 2 * self._layout.dofs
        owned = self._layout.owned
        return self._components[self.steps % 2][: rows * owned].reshape(rows, owned)

    def contacts(self) -> OrbitContacts:
        """The substeps in which the sites that this rank logs are closed, and their departures from rest."""
        return self._tape.contacts()

    def closed_substeps(self) -> list[ClosedSubsteps]:
        """The substeps in which contacts were closed, one record for each cluster that this rank logs."""
        return self._tape.closed_substeps()

    def _linearise(self) -> _Linearisation:
        """Compute the matrices J of the orbit from the tape."""
        clusters = self._forces.clusters
        dofs = self._forces.dofs
        places = np.full((self.steps, len(clusters.state)), -1)
        count = sum(len(self._steps_in_contact(c)[0]) for c in range(len(clusters.state)))
        # Rows and columns as in ``_Linearisation``. Every site is a DoF, and drives are DoFs without q: one number more
        # than the coefficients of each DoF is enough.
        coefficients = clusters.taylor.shape[1]
        largest = int(np.diff(dofs.first).max(initial=0)) * (coefficients + 1)

        # The kernels that carry variations through a substep are those of the motion itself. To ``energy`` they would
        # add what the forces of unit variations dissipate: it is restored below.
        energy = clusters.energy.copy()
        matrices = np.zeros((count, largest, largest))
        number = 0
        for c in range(len(clusters.state)):
            rows = self._tape.rows(c)
            motion = self._tape.motion(c)
            steps, first = self._steps_in_contact(c)
            stop = np.append(first, len(rows))[1:]
            for step, a, b in zip(steps.astype(int), first, stop, strict=True):
                places[step, c] = number
                linearise(self._forces.each, c, rows[a:b], motion[a:b], matrices[number])
                number += 1
        clusters.energy[:] = energy
        return _Linearisation(places, matrices)

    def _steps_in_contact(self, c: int) -> tuple[np.ndarray, np.ndarray]:
        """The steps (step,) in which cluster ``c`` was in contact, and the first row (step,) of each on its tape.

        Rows are in the order of time: those of one step follow each other.
        """
        steps, first = np.unique(np.rint(self._tape.rows(c)["begin"] / self.series.interval), return_index=True)
        return steps, first

    def move(self, cells: np.ndarray) -> np.ndarray:
        """Move variations (variation, 2 mass, owned cell) of the beginning to the orbit's end; all ranks must call it.

        The map is linear: if displacements are in any unit, velocities are in that unit per s. Raises ValueError for an
        engine without a tape, and RuntimeError before ``run``, after one that has raised an error, or where PETSc fails
        to exchange cells.
        """
        if self._forces.clusters.tape.rows.shape[1] == 0:
            raise ValueError("tape_rows is 0: an orbit without a tape has no variations; tape_rows must be at least 1")
        if not self._has_begun:
            raise RuntimeError("the engine has no orbit yet: call run before move")
        if not self._has_orbit:
            raise RuntimeError("run has not reached the orbit's end: variations move along a whole orbit alone")
        layout = self._layout
        count = len(cells)
        if count == 0:
            return cells.copy()
        rows = 2 * layout.dofs
        if self._linearisation is None:
            self._linearisation = on_every_rank(layout.comm, self._linearise)
        if self._workspace is None or len(self._workspace.variations.components) != count:
            self._release()
            self._workspace = self._create_workspace(count, self._linearisation)

        variations = self._workspace.variations
        variations.components[:, 0, : rows * layout.owned] = cells.reshape(count, -1)
        # dq = 0: of contacts that are closed at the beginning q is the fixed ``speed``, and the others have none yet.
        variations.approach[:] = 0.0
        _raise_failed(move_variations(variations, self._stencil, self._workspace.halo, self._forces.dofs, layout.owned))
        moved = variations.components[:, len(variations.places) % 2, : rows * layout.owned]
        return moved.reshape(count, rows, layout.owned).copy()

    def _create_workspace(self, count: int, linear: _Linearisation) -> _Workspace:
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
        return _Workspace(variations, halo, [regions, *states])

    def _release(self) -> None:
        """Free the workspace of variations, if there is one."""
        if self._workspace is not None:
            for petsc_object in self._workspace.petsc_objects:
                petsc_object.destroy()
        self._workspace = None

    def destroy(self) -> None:
        """Free the PETSc objects of the variations and of the engine; all ranks must call it."""
        self._release()
        super().destroy()


def _raise_failed(code: int) -> None:
    """Raise RuntimeError for an error ``code`` of PETSc other than 0."""
    if code:
        raise RuntimeError(f"PETSc could not exchange cells: error {code}")
