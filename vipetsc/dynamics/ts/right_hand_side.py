"""Compiled right-hand side of the lattice, also as a C function that PETSc calls without entering Python.

Springs and dashpots are ``springs``; a site and the drive add to single masses.
"""

import ctypes
from typing import Any, get_type_hints

from petsc4py import PETSc

import numpy as np
from numba import carray
from numba.core.ccallback import CFunc

from vipetsc.compiled import cfunc, kernel
from vipetsc.contact.law import FREE, SITE, contact_force
from vipetsc.dynamics import native
from vipetsc.dynamics.drives import DRIVE, Drives, drive_force
from vipetsc.dynamics.layout import COEFFICIENTS, COUPLING, MASS, SMOOTH, SPRING, LatticeRecord, Shape
from vipetsc.dynamics.native import pointer
from vipetsc.dynamics.places import PLACE
from vipetsc.dynamics.ts.springs import (
    damping_powers,
    inverse_mass,
    smooth_force,
    spring_acceleration,
    spring_accelerations,
)
from vipetsc.lattice.drive import PIECE


@kernel
def relative_motion(y: np.ndarray, lattice: LatticeRecord, i: int) -> tuple[float, float]:
    """w = u_resonator - u_host of site ``i`` and w'."""
    host, resonator = lattice.places[i].host, lattice.places[i].resonator
    if host.u < 0:
        return y[resonator.u], y[resonator.v]
    return y[resonator.u] - y[host.u], y[resonator.v] - y[host.v]


@kernel
def _acceleration(t: float, y: np.ndarray, lattice: LatticeRecord, cell: int, mass: int, force: float) -> float:
    """Acceleration of one mass by its springs, a contact ``force`` and the drives."""
    per_mass = inverse_mass(lattice, cell, mass)
    acceleration = spring_acceleration(y, lattice, cell, mass) + force * per_mass
    if lattice.smooth.size > 0:
        acceleration += smooth_force(y, lattice, cell, mass) * per_mass
    for i in range(lattice.drives.rows.size):
        if lattice.drives.rows[i].target == (lattice.shape.dofs + mass) * lattice.shape.cells + cell:
            acceleration += drive_force(lattice.drives, i, t) * per_mass
    return acceleration


@kernel
def observe(t: float, y: np.ndarray, lattice: LatticeRecord, motion: np.ndarray) -> None:
    """Fill ``motion`` (sites, 3) with w, w', w'' of every owned site."""
    for i in range(motion.shape[0]):
        w, rate = relative_motion(y, lattice, i)
        force, _ = contact_force(lattice.contacts, i, w, rate)
        host, resonator = lattice.places[i].host, lattice.places[i].resonator
        at_host = _acceleration(t, y, lattice, host.cell, host.mass, force)
        at_resonator = _acceleration(t, y, lattice, resonator.cell, resonator.mass, -force)
        motion[i, 0], motion[i, 1], motion[i, 2] = w, rate, at_resonator - at_host


@kernel
def observe_pairs(y: np.ndarray, f: np.ndarray, lattice: LatticeRecord, motion: np.ndarray) -> None:
    """The same of every site, given the state ``y`` and its derivative ``f``, both with their ghosts."""
    for i in range(motion.shape[0]):
        motion[i, 0], motion[i, 1] = relative_motion(y, lattice, i)
        motion[i, 2] = relative_motion(f, lattice, i)[1]


@kernel
def right_hand_side(t: float, y: np.ndarray, f: np.ndarray, lattice: LatticeRecord) -> None:
    """Time derivative ``f`` (owned,) of the state ``y`` (ghosted,): velocities, accelerations, powers."""
    shape = lattice.shape
    n, d = shape.cells, shape.dofs
    for k in range(d * n):
        f[k] = y[d * n + k]
    for mass in range(d):
        spring_accelerations(y, lattice, mass, f[(d + mass) * n : (d + mass + 1) * n])
        if lattice.smooth.size > 0:
            for cell in range(n):
                force = smooth_force(y, lattice, cell, mass)
                f[(d + mass) * n + cell] += force * inverse_mass(lattice, cell, mass)
    for i in range(lattice.places.size):
        power, place = 0.0, lattice.places[i]
        if lattice.contacts[i].mode != FREE:
            host, resonator = place.host, place.resonator
            w, rate = relative_motion(y, lattice, i)
            force, power = contact_force(lattice.contacts, i, w, rate)
            force -= lattice.contacts[i].preload
            if host.cell >= 0:
                f[(d + host.mass) * n + host.cell] += force * inverse_mass(lattice, host.cell, host.mass)
            if resonator.cell >= 0:
                per_mass = inverse_mass(lattice, resonator.cell, resonator.mass)
                f[(d + resonator.mass) * n + resonator.cell] -= force * per_mass
        if place.ledger >= 0:
            f[place.ledger] = power
    for i in range(lattice.drives.rows.size):
        drive, force = lattice.drives.rows[i], drive_force(lattice.drives, i, t)
        f[drive.target] += force * drive.inverse
        f[shape.work + i] = force * y[drive.target]
    if shape.damping >= 0:
        damping_powers(y, lattice, f[shape.damping : shape.damping + n])


