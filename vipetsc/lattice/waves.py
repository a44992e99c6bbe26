r"""Bloch waves at given frequencies, propagating and evanescent, and which way each of them goes.

Time runs as exp(i omega t) and u obeys (K - omega^2 M) u = f. Cells are tied to the next by B = K_{n,n+1} = P Q^T
of rank r, so that all that passes between n - 1 and n is the state v = (Q^T u_n, P^T u_{n-1}) of 2r numbers. In a
stretch without loads v_{n+1} = lambda v_n: with D = K_nn - omega^2 M and any s, H = (D + s P P^T)^-1,

    u_n = -H (P (q - s p) + Q p'),  (q, p) = v_{n+1}, (q', p') = v_n,
    [1, Q^T H Q; 0, P^T H Q] v_n = lambda [-Q^T H P, s Q^T H P; -P^T H P, s P^T H P - 1] v_n.

An imaginary s, a dashpot's, keeps H finite at all frequencies on and below the real axis. Half of the 2r Bloch waves
decay or carry energy to higher cells, half to lower ones (omega stands for omega - i0). At omega = 0 the wave that is a
shift in common has a linear one for its counterpart. Cf. Mead, J. Sound Vib. 27 (1973) 235.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack

from vipetsc.lattice.cell import UnitCell

NEUTRAL = 1e-7  # |log |lambda|| below which a wave's direction is that of its energy


class BlochWaves(NamedTuple):
    """All 2r waves of frequencies ``omega`` (w,): of half the last axis to higher cells, then to lower ones.

    ``factor`` (w, 2r) is lambda, of waves to lower cells 1/lambda: at most one. ``state`` (w, 2r, 2r) holds v = (q, p)
    of a wave in a column, ``slope`` what is added a cell (at omega = 0). ``inner`` (w, dofs, dofs) is H, ``port`` s.
    """

    factor: np.ndarray
    state: np.ndarray
    slope: np.ndarray
    inner: np.ndarray
    port: complex


class Blocks(NamedTuple):
    """Of a cell: ``stiffness`` (dofs, dofs) with all springs; B = ``out`` @ ``into``.T; springs' shares by side."""

    stiffness: np.ndarray
    out: np.ndarray
    into: np.ndarray
    left: np.ndarray
    right: np.ndarray


@lru_cache
def coupling_blocks(cell: UnitCell) -> Blocks:
    """K_nn, the factors P and Q of K_{n,n+1}, and what the springs to the cells before and after add to K_nn."""
    d = cell.dofs
    inside, coupling, left, right = (np.zeros((d, d)) for _ in range(4))
    for mass, offset, other, stiffness, *_ in cell.couplings():
        inside[mass, mass] += stiffness
        (left if offset < 0 else right)[mass, mass] += stiffness * abs(offset)
        (coupling if offset > 0 else inside)[mass, other] -= stiffness * (offset >= 0)
    u, s, vh = np.linalg.svd(coupling)
    rank = int((s > 1e-13 * s[0]).sum())
    root = np.sqrt(s[:rank])
    return Blocks(inside, u[:, :rank] * root, vh[:rank].T * root, left, right)


def bloch_waves(cell: UnitCell, omegas: np.ndarray) -> BlochWaves:
    """The waves at ``omegas`` in rad/s with parts Re >= 0 and Im <= 0."""
    k, p, q, *_ = coupling_blocks(cell)
    r = p.shape[1]
    s = 1j
    dynamic = k - omegas[:, None, None] ** 2 * np.diag(cell.masses)
    inner = np.linalg.inv(dynamic + s * p @ p.T)
    (qq, qp), (pq, pp) = ([a.T @ inner @ b for b in (q, p)] for a in (q, p))
    one = np.broadcast_to(np.eye(r), qq.shape)
    left = np.block([[one, qq], [np.zeros_like(qq), pq]])
    right = np.block([[-qp, s * qp], [-pp, s * pp - one]])
    solved = [lapack.zggev(a, b, compute_vl=0) for a, b in zip(left, right, strict=True)]
    alpha, beta, states = (np.array([answer[n] for answer in solved]) for n in (0, 1, 3))
    states /= np.linalg.norm(states, axis=1, keepdims=True)
    sizes = np.maximum(np.abs([alpha, beta]), 1e-300)
    growth, flux = np.log(sizes[0] / sizes[1]), np.sum(states[:, r:].conj() * states[:, :r], axis=1).imag
    neutral = (np.abs(growth) < NEUTRAL) & (omegas.imag == 0)[:, None]
    order = np.argsort(np.where(neutral, -np.sign(flux) * NEUTRAL, growth), axis=1)
    alpha, beta = (np.take_along_axis(x, order, axis=1) for x in (alpha, beta))
    states = np.take_along_axis(states, order[:, None], axis=2)
    factor = np.concatenate([alpha[:, :r] / beta[:, :r], beta[:, r:] / alpha[:, r:]], axis=1)
    waves = BlochWaves(factor, states, np.zeros_like(states), inner, s)
    for i in np.nonzero(omegas == 0)[0]:
        _make_static(cell, waves, int(i))
    return waves


def _make_static(cell: UnitCell, waves: BlochWaves, i: int) -> None:
    """Put the shift in common and the linear displacement in the place of the double root at omega = 0."""
    k, p, q, *_ = coupling_blocks(cell)
    r, ones = p.shape[1], np.ones(cell.dofs)
    first, second = r - 1, r
    b = p @ q.T
    (shape, *_), shift = (
        np.linalg.lstsq(k + b + b.T, (b.T - b) @ ones, rcond=None),
        np.concatenate([q.T @ ones, p.T @ ones]),
    )
    waves.factor[i, [first, second]] = 1
    waves.state[i, :, first] = shift
    waves.state[i, :, second] = np.concatenate([q.T @ shape, p.T @ (shape - ones)])
    waves.slope[i, :, second] = shift


def between(cell: UnitCell, waves: BlochWaves, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Displacement (dofs,) of a cell between two states (2r,)."""
    _, p, q, *_ = coupling_blocks(cell)
    r = p.shape[1]
    return np.asarray(-waves.inner[0] @ (p @ (after[:r] - waves.port * after[r:]) + q @ before[r:]))


def energy_flux(omega: float, state: np.ndarray) -> float:
    """Energy in W that a ``state`` (2r,) carries to higher cells."""
    r = len(state) // 2
    return float(omega / 2 * np.imag(state[r:].conj() @ state[:r]))
