"""Recorded cells of a run, the ranks that write them, and samples in a chunk: asked before kernels are loaded."""

import h5py

from vipetsc.case import CaseError, Model, Problem
from vipetsc.case.schema import OutputTable
from vipetsc.io.store import GATHER_LIMIT

# A chunk is at most this many samples, and at most this many bytes of fields on a rank, which are fewer samples above
# 4096 cells of four masses. The built-in run, of 4421 samples, takes about 7, 5, 3, 3 and 3 s of CPU with 16, 64, 256,
# 1024 and all in a chunk; 1024 take 45 MB more than 256, and all of them 150 MB.
CHUNK_SAMPLES = 256
CHUNK_BYTES = 64 * 2**20


def recorded_cells(output: OutputTable, cells: int) -> range:
    """Cells (0-based) whose fields are recorded, of a lattice with so many ``cells``."""
    first, last = output.window or (1, cells)
    return range(first - 1, last, output.every)


def written_together(model: Model, output: OutputTable, ranks: int) -> bool:
    """Whether each of the ``ranks`` writes the fields of its own cells into one common file."""
    sample_bytes = len(output.fields) * model.chain.cell.dofs * 8 * len(recorded_cells(output, model.chain.cells))
    large = sample_bytes * -(-model.samples // output.stride) > GATHER_LIMIT
    return ranks > 1 and (output.writer == "parallel" or (output.writer == "auto" and large))


def possible_output(output: OutputTable, ranks: int) -> OutputTable:
    """The ``output`` as the h5py of these ``ranks`` can write it: where it has no MPI, ``auto`` gathers.

    Raises CaseError if every rank shall write and cannot.
    """
    if ranks == 1 or h5py.get_config().mpi:
        return output
    if output.writer == "parallel":
        remedy = (
            "needs an h5py with MPI support (Debian: python3-h5py-mpi; conda-forge: h5py=*=mpi_openmpi*);"
            ' "gather" does not need it'
        )
        raise CaseError([Problem("output.writer", output.writer, remedy)])
    return output.model_copy(update={"writer": "gather"})


def chunk_samples(sample_bytes: int) -> int:
    """Number of samples in a chunk, if a rank stores ``sample_bytes`` of fields for each."""
    return min(max(CHUNK_BYTES // max(sample_bytes, 1), 1), CHUNK_SAMPLES)