_TABLES = ("masses", "couplings", "springs", "places", "contacts", "rows", "pieces", "smooth", *COEFFICIENTS)


def _c_struct(record: type) -> np.dtype:
    """The fields of a record of numbers, in their order."""
    return np.dtype(list(get_type_hints(record).items()), align=True)


CONTEXT = np.dtype(
    [
        ("array", np.int64),  # receives the address of a vector's array; first, so that its address is the context's
        ("shape", _c_struct(Shape)),
        ("address", np.dtype([(name, np.int64) for name in _TABLES])),
        ("length", np.dtype([(name, np.int64) for name in _TABLES])),
    ],
    align=True,
)
"""A ``LatticeRecord`` behind one pointer: its values, and the addresses and lengths of its tables."""


def _callback(ts: int, t: float, u: int, f: int, address: int) -> int:
    context: Any = carray(pointer(address), (1,), CONTEXT)[0]
    shape = context.shape
    error = (native.ghosts_begin(u, 1, 0) or native.ghosts_end(u, 1, 0)) if shape.exchange else 0
    error = error or native.get_read(u, address)
    if error != 0:
        return error
    state = context.array
    error = native.get_write(f, address)
    if error != 0:
        return error
    at, size = context.address, context.length
    lattice = LatticeRecord(
        shape,
        carray(pointer(at.masses), (size.masses,), MASS),
        carray(pointer(at.couplings), (size.couplings,), COUPLING),
        carray(pointer(at.springs), (size.springs,), SPRING),
        carray(pointer(at.places), (size.places,), PLACE),
        carray(pointer(at.contacts), (size.contacts,), SITE),
        Drives(carray(pointer(at.rows), (size.rows,), DRIVE), carray(pointer(at.pieces), (size.pieces,), PIECE)),
        carray(pointer(at.smooth), (size.smooth,), SMOOTH),
        carray(pointer(at.inverse_masses), (size.inverse_masses,), np.float64),
        carray(pointer(at.grounding), (size.grounding,), np.float64),
        carray(pointer(at.stiffness), (size.stiffness,), np.float64),
        carray(pointer(at.damping), (size.damping,), np.float64),
    )
    rate = carray(pointer(context.array), (shape.owned,), np.float64)
    right_hand_side(t, carray(pointer(state), (shape.ghosted,), np.float64), rate, lattice)
    error = native.restore_write(f, address)
    if error != 0:
        return error
    context.array = state
    return native.restore_read(u, address)


def compile_callback() -> CFunc:
    """``PetscErrorCode f(TS, PetscReal t, Vec u, Vec f, void *context)``, compiled or taken from numba's cache.

    ``context`` is the address of a ``CONTEXT`` record. Raises AttributeError where PETSc hides its symbols.
    """
    native.bind_symbols()
    return cfunc("i4(i8, f8, i8, i8, i8)")(_callback)


def register(ts: PETSc.TS, lattice: LatticeRecord) -> None:
    """Make the lattice's right-hand side that of ``ts``, on the states of ``Layout.create_vector``."""
    callback, context = compile_callback(), np.zeros(1, CONTEXT)
    tables = lattice._asdict() | lattice.drives._asdict()
    context["shape"] = lattice.shape
    context["address"] = tuple(tables[name].ctypes.data for name in _TABLES)
    context["length"] = tuple(tables[name].size for name in _TABLES)
    ts.setAttr("callback", (callback, context, lattice))  # PETSc holds bare pointers: all must live as long as ts
    pointers = (ctypes.c_void_p(p) for p in (ts.handle, None, callback.address, context.ctypes.data))
    error = native.petsc_library().TSSetRHSFunction(*pointers)
    if error:
        raise RuntimeError(f"TSSetRHSFunction failed with PETSc error {error}")
