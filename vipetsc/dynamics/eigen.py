"""SLEPc, where there is one: everything else runs without it."""

from typing import Any

from vipetsc.case import CaseError
from vipetsc.case.reading import Problem


def load_slepc() -> Any:
    """The module ``slepc4py.SLEPc``, which begins with PETSc's options; raises CaseError where it is missing."""
    try:
        from slepc4py import SLEPc
    except ImportError as error:
        remedy = "is needed for modes of long lattices and multipliers of whole ones, nothing else"
        how = "apt install slepc-dev python3-slepc4py; conda-forge: slepc4py; it must belong to the PETSc of petsc4py"
        raise CaseError([Problem("slepc4py", None, f"{remedy} ({error}); Debian: {how}")], "this machine") from None
    return SLEPc
