"""The motion that a run begins with: each rank's own cells, what touches, the energy that the lattice is given."""

from typing import Any

import numpy as np

from vipetsc.case import CaseError, Model
from vipetsc.case.case_file import Problem
from vipetsc.case.initial import file_hash
from vipetsc.dynamics.energies import measure
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.observers import Setup
from vipetsc.dynamics.site_dofs import relative_motion
from vipetsc.io.state import State
from vipetsc.lattice import Chain
from vipetsc.lattice.modes import mode_shape
from vipetsc.parallel import on_every_rank, on_root


def set_in_motion(setup: Setup) -> None:
    """Give the engine of ``setup`` the initial state of its model; all ranks must call it.

    Raises CaseError on all ranks if the state's file is gone or has changed.
    """
    layout, meter = setup.layout, setup.meter
    state = layout.create_vector()
    layout.place(np.hstack(_fields(setup.model, layout)), 0.0, state.array)
    state.ghostUpdate()
    with state.localForm() as local:
        y, lattice = local.array, meter.lattice
        sums = measure(y, lattice, meter.unit)
        rows = [relative_motion(y, lattice.site_dofs, i) for i in range(len(layout.contacts))]
    motion = np.zeros((len(setup.model.chain.sites), 2))
    for numbers, theirs in layout.comm.allgather((layout.contacts, rows)):
        motion[list(numbers)] = np.reshape(theirs, (-1, 2))
    energy = float(meter.total(sums[None], np.zeros((1, 1))).total[0])
    setup.engine.begin(layout.motion(state.array_r), motion, energy)
    state.destroy()


def _fields(model: Model, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Displacement and velocity (cell, dof) of the rank's cells, the same to the last bit on any partition."""
    initial, chain, cells = model.initial, model.chain, (layout.start, layout.stop)
    assert initial is not None
    if initial.kind == "file":
        return _of_file(str(initial.path), initial, layout)
    assert initial.amplitude
    if initial.kind == "packet":
        u, v = initial.packet(chain.cell).on(chain, *cells)
        return initial.amplitude * u, initial.amplitude * v
    assert initial.number
    bare = Chain(chain.cell, chain.cells, chain.ends)
    u = initial.amplitude * on_root(layout.comm, lambda: mode_shape(bare, initial.number or 0))[slice(*cells)]
    return u, np.zeros_like(u)


def _of_file(path: str, initial: Any, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    def check() -> None:
        try:
            digest = file_hash(path)
        except OSError as error:
            raise CaseError([Problem("initial.path", path, error.strerror or str(error))]) from None
        if digest != initial.sha256:
            remedy = f"its SHA-256 is {digest}, not the case's {initial.sha256}: it has changed since"
            raise CaseError([Problem("initial.path", path, remedy)])

    on_root(layout.comm, check)
    state = on_every_rank(layout.comm, lambda: State.read(path, initial.time, initial.orbit))
    return state.on(layout.start, layout.stop)
