"""Compiled right-hand side of the lattice, also as a C function that PETSc calls without entering Python.

The accelerations of all masses by springs and dashpots come from ``dynamics.springs``, mass by mass over all cells. The
force of a contact and that of a drive are then added to the few masses on which they act, and the powers that the
ledger integrates fill the components behind the velocities (the equations are in the package's docstring).
"""

import ctypes
from functools import cache
from typing import Any

from petsc4py import PETSc

import numpy as np

from vipetsc.compiled import cfunc, kernel
from vipetsc.contact.changes import first_change
from vipetsc.contact.law import FREE, STUCK, contact_force
from vipetsc.contact.together import join, solve
from vipetsc.dynamics import native
from vipetsc.dynamics.drives import drive_force, drive_power, lost_power
from vipetsc.dynamics.equation import acceleration
from vipetsc.dynamics.lattice_record import LATTICE, LatticeRecord
from vipetsc.dynamics.native import array_at
from vipetsc.dynamics.petsc_library import petsc_library
from vipetsc.dynamics.site_dofs import relative_motion
from vipetsc.dynamics.springs import add_nonlinear_accelerations, damping_powers, inverse_mass, spring_accelerations
from vipetsc.records import Record, record_at


@kernel
def site_motion(t: float, y: np.ndarray, lattice: LatticeRecord, motion: np.ndarray) -> None:
    """Fill ``motion`` (sites, 3) with w, w', w'' of every site, all of which join masses of one owned cell."""
    for i in range(motion.shape[0]):
        w, rate = relative_motion(y, lattice.site_dofs, i)
        force, _ = contact_force(lattice.contacts, i, w, rate)
        force -= lattice.contacts[i].preload
        host = lattice.site_dofs[i].host
        resonator = lattice.site_dofs[i].resonator
        at_host = acceleration(t, y, lattice, host.cell, host.mass, force)
        at_resonator = acceleration(t, y, lattice, resonator.cell, resonator.mass, -force)
        motion[i, 0] = w
        motion[i, 1] = rate
        motion[i, 2] = at_resonator - at_host


@kernel
def site_motion_by_rates(y: np.ndarray, f: np.ndarray, lattice: LatticeRecord, motion: np.ndarray) -> None:
    """Fill ``motion`` (sites, 3) with w, w', w'' of every site, whatever masses it joins.

    The state ``y`` and its derivative ``f`` come with their ghosts.
    """
    for i in range(motion.shape[0]):
        w, rate = relative_motion(y, lattice.site_dofs, i)
        _, acceleration = relative_motion(f, lattice.site_dofs, i)
        motion[i, 0] = w
        motion[i, 1] = rate
        motion[i, 2] = acceleration


@kernel
def _add_contacts(y: np.ndarray, f: np.ndarray, lattice: LatticeRecord) -> None:
    """Add the accelerations by contacts to ``f``, and put in what they dissipate."""
    n = lattice.shape.cells
    d = lattice.shape.dofs
    for i in range(lattice.site_dofs.size):
        power = 0.0
        if lattice.contacts[i].mode != FREE and abs(lattice.contacts[i].mode) != STUCK:
            host = lattice.site_dofs[i].host
            resonator = lattice.site_dofs[i].resonator
            w, rate = relative_motion(y, lattice.site_dofs, i)
            force, power = contact_force(lattice.contacts, i, w, rate)
            force -= lattice.contacts[i].preload
            if host.cell >= 0:
                f[(d + host.mass) * n + host.cell] += force * inverse_mass(lattice, host.cell, host.mass)
            if resonator.cell >= 0:
                per_mass = inverse_mass(lattice, resonator.cell, resonator.mass)
                f[(d + resonator.mass) * n + resonator.cell] -= force * per_mass
        if lattice.site_dofs[i].ledger >= 0:
            f[lattice.site_dofs[i].ledger] = power


