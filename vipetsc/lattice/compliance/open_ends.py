r"""Compliance of a finite lattice that goes on for ever beyond one end or both: such ends reflect nothing.

Beyond the end the cells are as the reference cell, with its dashpots. The half lattice there is condensed onto its
first cell, Z, by elimination of every other cell (Lopez Sancho et al., J. Phys. F 15 (1985) 851), which doubles its
length in each step:

    g = e^-1,   s <- s - a g b,   e <- e - a g b - b g a,   a <- -a g a,   b <- -b g b,

from e = s = K_nn + i omega C_nn - omega^2 M, a = B, b = B^T with the coupling B to the next cell outwards. Here e is
the stiffness of a cell inside and s that of the first one, a and b couple it outwards and back; s becomes Z. The half
lattice adds the dynamic stiffness S = -B Z^-1 B^T to the last cell of the finite part. With the compliance G of the
finite part alone (its modes), and e in an index for the masses of that last cell, f and g for any others, that of the
whole is

    G_fg - G_fe S (1 + G_ee S)^-1 G_eg.

Frequencies have a small negative imaginary part: motions grow slowly from rest, so that waves go outwards.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.lattice.chain import Chain
from vipetsc.lattice.compliance.by_modes import ModalCompliance

# Imaginary part of a frequency over its size, at least. Waves then decay over 1e10 radians, and compliances change in
# proportion: by 1e-7 of the largest for twice as much, near the edge of a band.
DECAY = 1e-10
# Eliminations at most: 2^MOST cells, which at that decay no wave comes through. With 30 the compliance errs by four
# hundredths at the edge of a band, where waves are slow; 120 change nothing. The loop ends earlier where the coupling
# falls below the fraction ``NEGLIGIBLE`` of the stiffness.
MOST = 60
NEGLIGIBLE = 1e-15


@dataclass(frozen=True)
class OpenCompliance(ModalCompliance):
    """The compliance of a ``chain`` that goes on as its reference cell beyond ``open_ends``, as ``ModalCompliance``."""

    open_ends: tuple[str, ...] = ("right",)

    @cached_property
    def slowest(self) -> float:
        """No rate in 1/s: what is not damped leaves, and a lattice without end has no modes of its own."""
        return 0.0

    def response(self, omegas: ArrayLike) -> np.ndarray:
        """Return the motions of ``ChainCompliance.response``; they are complex."""
        omega = self._shifted(omegas)
        loads = self.loads
        ends = self._end_rows
        rows = np.column_stack([loads[:, : self.pairs], ends])
        whole = self._between(omega, rows, np.column_stack([loads, ends]))

        pairs = self.pairs
        count = loads.shape[1]
        # G - G_e S (1 + G_ee S)^-1 G_e: what is beyond the ends acts on the masses of the end cells alone.
        inner = self._inner(omega, whole[:, pairs:, count:])
        correction = whole[:, :pairs, count:] @ inner @ whole[:, pairs:, :count]
        return np.asarray(whole[:, :pairs, :count] - correction)

    def field(self, omega: complex, forces: ArrayLike, cells: ArrayLike) -> np.ndarray:
        """Return the displacement (cells, dofs) in m at ``cells`` (from 0) by ``forces`` as of ``ModalCompliance``."""
        signed = self.signed(forces)
        force = self.loads[:, : len(signed)] @ signed

        dofs = self.chain.cell.dofs
        places = (np.atleast_1d(cells)[:, None] * dofs + np.arange(dofs)).ravel()
        picked = np.eye(len(force))[:, places]
        ends = self._end_rows
        at = self._shifted(omega)
        whole = self._between(at, np.column_stack([picked, ends]), np.column_stack([force, ends]))
        count = len(places)
        inner = self._inner(at, whole[:, count:, 1:])
        u = whole[:, :count, :1] - whole[:, :count, 1:] @ inner @ whole[:, count:, :1]
        return np.asarray(u.reshape(-1, dofs))

    def _shifted(self, omegas: ArrayLike) -> np.ndarray:
        """Return the frequencies (omega,) with an imaginary part below zero."""
        omega = np.atleast_1d(np.asarray(omegas, complex))
        # At omega = 0 its own size would give no decay: a thousandth of the highest frequency stands for it there.
        scale = np.maximum(np.abs(omega), 1e-3 * self._fastest)
        return omega.real + 1j * np.minimum(omega.imag, -DECAY * scale)

    @cached_property
    def _fastest(self) -> float:
        """The size in rad/s of the largest pole of the finite part."""
        return float(np.abs(self._poles.poles).max())

    @cached_property
    def _end_rows(self) -> np.ndarray:
        """Unit loads (dofs, end and mass) on the masses of the last cells at the open ends."""
        d = self.chain.cell.dofs
        first = {"left": 0, "right": (self.chain.cells - 1) * d}
        one = np.eye(self.chain.cells * d)
        return np.hstack([one[:, first[end] : first[end] + d] for end in self.open_ends])

    def _between(self, omega: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return displacements ``rows`` (dofs, i) by loads ``columns`` (dofs, j) of the finite part: (omega, i, j)."""
        poles = self._poles
        gain = 1 / (1j * omega[:, None] - poles.poles)
        out = ((rows.T @ poles.output) * gain[:, None, :]) @ (poles.input @ columns)
        if poles.rigid.size:
            out = out - (rows.T @ poles.rigid) @ (poles.rigid.T @ columns) / omega[:, None, None] ** 2
        return np.asarray(out)

    def _inner(self, omega: np.ndarray, between_ends: np.ndarray) -> np.ndarray:
        """Return S (1 + G_ee S)^-1 (omega, end and mass, end and mass) in N/m."""
        d = self.chain.cell.dofs
        count = d * len(self.open_ends)
        beyond = np.zeros((len(omega), count, count), complex)
        for number, end in enumerate(self.open_ends):
            block = slice(number * d, number * d + d)
            beyond[:, block, block] = beyond_end(self.chain, end, omega)
        return np.asarray(beyond @ np.linalg.inv(np.eye(count) + between_ends @ beyond))


