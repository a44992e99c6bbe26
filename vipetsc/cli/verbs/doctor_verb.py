"""The verb ``doctor``: what an installation has, and what is missing."""

import argparse

from mpi4py import MPI

from vipetsc.cli.installation import checks
from vipetsc.cli.messages import echo
from vipetsc.cli.tables import table
from vipetsc.cli.verb import BAD_INPUT, DONE, PlainVerb
from vipetsc.io.folder import provenance
from vipetsc.parallel import StopRequest


def doctor(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """Print versions, MPI, HDF5 and ranks; what the program cannot work with, and how to get it."""
    text, is_healthy = doctor_table(comm)
    echo(comm, text)
    return DONE if is_healthy else BAD_INPUT


def doctor_table(comm: MPI.Comm) -> tuple[str, bool]:
    """The checks as a table, and whether the program can work here; all ranks must call it."""
    results = checks(comm)
    names = {check.name for check in results}
    about = {name.replace("_version", ""): str(value) for name, value in provenance(comm).items()}
    rows = [(name, value) for name, value in about.items() if name not in names]
    rows += [(check.name, check.text) for check in results]
    # Collective, so all ranks build the table although rank 0 alone prints it.
    hosts = comm.allgather(MPI.Get_processor_name())
    rows.append(("hosts", ", ".join(f"{host} x{hosts.count(host)}" for host in sorted(set(hosts)))))

    # Hosts may differ.
    by_rank = comm.allgather([check.name for check in results if check.fault])
    faults = sorted(set().union(*by_rank))
    if faults:
        ranks = [str(rank) for rank, names_of_rank in enumerate(by_rank) if names_of_rank]
        verdict = f"the program cannot work here: {', '.join(faults)} on rank {', '.join(ranks)}"
    else:
        verdict = "all is well"
    return f"{table(rows)}\n{verdict}", not faults


VERB = PlainVerb(name="doctor", text="versions and what is missing", example="doctor", function=doctor, is_answer=True)
