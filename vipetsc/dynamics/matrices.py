"""The lattice's stiffness and mass as PETSc matrices distributed over ranks.

Degrees of freedom are ordered cell by cell; a rank owns the rows of its cells, the same as in ``dynamics.layout``, and
assembles them from the couplings that the stencil of the right-hand side has. A row of the matrix sums K_ij u_j with
the springs' stiffnesses added up on the diagonal, the columns of other ranks last; the stencil sums k (u_j - u_i)
spring by spring: they agree to rounding, and to the last bit where products and sums are exact.
"""

from collections.abc import Sequence

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from scipy.sparse import csr_matrix, diags

from vipetsc.case import CaseError
from vipetsc.case.section import Problem
from vipetsc.dynamics.layout import cell_cuts
from vipetsc.lattice import Chain, contacts
from vipetsc.lattice.elements import joined_stiffness
from vipetsc.parallel import on_every_rank


class LatticeMatrices:
    """``stiffness`` in N/m and ``mass`` in kg of ``chain`` without contacts, on the ranks of ``comm``.

    ``contact_springs`` are stiffnesses in N/m of springs in the place of the contacts, one each, () if there are none:
    for small motions a contact that is pressed at rest is one. This rank has the cells ``start`` to ``stop``; ``size``
    counts all rows, and no squared frequency in (rad/s)^2 is above ``largest`` (Gershgorin's circles of M^-1 K). All
    ranks must call it. Raises CaseError, on all ranks, where PETSc's indices do not count the rows or a rank's entries.
    """

    def __init__(self, chain: Chain, comm: MPI.Comm, contact_springs: Sequence[float] = ()) -> None:
        self.chain = chain
        self.comm = comm
        self.size = chain.cells * chain.cell.dofs
        self.start, self.stop = cell_cuts(chain.cells, comm.size)[comm.rank : comm.rank + 2]
        # Before any assembly: a count beyond the index type would become another number without an error.
        self._check_indices()
        stiffness = on_every_rank(comm, lambda: chain.stiffness_rows(self.start, self.stop))
        first_row = self.start * chain.cell.dofs
        last_row = self.stop * chain.cell.dofs
        by_contacts = np.zeros(last_row - first_row)
        if contact_springs:
            joined = joined_stiffness(contacts(chain), contact_springs, self.size, slice(first_row, last_row))
            by_contacts = joined.diagonal(first_row)
            stiffness = (stiffness + joined).tocsr()
        self.stiffness = self._matrix(stiffness)

        coefficients = chain.coefficients(self.start - 1, self.stop)
        masses = coefficients.masses[1:]
        self.mass = self._matrix(diags([masses.ravel()], [first_row], (masses.size, self.size), format="csr"))

        # A row's circle reaches from 0 to twice the sum of the springs at its mass, of which negative ones only make it
        # smaller.
        owned = self.stop - self.start
        reaches = np.zeros_like(masses)
        for coupling in chain.cell.couplings():
            springs = coefficients.stiffness[1 + min(coupling.offset, 0) :][:owned, coupling.spring]
            reaches[:, coupling.mass] += 2 * np.maximum(springs, 0.0)
        reaches += 2 * by_contacts.reshape(masses.shape)
        self.largest = comm.allreduce(float(np.max(reaches / masses, initial=0.0)), MPI.MAX)

    def _check_indices(self) -> None:
        """Raise CaseError on all ranks where PETSc's indices do not count all rows, or not the entries of a rank."""
        cell = self.chain.cell
        entries = len(cell.couplings()) * 2 * (self.stop - self.start)
        if self.comm.allreduce(max(self.size, entries), MPI.MAX) > int(np.iinfo(PETSc.IntType).max):
            remedy = "more rows or entries than the indices of this PETSc count; it needs one --with-64-bit-indices"
            raise CaseError([Problem("lattice.cells", self.chain.cells, f"makes matrices of {remedy}")])

    def _matrix(self, rows: csr_matrix) -> PETSc.Mat:
        """Return the matrix of which this rank has the ``rows``, allocated for exactly their entries."""
        first_entries = rows.indptr.astype(PETSc.IntType)
        columns = rows.indices.astype(PETSc.IntType)
        return PETSc.Mat().createAIJ((rows.shape, rows.shape), csr=(first_entries, columns, rows.data), comm=self.comm)

    def vector(self, cells: np.ndarray | None = None) -> PETSc.Vec:
        """Return a vector of this rank's ``cells`` (cell, dof), zero if none are given."""
        vector = self.stiffness.createVecRight()
        if cells is not None:
            vector.array[:] = np.ravel(cells)
        return vector

    def destroy(self) -> None:
        """Free the matrices; all ranks must call it."""
        self.stiffness.destroy()
        self.mass.destroy()