def beyond_end(chain: Chain, end: str, omega: np.ndarray) -> np.ndarray:
    """Return S (omega, dofs, dofs) in N/m of the half lattice beyond an ``end``, at ``omega`` below the real axis.

    It adds to the dynamic stiffness of the last cell of ``chain``, which has a spring to a wall there unless the ends
    are free.
    """
    # Of three reference cells the middle one has its neighbours on both sides.
    d = chain.cell.dofs
    reference = Chain(chain.cell, 3, "fixed")
    w = omega[:, None, None]
    rows = slice(d, 2 * d)
    stiffness = reference.stiffness_matrix().toarray()[rows]
    damping = reference.damping_rows(0, 3).toarray()[rows]
    masses = np.diag(reference.masses()[rows])
    before, same, after = (stiffness[:, i * d : i * d + d] + 1j * w * damping[:, i * d : i * d + d] for i in range(3))
    outwards = before
    inwards = after
    last = slice(0, d)
    if end == "right":
        outwards = after
        inwards = before
        last = slice(2 * d, 3 * d)

    bulk = same - w**2 * masses
    surface = bulk
    out = outwards
    back = inwards
    size = np.abs(bulk).max()
    for _ in range(MOST):
        if max(np.abs(out).max(), np.abs(back).max()) <= NEGLIGIBLE * size:
            break
        inverse = np.linalg.inv(bulk)
        there_and_back = out @ inverse @ back
        surface = surface - there_and_back
        bulk = bulk - there_and_back - back @ inverse @ out
        out = -out @ inverse @ out
        back = -back @ inverse @ back

    added = -outwards @ np.linalg.inv(surface) @ inwards
    if chain.ends == "free":
        # A free end has no spring to the next cell: what a wall spring would add to the last cell.
        alone = Chain(chain.cell, 3, "free")
        cut = reference.stiffness_matrix().toarray()[last, last] - alone.stiffness_matrix().toarray()[last, last]
        lost = reference.damping_rows(0, 3).toarray()[last, last] - alone.damping_rows(0, 3).toarray()[last, last]
        added = added + cut + 1j * w * lost
    return np.asarray(added)
