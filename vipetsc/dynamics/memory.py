"""Memory that a run needs, estimated before any of it is allocated."""

import os
import resource
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vipetsc.case import CaseError, Model
from vipetsc.case.schema import OutputTable
from vipetsc.case.section import Problem
from vipetsc.dynamics.propagator.step_choice import step_series
from vipetsc.dynamics.recorded_sizes import chunk_samples, recorded_cells

if TYPE_CHECKING:
    from mpi4py import MPI

# States that an engine holds, each of 2 numbers a mass: two for each stage of a method and its saved copies; measured.
STAGES = {"2a": 2, "3bs": 4, "5f": 6, "5dp": 7, "5bs": 8, "6vr": 9, "7vr": 10, "8vr": 13}
FURTHER_STATES = 4.6
PROPAGATOR_STATES = 3.0
# Copies of a chunk on the rank that keeps it, and further ones on rank 0 while the chunks of all are gathered.
COPIES = 2
GATHERED = 3
# Bytes of one sample's energies, and of a point's motion; of a site on every rank, and on the one that owns it.
SAMPLE_BYTES = 300
POINT_BYTES = 48
SITE_BYTES = 600
OWN_SITE_BYTES = 2500
# Bytes that the ranks send to rank 0 at once.
LARGEST_MESSAGE = 2 * 2**30
REMEDIES = {
    "lattice.cells": 'fewer cells, more machines or time.engine = "propagator" reduce it',
    "contacts.sites": "fewer sites or more machines reduce it",
    "output.window": "fewer cells reduce it",
    "time.sample_interval": "fewer samples reduce it",
}


def memory_needed(model: Model, output: OutputTable, engine: str, ranks: int) -> dict[str, float]:
    """Return bytes that a run of ``model`` by ``engine`` takes on the fullest of ``ranks``, by the key they grow with.

    The parts are the engine's states, the sites, a chunk of fields and losses (on rank 0 gathered from all cells), and
    the energies of all samples. The memory with which a process begins is not included.
    """
    chain = model.chain
    owned = -(-chain.cells // ranks)
    first_cells = np.append(np.arange(0, chain.cells, owned), chain.cells)
    own_sites = int(np.histogram(chain.sites.cells, first_cells)[0].max())
    return {
        "lattice.cells": _bytes_of_states(model, engine, ranks),
        "contacts.sites": SITE_BYTES * len(chain.sites) + OWN_SITE_BYTES * own_sites,
        "output.window": _bytes_of_chunk(model, output, ranks, own_sites),
        "time.sample_interval": model.samples * (SAMPLE_BYTES + POINT_BYTES * len(output.points or [])),
    }


def _bytes_of_states(model: Model, engine: str, ranks: int) -> float:
    """Return bytes of the engine's states on a rank, and of the numbers of cells that differ."""
    chain = model.chain
    cell = model.chain.cell
    owned = -(-chain.cells // ranks)
    per_cell = 2 * cell.dofs + (chain.is_damped and engine == "ts")
    states = PROPAGATOR_STATES
    if engine == "ts":
        states = 2 * STAGES[model.method] + FURTHER_STATES
    tables = 0
    if chain.is_damped or not chain.is_uniform():
        tables = 2 * (cell.dofs + len(cell.springs))

    differing = 0
    if chain.variation:
        differing = sum(array.nbytes for _, array in chain.variation.items())
    if engine == "propagator" and differing and (series := step_series(model)):
        # Rows of the step.
        numbers = (2 * cell.dofs) ** 2 * (2 * series.reach + 1)
        differing += 8 * numbers * series.own_rows()[1] // ranks
    return (states * per_cell + 2 * tables) * 8 * owned + differing


def _bytes_of_chunk(model: Model, output: OutputTable, ranks: int, own_sites: int) -> int:
    """Return bytes of the copies of a chunk of fields and losses on the fullest rank."""
    chain = model.chain
    recorded = len(recorded_cells(output, chain.cells))
    per_cell = len(output.fields) * chain.cell.dofs
    per_site = 1 + bool(output.forces)  # losses, and forces if they are kept
    local = min(-(-chain.cells // ranks), recorded) * per_cell + per_site * own_sites
    every = recorded * per_cell + per_site * len(chain.sites)
    if ranks == 1:
        return 8 * min(chunk_samples(8 * local), model.samples) * COPIES * local
    # A chunk that is gathered lies on rank 0 whole: its length follows from all cells.
    return 8 * min(chunk_samples(8 * every), model.samples) * (COPIES * local + GATHERED * every)


def memory_available() -> int:
    """Return bytes that this process may still take: what the machine has left, within the process's own limit."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))
        taken = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, StopIteration):  # not Linux
        free = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        taken = 0
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return free
    return min(free, max(limit - taken, 0))


def check_scalars(scalar: Any = None) -> None:
    """Raise CaseError if PETSc does not compute with real doubles; ``scalar`` is the type of its numbers."""
    from vipetsc.dynamics.petsc_library import refused_scalars

    refused = refused_scalars(scalar)
    if refused:
        raise CaseError([Problem("petsc", None, refused)])


def check_size(model: Model) -> None:
    """Raise CaseError if the indices of this PETSc do not count the numbers of the state of ``model``."""
    chain = model.chain
    size = chain.cells * (2 * chain.cell.dofs + chain.is_damped) + len(chain.sites) + 1
    # Every PETSc counts so many: it is not started to look at its indices, since that takes a quarter of a second.
    if size <= np.iinfo(np.int32).max:
        return
    from petsc4py import PETSc

    most = int(np.iinfo(PETSc.IntType).max)
    if size > most:
        remedy = f"results in a state of {size} numbers, more than the {most} that the indices of this PETSc count"
        build = "use a PETSc configured --with-64-bit-indices (Debian: python3-petsc4py-64-real)"
        raise CaseError([Problem("lattice.cells", chain.cells, f"{remedy}; {build}")])


def check_memory(model: Model, output: OutputTable, engine: str, comm: "MPI.Comm") -> None:
    """Raise CaseError on all ranks if one has less memory left than the run needs; all must call it.

    The same error is raised if PETSc's numbers or indices do not suffice.
    """
    check_scalars()
    check_size(model)
    sample = 8 * len(output.fields) * model.chain.cell.dofs * len(recorded_cells(output, model.chain.cells))
    if comm.size > 1 and sample > LARGEST_MESSAGE:
        remedy = f"a sample of {sample / 1e9:.3g} GB exceeds the size of one MPI message; fewer cells reduce it"
        raise CaseError([Problem("output.window", output.window, remedy)])

    from mpi4py import MPI

    # The ranks of a machine divide what it has left.
    machine = comm.Split_type(MPI.COMM_TYPE_SHARED)
    available = comm.allreduce(memory_available() // machine.size, MPI.MIN)
    machine.Free()
    parts = memory_needed(model, output, engine, comm.size)
    needed = sum(parts.values())
    if needed > available:
        key = max(parts, key=lambda part: parts[part])
        size = f"{model.chain.cells} cells, {len(model.chain.sites)} sites and {model.samples} samples"
        need = f"{size} need {needed / 1e9:.3g} GB of memory per rank, but only {available / 1e9:.3g} GB are free"
        raise CaseError([Problem(key, None, f"{need}; {REMEDIES[key]}")])
