"""A lattice in motion, on PETSc."""

from vipetsc.dynamics.run import Result, simulate