@kernel
def right_hand_side(t: float, y: np.ndarray, f: np.ndarray, lattice: LatticeRecord) -> None:
    """Time derivative ``f`` (owned,) of the state ``y`` (ghosted,): velocities, accelerations, powers."""
    shape = lattice.shape
    n = shape.cells
    d = shape.dofs
    for k in range(d * n):
        f[k] = y[d * n + k]

    # Mass by mass: each inner loop runs over cells that lie side by side in memory.
    for mass in range(d):
        accelerations = f[(d + mass) * n : (d + mass + 1) * n]
        spring_accelerations(y, lattice, mass, accelerations)
        if lattice.spring_laws.size > 0:
            add_nonlinear_accelerations(y, lattice, mass, accelerations)

    _add_contacts(y, f, lattice)

    if shape.damping >= 0:
        damping_powers(y, lattice, 0, f[shape.damping : shape.damping + n])

    for i in range(lattice.drives.rows.size):
        drive = lattice.drives.rows[i]
        force = drive_force(lattice.drives, i, t)
        f[drive.target] += force * drive.inverse
        f[shape.work + i] = drive_power(lattice.drives, i, force, y[drive.target])
        if shape.damping >= 0:
            f[shape.damping + drive.target % n] += lost_power(lattice.drives, i, force, y[drive.target])


@kernel
def hold_stuck_sites(f: np.ndarray, lattice: LatticeRecord) -> None:
    """Add the reactions of stuck sites to the rates ``f`` (component,), with ghosts: w'' = 0 at each of them.

    The reactions of sites that share a mass depend on one another, and are found together.
    """
    count = 0
    any_shared = False
    for i in range(lattice.site_dofs.size):
        site = lattice.contacts[i]
        site.reaction = 0.0
        if abs(site.mode) == STUCK:
            count += 1
            any_shared |= site.shares
    if any_shared:
        _hold_together(f, lattice, count)
        return
    for i in range(lattice.site_dofs.size):
        if abs(lattice.contacts[i].mode) == STUCK:
            _, acceleration = relative_motion(f, lattice.site_dofs, i)
            _react(f, lattice, i, lattice.contacts[i].reduced_mass * acceleration)


@kernel
def _hold_together(f: np.ndarray, lattice: LatticeRecord, count: int) -> None:
    """Add the reactions of all stuck sites, so many, to the rates ``f``, as ``hold_stuck_sites``."""
    sites = np.empty(count, np.int64)
    k = 0
    for i in range(lattice.site_dofs.size):
        if abs(lattice.contacts[i].mode) == STUCK:
            sites[k] = i
            k += 1

    joined = join(lattice.contacts, sites)
    reactions = np.empty(count)
    # Once more for the rounding of the first time, which is that of a large force on light masses.
    for _ in range(2):
        for k in range(count):
            _, acceleration = relative_motion(f, lattice.site_dofs, sites[k])
            reactions[k] = acceleration
        solve(joined, reactions)
        for k in range(count):
            _react(f, lattice, sites[k], reactions[k])


@kernel
def _react(f: np.ndarray, lattice: LatticeRecord, i: int, force: float) -> None:
    """Add a ``force`` in N to the reaction of site ``i``, and what it does to its masses to the rates ``f``."""
    site = lattice.contacts[i]
    host = lattice.site_dofs[i].host.v
    site.reaction += force
    if host >= 0:
        f[host] += force * site.host_inverse
    f[lattice.site_dofs[i].resonator.v] -= force * site.resonator_inverse


ONSET = np.dtype([("time", np.float64), ("duration", np.float64)])
"""A step after the onset of a contact at ``time``, whose length is ``duration``, both in s; 0 in other steps.

PETSc's time is then z, 0 <= z <= duration, of which the time is t = time + z^2/duration. After the onset Hertz's force
goes as the power 3/2 of t, which no method of high order resolves; in z it is smooth (Brunner 2004, sec. 6.2).
"""
CONTEXT = np.dtype(
    [
        ("array", np.int64),  # receives the address of a vector's array; first, so that its address is the context's
        ("onset", ONSET),
        ("lattice", np.int64),
        ("stuck", np.int64),
    ],
    align=True,
)
"""What PETSc hands to the callback: the address of a ``LATTICE``, an ``ONSET``, the number of stuck sites anywhere."""


@kernel
def site_motion_at(t: float, y: np.ndarray, address: int, motion: np.ndarray) -> None:
    """``site_motion`` in the lattice of the ``CONTEXT`` at an ``address``.

    Python passes one number instead of a dozen arrays, which takes a fraction of the time.
    """
    context: Any = array_at(address, 1, CONTEXT)[0]
    site_motion(t, y, record_at(context.lattice, LATTICE), motion)


