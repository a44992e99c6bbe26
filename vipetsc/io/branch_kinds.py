"""The kinds of branch files: orbits, condensed motions, responses; the attribute ``branch_kind`` of a file names it.

All readers use `branch_kind`; ``vipetsc.modes.branches``, which has the format of the files, writes the attribute. This
module is not there but here because figures, which read branches, do not load PETSc.
"""

import xarray as xr

ORBITS = "orbits"
"""Periodic orbits by shooting: of a reduced system, or of a whole lattice."""

CONDENSED = "condensed"
"""Periodic motions by harmonic balance, the lattice condensed onto its contacts."""

RESPONSES = "responses"
"""Steady states under a harmonic drive (nonlinear frequency response)."""

BRANCH_KINDS = (ORBITS, CONDENSED, RESPONSES)


def branch_kind(branch: xr.Dataset) -> str:
    """Return the kind of an open branch file, one of ``BRANCH_KINDS``; raise ValueError for any other.

    Files written before the attribute existed are recognised by variables that only their kind has.
    """
    kind = branch.attrs.get("branch_kind")
    if kind is None:
        return _kind_by_variables(branch)
    if kind not in BRANCH_KINDS:
        raise ValueError(f"branch_kind = {kind!r} is not one of {', '.join(BRANCH_KINDS)}: written by a later version?")
    return str(kind)


def _kind_by_variables(branch: xr.Dataset) -> str:
    """Return the kind of a file without the attribute, by variables that only that kind has."""
    # Responses come first because they have harmonics, too.
    if "share" in branch:
        return RESPONSES
    if "harmonics" in branch:
        return CONDENSED
    return ORBITS
