"""The verb ``doctor``: versions of an installation, and missing packages."""

import argparse
import time
from typing import TYPE_CHECKING

from vipetsc.cli.arguments import argument
from vipetsc.cli.installation import checks
from vipetsc.cli.messages import duration, echo, table
from vipetsc.cli.verb import BAD_INPUT, DONE, PlainVerb
from vipetsc.io.folder import provenance
from vipetsc.parallel import StopRequest

if TYPE_CHECKING:
    from mpi4py import MPI


def doctor(options: argparse.Namespace, comm: "MPI.Comm", stop: StopRequest) -> int:
    """Print versions, MPI, HDF5 and ranks, and faults with their remedies."""
    text, is_healthy = doctor_table(comm)
    echo(comm, text)
    if not is_healthy:
        return BAD_INPUT
    if options.compile:
        compile_now(comm)
    return DONE


def compile_now(comm: "MPI.Comm") -> None:
    """Compile missing kernels, and print the time that this took; all ranks must call it."""
    # Imported here: what it loads may be what is missing.
    from vipetsc.studies.first_calls import compile_kernels

    begin = time.monotonic()
    compile_kernels(comm)
    echo(comm, f"kernels of runs, modes and measures: compiled and called in {duration(time.monotonic() - begin)}")


def doctor_table(comm: "MPI.Comm") -> tuple[str, bool]:
    """Return the versions and checks as a table, and whether the program can work here; all ranks must call it."""
    results = checks(comm)
    names = {check.name for check in results}
    about = {name.replace("_version", ""): str(value) for name, value in provenance(comm).items()}
    rows = [(name, value) for name, value in about.items() if name not in names]
    rows += [(check.name, check.text) for check in results]
    # All ranks build the table, which rank 0 alone prints: gathering the hosts is collective.
    from mpi4py import MPI

    hosts = comm.allgather(MPI.Get_processor_name())
    rows.append(("hosts", ", ".join(f"{host} x{hosts.count(host)}" for host in sorted(set(hosts)))))

    # From all ranks, since what is installed may differ from host to host.
    by_rank = comm.allgather([check.name for check in results if check.fault])
    faults = sorted(set().union(*by_rank))
    if faults:
        ranks = [str(rank) for rank, names_of_rank in enumerate(by_rank) if names_of_rank]
        verdict = f"the program cannot run here: {', '.join(faults)} on rank {', '.join(ranks)}"
    else:
        verdict = "no problems"
    return f"{table(rows)}\n{verdict}", not faults


COMPILE = argument(
    "--compile", action="store_true", help="compile the kernels now instead of in the first run; faster under mpirun"
)

VERB = PlainVerb(
    name="doctor",
    text="print versions, and report missing or unsuitable packages",
    example="doctor --compile",
    arguments=(COMPILE,),
    function=doctor,
    is_answer=True,
)
