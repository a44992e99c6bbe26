"""A lattice in motion, on PETSc."""
