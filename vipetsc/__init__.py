"""Waves in phononic lattices whose cells carry vibro-impacts, on PETSc and MPI."""

__version__ = "0.1.0"
