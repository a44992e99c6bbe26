"""Recorded cells of a run, and samples in a chunk: asked before kernels are loaded."""

from vipetsc.case.schema import OutputTable

# A chunk is at most this many samples, and at most this many bytes of fields on a rank, which are fewer samples above
# 4096 cells of four masses. The built-in run, of 4421 samples, takes about 7, 5, 3, 3 and 3 s of CPU with 16, 64, 256,
# 1024 and all in a chunk; 1024 take 45 MB more than 256, and all of them 150 MB.
CHUNK_SAMPLES = 256
CHUNK_BYTES = 64 * 2**20


def recorded_cells(output: OutputTable, cells: int) -> range:
    """Return cells (0-based) whose fields are recorded, of a lattice with so many ``cells``."""
    first, last = output.window or (1, cells)
    return range(first - 1, last, output.every)


def chunk_samples(sample_bytes: int) -> int:
    """Return the number of samples in a chunk, if rank 0 stores ``sample_bytes`` of fields for each."""
    return min(max(CHUNK_BYTES // max(sample_bytes, 1), 1), CHUNK_SAMPLES)
