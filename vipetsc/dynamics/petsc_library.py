"""The PETSc library of this process, for calls that petsc4py does not offer."""

import ctypes

from petsc4py import PETSc


def petsc_library() -> ctypes.CDLL:
    """The PETSc library to which petsc4py is linked."""
    # The handle of the extension module also finds PETSc's symbols; a library found by name might be another PETSc.
    return ctypes.CDLL(PETSc.__file__)
