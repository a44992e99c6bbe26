"""What an installation has, and what is missing."""

import importlib
import shutil

from mpi4py import MPI

import h5py
import numpy as np

from vipetsc.case import CaseError
from vipetsc.cli.tables import table
from vipetsc.io.folder import provenance

MODULES = ("scipy", "matplotlib", "jinja2", "numba", "pydantic", "tqdm", "tomli_w", "xarray", "h5netcdf", "cma",
           "pymoo")  # fmt: skip


def doctor_table(comm: MPI.Comm) -> tuple[str, bool]:
    """The checks as a table, and whether all is well; all ranks must call it."""
    from petsc4py import PETSc

    from vipetsc.dynamics.eigen import load_slepc
    from vipetsc.dynamics.ts.right_hand_side import compile_callback

    scalar = np.dtype(PETSc.ScalarType)
    parallel = "yes" if comm.size > 1 else "under mpirun"
    # Name, value (None if it is missing), remedy.
    checks = [
        ("petsc scalars", str(scalar) if scalar == np.float64 else None, "a real double PETSc (Debian: petsc-dev)"),
        ("parallel HDF5", parallel if comm.size == 1 or h5py.get_config().mpi else None,
         "the MPI build of h5py (Debian: python3-h5py-mpi; conda-forge: h5py=*=mpi_openmpi*)"),
        ("mpirun", shutil.which("mpirun"), "apt install openmpi-bin"),
    ]  # fmt: skip
    for module in MODULES:
        try:
            version = str(getattr(importlib.import_module(module), "__version__", "yes"))
        except ImportError:
            version = None
        remedy = f"pip install --constraint scripts/constraints.txt {module.replace('_', '-')}"
        checks.append((module, version, remedy))
    rows = [(name.replace("_version", ""), str(value)) for name, value in provenance(comm).items()]
    rows += [(name, f"MISSING: {remedy}" if value is None else value) for name, value, remedy in checks]
    try:
        compile_callback()
        rows.append(("native right-hand side", "yes"))
    except (AttributeError, OSError) as error:
        rows.append(("native right-hand side", f"no: runs need PETSc's symbols ({error})"))
    try:
        rows.append(("slepc", ".".join(map(str, load_slepc().Sys.getVersion()))))
    except CaseError as error:
        rows.append(("slepc", f"no: {error.problems[0].remedy}"))
    hosts = comm.allgather(MPI.Get_processor_name())
    rows.append(("hosts", ", ".join(f"{host} x{hosts.count(host)}" for host in sorted(set(hosts)))))
    healthy = all(value is not None for _, value, _ in checks)
    verdict = "all is well" if healthy else "something is missing, see above"
    return f"{table(rows)}\n{verdict}", healthy
