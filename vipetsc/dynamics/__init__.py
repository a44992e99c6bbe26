"""A lattice in motion, on PETSc."""

from vipetsc.dynamics.simulate import Result, simulate

__all__ = ["Result", "simulate"]
