"""Initial motion of a run: the cells of each rank, the motion of all sites, the energy of the state."""

from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.case import CaseError, Model
from vipetsc.case.section import Problem
from vipetsc.contact.law import LANDED
from vipetsc.dynamics.observers import Setup
from vipetsc.dynamics.site_dofs import relative_motion
from vipetsc.io.names import file_hash
from vipetsc.io.state import State
from vipetsc.lattice import Chain
from vipetsc.lattice.modes import mode_shape
from vipetsc.parallel import on_every_rank, on_root


def set_in_motion(setup: Setup, fields: tuple[np.ndarray, np.ndarray]) -> None:
    """Give the engine of ``setup`` an initial state; all ranks must call it.

    ``fields`` are displacements in m and velocities in m/s (cell, dof) of the rank's cells.
    """
    layout = setup.layout
    meter = setup.meter
    state = layout.create_vector()
    layout.place(np.hstack(fields), work=0.0, y=state.array)
    state.ghostUpdate()
    with state.localForm() as local:
        y = local.array
        site_dofs = setup.engine.lattice.site_dofs
        sums = meter.sums(y)
        relative = np.array([relative_motion(y, site_dofs, i) for i in range(len(layout.acting_sites))])

    # A site between two ranks comes from both, with the same bits.
    motion = np.zeros((len(setup.model.chain.sites), 2))
    of_rank = np.array(layout.acting_sites, np.int64), relative.reshape(-1, 2)
    for numbers, rows in layout.comm.allgather(of_rank):
        motion[numbers] = rows
    _check_stops(setup.model, motion)
    no_work = np.zeros((1, 1))
    energy = float(meter.total(sums[None], no_work).total[0])
    setup.engine.set_motion(layout.motion(state.array_r), motion, energy)
    state.destroy()


def _check_stops(model: Model, motion: np.ndarray) -> None:
    """Raise CaseError for a ``motion`` (site, 2) in which a mass is beyond a stop that does not yield."""
    w = motion[:, 0]
    beyond = (w[:, None] * [1, -1] - model.chain.sites.gaps).max(axis=1)
    wrong = np.flatnonzero(model.chain.sites.are_rigid & (beyond > LANDED * np.maximum(np.abs(w), model.scale)))
    if wrong.size:
        first = wrong[0]
        remedy = f"site {first + 1} begins {beyond[first]:.3g} m beyond its rigid stop"
        raise CaseError([Problem("initial", None, f"{remedy}; give a smaller motion or a law that yields")])


def initial_fields(model: Model, cells: range, comm: MPI.Comm) -> tuple[np.ndarray, np.ndarray]:
    """Return displacement and velocity (cell, dof) at t = 0 of the ``cells``, to the bit on any partition.

    All ranks of ``comm`` must call it. Raises CaseError on all if the state's file is gone or has changed.
    """
    initial = model.initial
    chain = model.chain
    assert initial is not None
    if initial.kind == "file":
        return _read_fields(initial, cells, comm)

    assert initial.amplitude
    if initial.kind == "velocity":
        v = np.zeros((len(cells), chain.cell.dofs))
        for _, strike in initial.strikes:
            if strike.cell - 1 in cells:
                v[strike.cell - 1 - cells.start, strike.mass - 1] = strike.velocity
        return np.zeros_like(v), v
    if initial.kind == "packet":
        u, v = initial.packet(chain.cell).on(chain, cells.start, cells.stop)
        return initial.amplitude * u, initial.amplitude * v

    number = initial.number
    assert number
    # A mode is that of the linear lattice: neither contacts nor cells that differ. It is computed whole, on one rank.
    linear = Chain(chain.cell, chain.cells, chain.ends)
    shape = on_root(comm, lambda: mode_shape(linear, number))
    u = initial.amplitude * shape[cells.start : cells.stop]
    return u, np.zeros_like(u)


def _read_fields(initial: Any, cells: range, comm: MPI.Comm) -> tuple[np.ndarray, np.ndarray]:
    """Return the fields of the file that ``initial`` names; its hash must be that with which the case was resolved."""
    path = Path(str(initial.path))

    def check() -> None:
        try:
            digest = file_hash(path)
        except OSError as error:
            raise CaseError([Problem("initial.path", initial.path, error.strerror or str(error))]) from None
        if digest != initial.sha256:
            remedy = f"its SHA-256 is {digest}, not the case's {initial.sha256}: it has changed since"
            raise CaseError([Problem("initial.path", initial.path, remedy)])

    # Hashed once, by one rank; read by each, which keeps its own cells only and sends none.
    on_root(comm, check)
    state = on_every_rank(comm, lambda: State.read(path, initial.time, initial.orbit))
    return state.on(cells.start, cells.stop)
