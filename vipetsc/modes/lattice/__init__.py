"""Shooting and stability of whole lattices on all ranks, without a matrix of the lattice's size.

``lattice_flow`` is the flow and its linearisation, ``krylov`` Newton's method with GMRES for periodic orbits,
``floquet`` their largest multipliers.
"""

from vipetsc.modes.lattice.floquet import largest_multipliers
from vipetsc.modes.lattice.krylov import LatticeShooting
from vipetsc.modes.lattice.lattice_flow import LatticeFlow
