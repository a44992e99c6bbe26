"""The kinds of branch files: orbits, motions by harmonic balance, responses; their attribute ``branch_kind`` names it.

All readers use `branch_kind`; ``vipetsc.modes.branches``, which has the format of the files, writes the attribute. The
readers are in this room because figures, which read branches, do not load PETSc.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from vipetsc.io.netcdf import root_attributes

ORBITS = "orbits"
"""Periodic orbits by shooting: of a reduced system, or of a whole lattice."""

BALANCE = "balance"
"""Periodic motions by harmonic balance, the lattice condensed onto its contacts."""

RESPONSES = "responses"
"""Steady states under a harmonic drive (nonlinear frequency response)."""

CHOSEN = "chosen"
"""Kind of points at values that the case asks for, whose names in files are ``quantity@value``."""

DAMPED = "damped"
"""Damped modes: frequency and damping ratio over the energy."""

DOWN = "-down"
"""Ending of the name of a branch that is followed towards smaller energies, beside the one towards larger ones."""

BRANCH_KINDS = (ORBITS, BALANCE, RESPONSES, DAMPED)


def kind_of_file(path: Path, needs: Sequence[str] = ()) -> str:
    """Return the kind of the branch in the file ``path``, one of ``BRANCH_KINDS``; raise ValueError for any other.

    ``needs`` and further errors are those of ``open_netcdf``.
    """
    kind = root_attributes(path, "branch", ("branch_kind", *needs))["branch_kind"]
    if kind not in BRANCH_KINDS:
        raise ValueError(f"branch_kind = {kind!r} is not one of {', '.join(BRANCH_KINDS)}: written by a later version?")
    return str(kind)


def kind_names(branch: xr.Dataset) -> np.ndarray:
    """Return the kind (point,) of each point of a branch file; "chosen" of points at values that the case asks for."""
    names = [name if "@" not in name else CHOSEN for name in branch["kind"].attrs["flag_meanings"].split()]
    return np.array(names)[branch["kind"].values]
