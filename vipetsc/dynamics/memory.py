"""How much memory a run needs, said before any of it is allocated."""

import os
import resource
from pathlib import Path

from mpi4py import MPI

from vipetsc.case import CaseError, Model
from vipetsc.case.reading import Problem
from vipetsc.case.schema import OutputTable
from vipetsc.dynamics.recorder import chunk_samples, recorded_cells, written_together

# States that an engine holds, each of 2 numbers a mass: two for each stage of a method and its saved copies; measured.
STAGES = {"2a": 2, "3bs": 4, "5f": 6, "5dp": 7, "5bs": 8, "6vr": 9, "7vr": 10, "8vr": 13}
STATES_BESIDE_STAGES, PROPAGATOR_STATES = 4.6, 3.0
# Copies of a chunk on rank 0 while it is gathered and written.
COPIES = 3
# Bytes of one sample's energies, of a contact site's tables and log.
SAMPLE_BYTES, SITE_BYTES = 300, 5000


def memory_needed(model: Model, output: OutputTable, engine: str, ranks: int) -> int:
    """Bytes that a run of ``model`` by ``engine`` takes on the fullest of ``ranks``, beside what a process begins with.

    The engine's states, the fields of one chunk (gathered ones of all cells on rank 0), all samples' energies and
    losses by site, and the sites.
    """
    chain = model.chain
    owned, recorded = -(-chain.cells // ranks), recorded_cells(output, chain.cells)
    states = 2 * STAGES[model.method] + STATES_BESIDE_STAGES if engine == "ts" else PROPAGATOR_STATES
    cells, per_cell = min(owned, len(recorded)), len(output.fields) * chain.cell.dofs * 8
    held, copies = (cells, 0) if written_together(model, output, ranks) else (len(recorded), COPIES)
    fields = chunk_samples(held * per_cell) * per_cell * (cells + copies * held)
    samples = model.samples * (SAMPLE_BYTES + 24 * len(chain.sites))
    return int(states * 16 * chain.cell.dofs * owned + fields + samples + SITE_BYTES * len(chain.sites))


def memory_available() -> int:
    """Bytes that this process may still take: what the machine has left, within the process's own limit."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))
        taken = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, StopIteration):  # not Linux
        free, taken = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"), 0
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return free if limit == resource.RLIM_INFINITY else min(free, max(limit - taken, 0))


def check_memory(model: Model, output: OutputTable, engine: str, comm: MPI.Comm) -> None:
    """Raise CaseError on all ranks where one has less memory left than the run needs; all must call it."""
    needed, node = memory_needed(model, output, engine, comm.size), comm.Split_type(MPI.COMM_TYPE_SHARED)
    share = comm.allreduce(memory_available() // node.size, MPI.MIN)
    node.Free()
    if needed > share:
        size = f"{model.chain.cells} cells, {len(model.chain.sites)} sites and {model.samples} samples"
        need = f"{size} need {needed / 1e9:.3g} GB of memory on a rank, which has {share / 1e9:.3g} GB"
        raise CaseError([Problem("lattice.cells", None, f"{need}; take fewer of them, or more machines")])