@kernel
def find_change(address: int, start: np.ndarray, end: np.ndarray, h: float, place: np.ndarray) -> float:
    """Return the position of ``first_change`` in a step of the sites of the ``CONTEXT`` at an ``address``.

    Kinks count. ``place`` (2,) gets the site and the function: to make a ``ModeChange`` takes longer than the search.
    """
    context: Any = array_at(address, 1, CONTEXT)[0]
    lattice = record_at(context.lattice, LATTICE)
    change = first_change(lattice.contacts, start, end, h, np.empty((2, 6)), kinks=True)
    place[0] = change.site
    place[1] = change.function
    return change.position


@kernel
def _hold(f: int, address: int, state: int, lattice: LatticeRecord) -> int:
    """Add reactions to the rates of the vector ``f``, which is open for writing; returns PETSc's error code.

    ``address`` is that of the ``CONTEXT``, ``state`` what it holds of the state's array.
    """
    context: Any = array_at(address, 1, CONTEXT)[0]
    shape = lattice.shape
    error = 0
    if shape.exchange and shape.paired:
        # A site may join masses of two ranks: each must know the other's acceleration.
        insert = native.INSERT_VALUES
        forward = native.FORWARD
        error = native.restore_write(f, address)
        error = error or native.ghosts_begin(f, insert, forward) or native.ghosts_end(f, insert, forward)
        error = error or native.get_write(f, address)
        if error != 0:
            return error
    hold_stuck_sites(array_at(context.array, shape.ghosted, np.float64), lattice)
    return error


def _callback(ts: int, t: float, u: int, f: int, address: int) -> int:
    """Return the function to be compiled: it puts the rates of the state ``u`` at PETSc's time t into ``f``.

    ``ts``, ``u`` and ``f`` are handles, ``address`` is that of a ``CONTEXT``. Returns PETSc's error code.
    """
    context: Any = array_at(address, 1, CONTEXT)[0]
    lattice = record_at(context.lattice, LATTICE)
    shape = lattice.shape
    error = 0
    if shape.exchange:
        insert = native.INSERT_VALUES
        forward = native.FORWARD
        error = native.ghosts_begin(u, insert, forward) or native.ghosts_end(u, insert, forward)
    error = error or native.get_read(u, address)
    if error != 0:
        return error
    state = context.array
    error = native.get_write(f, address)
    if error != 0:
        return error

    y = array_at(state, shape.ghosted, np.float64)
    rate = array_at(context.array, shape.owned, np.float64)
    onset = context.onset
    time = t
    if onset.duration > 0.0:
        time = onset.time + t * t / onset.duration
    right_hand_side(time, y, rate, lattice)
    if context.stuck > 0:
        error = _hold(f, address, state, lattice)
        if error != 0:
            return error
    if onset.duration > 0.0:
        # dt/dz of the step's own time z.
        speed = 2.0 * t / onset.duration
        for k in range(rate.size):
            rate[k] *= speed

    # PETSc wants the same address back that it gave, at the place where it put it.
    error = native.restore_write(f, address)
    if error != 0:
        return error
    context.array = state
    return native.restore_read(u, address)


@cache
def compile_callback() -> Any:
    """Return ``PetscErrorCode f(TS, PetscReal t, Vec u, Vec f, void *context)``, compiled or taken from numba's cache.

    ``context`` is the address of a ``CONTEXT`` record. All runs of a process have the same one, which lives on: to load
    it takes longer than a short run does. Raises AttributeError where PETSc hides its symbols.
    """
    native.bind_symbols()
    return cfunc("i4(i8, f8, i8, i8, i8)")(_callback)


def register(ts: PETSc.TS, lattice: Record) -> np.ndarray:
    """Make the lattice's right-hand side that of ``ts``, on the states of ``Layout.create_vector``.

    Returns its context, one record (1,) of dtype ``CONTEXT``, in which ``onset`` may be set before a step. Raises
    RuntimeError where PETSc refuses the function.
    """
    callback = compile_callback()
    context = np.zeros(1, CONTEXT)
    context["lattice"] = lattice.address
    # PETSc holds bare pointers: all that they point to must live as long as ts.
    ts.setAttr("callback", (context, lattice))
    error = petsc_library().TSSetRHSFunction(
        ctypes.c_void_p(ts.handle),
        ctypes.c_void_p(None),
        ctypes.c_void_p(callback.address),
        ctypes.c_void_p(context.ctypes.data),
    )
    if error:
        raise RuntimeError(f"TSSetRHSFunction failed with PETSc error {error}")
    return context
