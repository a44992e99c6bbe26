r"""Bloch waves at given frequencies, propagating and evanescent, and the direction of each.

Time runs as exp(i omega t) and u obeys (K - omega^2 M) u = f. Cells are tied to the next by B = K_{n,n+1} = P Q^T
of rank r, so that all that passes between n - 1 and n is the state v = (Q^T u_n, P^T u_{n-1}) of 2r numbers. In a
stretch without loads v_{n+1} = lambda v_n: with D = K_nn - omega^2 M and any s, H = (D + s P P^T)^-1,

    u_n = -H (P (q - s p) + Q p'),  (q, p) = v_{n+1}, (q', p') = v_n,
    [1, Q^T H Q; 0, P^T H Q] v_n = lambda [-Q^T H P, s Q^T H P; -P^T H P, s P^T H P - 1] v_n.

An imaginary s, as a dashpot's, keeps H finite at all frequencies on and below the real axis. Half of the 2r Bloch waves
decay or carry energy to higher cells, half to lower ones (omega stands for omega - i0). At omega = 0 the rigid
translation is a double root lambda = 1, and its second solution grows linearly with n. Cf. Mead, J. Sound Vib. 27
(1973) 235.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack

from vipetsc.lattice.cell import GROUND, UnitCell

# |log |lambda|| below which a wave's direction is that of its energy: the root of rounding, by which the double
# |lambda| = 1 at a band's edge is off. 5e-8 to 1e-5 sort the waves of the four-band cell alike.
NEUTRAL = 1e-7
PORT = 1j  # s of the module's docstring, for which any imaginary number serves
RANK = 1e-13  # singular values of B below this fraction of the largest are rounding


class BlochWaves(NamedTuple):
    """All 2r waves at each of some frequencies (w,): the first r of the last axis go to higher cells, r to lower ones.

    ``factor`` (w, 2r) is lambda, of waves to lower cells 1/lambda: at most one. ``state`` (w, 2r, 2r) holds v = (q, p)
    of a wave in a column. ``slope``, of the same shape, is what the state of the linear solution at omega = 0 gains
    from one cell to the next; 0 of all other waves. ``inner`` (w, dofs, dofs) is H, ``port`` s.
    """

    factor: np.ndarray
    state: np.ndarray
    slope: np.ndarray
    inner: np.ndarray
    port: complex


class Blocks(NamedTuple):
    """Stiffness matrices of a cell in N/m: the diagonal block K_nn, and the factors of K_{n,n+1}.

    ``stiffness`` (dofs, dofs) is K_nn with all springs, B = ``out`` @ ``into``.T with the factors P and Q (dofs, r).
    ``left`` and ``right`` (dofs, dofs) are what the springs to the cells before and after add to K_nn.
    """

    stiffness: np.ndarray
    out: np.ndarray
    into: np.ndarray
    left: np.ndarray
    right: np.ndarray


@lru_cache
def coupling_blocks(cell: UnitCell) -> Blocks:
    """Return the blocks of an interior cell; r is the rank of the coupling to the next one."""
    inside = np.zeros((cell.dofs, cell.dofs))
    coupling = np.zeros_like(inside)
    left = np.zeros_like(inside)
    right = np.zeros_like(inside)
    for mass, offset, other, stiffness, *_ in cell.couplings():
        inside[mass, mass] += stiffness
        if other == GROUND:
            continue
        if offset == 0:
            inside[mass, other] -= stiffness
        elif offset > 0:
            coupling[mass, other] -= stiffness
            right[mass, mass] += stiffness
        else:
            left[mass, mass] += stiffness

    u, s, vh = np.linalg.svd(coupling)
    rank = int((s > RANK * s[0]).sum())
    root = np.sqrt(s[:rank])
    return Blocks(stiffness=inside, out=u[:, :rank] * root, into=vh[:rank].T * root, left=left, right=right)


def bloch_waves(cell: UnitCell, omegas: np.ndarray) -> BlochWaves:
    """Return the waves at ``omegas`` (frequency,) in rad/s with parts Re >= 0 and Im <= 0."""
    blocks = coupling_blocks(cell)
    p = blocks.out
    q = blocks.into
    r = p.shape[1]
    dynamic = blocks.stiffness - omegas[:, None, None] ** 2 * np.diag(cell.masses)
    inner = np.linalg.inv(dynamic + PORT * p @ p.T)

    # The eigenvalue problem of the states, as in the module's docstring.
    qq = q.T @ inner @ q
    qp = q.T @ inner @ p
    pq = p.T @ inner @ q
    pp = p.T @ inner @ p
    one = np.broadcast_to(np.eye(r), qq.shape)
    left = np.block([[one, qq], [np.zeros_like(qq), pq]])
    right = np.block([[-qp, PORT * qp], [-pp, PORT * pp - one]])
    # Eigenvalues as fractions alpha/beta: lambda is 0 or infinite for waves that do not reach the next cell. LAPACK's
    # routine returns alpha, beta, left vectors, right vectors and its status.
    solutions = [lapack.zggev(a, b, compute_vl=0) for a, b in zip(left, right, strict=True)]
    alpha = np.array([solution[0] for solution in solutions])
    beta = np.array([solution[1] for solution in solutions])
    states = np.array([solution[3] for solution in solutions])
    states /= np.linalg.norm(states, axis=1, keepdims=True)

    # Waves to higher cells first: those that decay, and of those that do not, which carry energy there.
    sizes = np.maximum(np.abs([alpha, beta]), 1e-300)
    growth = np.log(sizes[0] / sizes[1])
    flux = np.sum(states[:, r:].conj() * states[:, :r], axis=1).imag
    neutral = (np.abs(growth) < NEUTRAL) & (omegas.imag == 0)[:, None]
    order = np.argsort(np.where(neutral, -np.sign(flux) * NEUTRAL, growth), axis=1)
    alpha = np.take_along_axis(alpha, order, axis=1)
    beta = np.take_along_axis(beta, order, axis=1)
    states = np.take_along_axis(states, order[:, None], axis=2)

    factor = np.concatenate([alpha[:, :r] / beta[:, :r], beta[:, r:] / alpha[:, r:]], axis=1)
    waves = BlochWaves(factor=factor, state=states, slope=np.zeros_like(states), inner=inner, port=PORT)
    for i in np.nonzero(omegas == 0)[0]:
        _make_static(cell, waves, int(i))
    return waves


def _make_static(cell: UnitCell, waves: BlochWaves, i: int) -> None:
    """Put the rigid translation and the linear displacement in the place of the double root at omega = 0."""
    blocks = coupling_blocks(cell)
    p = blocks.out
    q = blocks.into
    coupling = p @ q.T
    ones = np.ones(cell.dofs)

    translation = np.concatenate([q.T @ ones, p.T @ ones])
    # The shape of the linear displacement within a cell, u_n = n + shape, to which any constant may be added.
    shape = np.linalg.lstsq(blocks.stiffness + coupling + coupling.T, (coupling.T - coupling) @ ones, rcond=None)[0]

    # Sorted by growth, the double root is the last wave to higher cells and the first one to lower cells.
    first = p.shape[1] - 1
    second = p.shape[1]
    waves.factor[i, [first, second]] = 1
    waves.state[i, :, first] = translation
    waves.state[i, :, second] = np.concatenate([q.T @ shape, p.T @ (shape - ones)])
    waves.slope[i, :, second] = translation


def cell_between(cell: UnitCell, waves: BlochWaves, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the displacement (dofs,) of a cell between two states (2r,), at the first frequency of ``waves``."""
    blocks = coupling_blocks(cell)
    r = blocks.out.shape[1]
    pull = blocks.out @ (after[:r] - waves.port * after[r:]) + blocks.into @ before[r:]
    return np.asarray(-waves.inner[0] @ pull)


def energy_flux(omega: float, state: np.ndarray) -> float:
    """Return the energy in W that a ``state`` (2r,) carries to higher cells at ``omega`` in rad/s."""
    r = len(state) // 2
    return float(omega / 2 * np.imag(state[r:].conj() @ state[:r]))
