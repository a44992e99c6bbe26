"""The verb ``doctor``: what an installation has, and what is missing."""

import argparse
import importlib
import shutil
from typing import NamedTuple

from mpi4py import MPI

import h5py
import numpy as np

from vipetsc.case import CaseError
from vipetsc.cli.messages import echo
from vipetsc.cli.tables import table
from vipetsc.cli.verb import DONE, FAILED, PlainVerb
from vipetsc.io.folder import provenance
from vipetsc.parallel import StopRequest

MODULES = ("scipy", "matplotlib", "jinja2", "numba", "pydantic", "tqdm", "tomli_w", "xarray", "h5netcdf", "cma",
           "pymoo")  # fmt: skip


class Check(NamedTuple):
    """Requirement of the program: its version, None if it is missing, and how to get it."""

    name: str
    value: str | None
    remedy: str


def doctor(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """Print versions, MPI, HDF5 and ranks; what is missing and how to get it."""
    text, is_healthy = doctor_table(comm)
    echo(comm, text)
    return DONE if is_healthy else FAILED


def doctor_table(comm: MPI.Comm) -> tuple[str, bool]:
    """The checks as a table, and whether all is well; all ranks must call it."""
    checks = [*needs(comm), *map(check_of_module, MODULES)]
    rows = [(name.replace("_version", ""), str(value)) for name, value in provenance(comm).items()]
    rows += [(check.name, check.value or f"MISSING: {check.remedy}") for check in checks]
    rows += [("native right-hand side", native_right_hand_side()), ("slepc", slepc_version())]
    # Collective, so all ranks build the table although rank 0 alone prints it.
    hosts = comm.allgather(MPI.Get_processor_name())
    rows.append(("hosts", ", ".join(f"{host} x{hosts.count(host)}" for host in sorted(set(hosts)))))

    is_healthy = all(check.value is not None for check in checks)
    verdict = "all is well" if is_healthy else "something is missing, see above"
    return f"{table(rows)}\n{verdict}", is_healthy


def needs(comm: MPI.Comm) -> list[Check]:
    """The checks of PETSc, HDF5 and MPI."""
    from petsc4py import PETSc

    scalar = np.dtype(PETSc.ScalarType)
    parallel: str | None = "under mpirun"  # one rank cannot decide: the MPI build of Debian is loaded there alone
    if comm.size > 1:
        parallel = "yes" if h5py.get_config().mpi else None
    return [
        Check(
            "petsc scalars", str(scalar) if scalar == np.float64 else None, "a real double PETSc (Debian: petsc-dev)"
        ),
        Check(
            "parallel HDF5",
            parallel,
            "the MPI build of h5py (Debian: python3-h5py-mpi; conda-forge: h5py=*=mpi_openmpi*)",
        ),
        Check("mpirun", shutil.which("mpirun"), "apt install openmpi-bin"),
    ]


def check_of_module(module: str) -> Check:
    """The check of a Python module that pip installs."""
    try:
        # Imported, not looked up: a module that is there but does not load is missing.
        version = str(getattr(importlib.import_module(module), "__version__", "yes"))
    except ImportError:
        version = None
    remedy = f"pip install --constraint scripts/constraints.txt {module.replace('_', '-')}"
    return Check(module, version, remedy)


def native_right_hand_side() -> str:
    """Whether PETSc can call the compiled right-hand side."""
    from vipetsc.dynamics.ts.right_hand_side import compile_callback

    try:
        compile_callback()
    # AttributeError: PETSc hides its symbols. OSError: its library cannot be loaded.
    except (AttributeError, OSError) as error:
        return f"no: runs need PETSc's symbols ({error})"
    return "yes"


def slepc_version() -> str:
    """The version of SLEPc, or how to get it: only some verbs need it, so that none is no fault of an installation."""
    from vipetsc.dynamics.eigen import load_slepc

    try:
        return ".".join(map(str, load_slepc().Sys.getVersion()))
    except CaseError as error:
        return f"no: {error.problems[0].remedy}"


VERB = PlainVerb(name="doctor", text="versions and what is missing", example="doctor", function=doctor, is_answer=True)
