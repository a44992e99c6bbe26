"""The PETSc library of this process, for calls that petsc4py does not offer."""

import ctypes
from typing import Any

from petsc4py import PETSc

import numpy as np


def refused_scalars(scalar: Any = None) -> str | None:
    """Return why a PETSc whose numbers are of the type ``scalar`` cannot be used, or None: kernels read real doubles.

    By default it is the installed one.
    """
    value = np.dtype(scalar or PETSc.ScalarType)
    if value == np.float64:
        return None
    return (
        f"PETSc computes with {value}; real scalars in double precision are needed: Debian's petsc-dev, conda-forge's"
        " petsc=*=real*, or PETSc configured --with-scalar-type=real --with-precision=double"
    )


def petsc_library() -> ctypes.CDLL:
    """Return the PETSc library of petsc4py; compiled code, too, finds its functions once this was called."""
    # The handle of the extension module also finds PETSc's symbols; a library found by name might be another PETSc.
    return ctypes.CDLL(PETSc.__file__, mode=ctypes.RTLD_GLOBAL)
