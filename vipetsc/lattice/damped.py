r"""Bloch waves of a cell with dashpots, and the dashpots that give bands a loss.

At a real wavenumber (s^2 M + s C(kappa) + K(kappa)) u = 0 for motion exp(s t): each wave has a damping ratio
-Re s/|s| and decays by 1/e in the time -1/Re s. At a real frequency, motion exp(i omega t) and u_{n+1} = lambda u_n,
the cells obey (B^T/lambda + D + B lambda) u = 0. B is the coupling to the next cell and D the block of a cell itself,
both complex: D + B exp(i kappa) + B^T exp(-i kappa) = K(kappa) + i omega C(kappa) - omega^2 M. A wave decays by 1/e in
1/|log |lambda|| cells. Cf. Mead, J. Sound Vib. 27 (1973) 235.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy.linalg import eig

from vipetsc.lattice.bands import bloch
from vipetsc.lattice.cell import GROUND, UnitCell
from vipetsc.lattice.waves import NEUTRAL

# Wavenumbers at which the loss of bands is fitted. With 30 the bands' mean losses change by 4 to 8 % of those asked,
# with 120 by 2 to 5 %: in the lowest band the loss of a dashpot to ground grows as 1/omega near kappa = 0, so that the
# smallest wavenumber counts much. The fit decides which dashpots a case has: another number here changes them slightly.
KAPPAS = np.pi * (np.arange(60) + 0.5) / 60
# |lambda| below this, or above its inverse: a wave that does not reach the next cell. Those of a singular coupling are
# 0 and infinity to rounding, 1e-15: half and twice as much select the same waves.
FINITE = 1e-9


class DampedPoint(NamedTuple):
    """Damped waves at real wavenumbers: ``rate`` s (..., wave) in 1/s of the motion exp(s t), ``vectors`` of unit norm.

    ``vectors`` is (..., dof, wave). Of each pair of conjugates the one with Im s > 0 is kept, lowest first; of real
    rates, which are overdamped, the slowest.
    """

    rate: np.ndarray
    vectors: np.ndarray

    @property
    def ratio(self) -> np.ndarray:
        """Damping ratio (..., wave); 0 of a wave at rest."""
        size = np.abs(self.rate)
        return np.divide(-self.rate.real, size, out=np.zeros_like(size), where=size > 0)


def damped_bloch(cell: UnitCell, kappa: ArrayLike) -> DampedPoint:
    """Return waves of ``cell`` at real wavenumbers ``kappa`` (...) in rad per cell, from the state's eigenvalues."""
    kappa = np.asarray(kappa, float)
    d = cell.dofs
    inverse = 1 / np.asarray(cell.masses)[:, None]
    stiffness = inverse * cell.stiffness_matrix(kappa)
    damping = inverse * cell.damping_matrix(kappa)

    # The state is (scale u, u'): displacements and velocities of one size. The stiffness of a cell of one mass vanishes
    # at kappa = 0: dashpots give the scale then, and without them any will do.
    scale = np.sqrt(np.abs(stiffness).sum(axis=-1).max()) or np.abs(damping).sum(axis=-1).max() or 1.0
    state = np.zeros((*kappa.shape, 2 * d, 2 * d), complex)
    state[..., :d, d:] = scale * np.eye(d)
    state[..., d:, :d] = -stiffness / scale
    state[..., d:, d:] = -damping
    rate, vectors = np.linalg.eig(state)

    # The half of the waves with the largest Im s, of equal ones the slowest; then these with Im s rising.
    order = np.lexsort((np.abs(rate), -rate.imag))[..., :d]
    order = np.take_along_axis(order, np.argsort(np.take_along_axis(rate.imag, order, -1), axis=-1), -1)
    shapes = np.take_along_axis(vectors, order[..., None, :], -1)[..., :d, :]
    return DampedPoint(
        rate=np.take_along_axis(rate, order, -1), vectors=shapes / np.linalg.norm(shapes, axis=-2, keepdims=True)
    )


@lru_cache
def fitted_dashpots(cell: UnitCell, loss: tuple[tuple[int, float], ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return dashpots in N s/m to ground (dof,) and along springs (spring,) that bring bands near to a ``loss``.

    ``loss`` has pairs of a band (from 1) and the loss asked of it, twice the damping ratio. A wave phi of frequency
    omega, phi* M phi = 1, has the loss phi* C phi/omega if C is small, which is linear in the dashpots. They are not
    negative and minimise the sum, over ``KAPPAS`` and these bands, of ((loss - asked)/scale)^2, where the scale is the
    loss asked, or the mean of all where a band is asked to have none. The dashpots of ``cell`` count and remain: those
    returned are in addition.
    """
    numbers, asked = np.array(loss).T
    bands = numbers.astype(int) - 1
    point = bloch(cell, KAPPAS)

    # What a dashpot of 1 N s/m adds to phi* C phi: |phi|^2 of its mass to ground, |difference|^2 of its spring's ends.
    turn = np.exp(1j * np.multiply.outer(KAPPAS, [s.offset for s in cell.springs]))[:, :, None]
    held = np.array([s.start == GROUND for s in cell.springs], bool)
    start = np.where(held[:, None], 0.0, point.vectors[:, [s.start for s in cell.springs]])
    end = point.vectors[:, [s.end for s in cell.springs]]
    rows = np.abs(np.concatenate([point.vectors, end * turn - start], axis=1)) ** 2

    scale = np.where(asked > 0, asked, asked.mean() or 1.0)
    rows = np.moveaxis(rows[..., bands] / (point.frequency[:, bands] * scale)[:, None], 1, -1)
    given = [*(cell.grounding or [0.0] * cell.dofs), *(s.damping for s in cell.springs)]
    fitted = scipy.optimize.nnls(rows.reshape(-1, len(given)), (asked / scale - rows @ given).ravel())[0]
    return fitted[: cell.dofs], fitted[cell.dofs :]


class Waves(NamedTuple):
    """All waves of a cell at a real frequency; those that decay or carry energy to higher cells come first.

    ``factor`` lambda (wave,), ``shape`` (dof, wave), ``flux`` in W to higher cells, and the matrices of the equation of
    motion, ``dynamic`` D and ``coupling`` B.
    """

    factor: np.ndarray
    shape: np.ndarray
    flux: np.ndarray
    dynamic: np.ndarray
    coupling: np.ndarray


@lru_cache
def _three_matrices(cell: UnitCell) -> tuple[np.ndarray, np.ndarray]:
    """Return Bloch stiffness and damping (wavenumber, dof, dof) at three wavenumbers.

    D + B exp(i kappa) + B^T exp(-i kappa) has three parts, which three values determine.
    """
    kappa = np.array([0.0, np.pi / 2, np.pi])
    return cell.stiffness_matrix(kappa), cell.damping_matrix(kappa)


def damped_waves(cell: UnitCell, omega: float) -> Waves:
    """Return the waves of ``cell`` at the real frequency ``omega`` in rad/s: lambda, shapes and flux of each."""
    d = cell.dofs
    stiffness, damping = _three_matrices(cell)
    zero, quarter, half = stiffness + 1j * omega * damping
    inside = (zero + half) / 2
    coupling = ((zero - half) / 2 - 1j * (quarter - inside)) / 2  # of B + B^T and i (B - B^T)
    dynamic = inside - omega**2 * np.diag(cell.masses)

    # Linear eigenvalue problem of (u, lambda u); homogeneous, because B is singular.
    one = np.eye(d)
    none = np.zeros((d, d))
    scale = np.abs(dynamic).max()
    left = np.block([[none, one], [-coupling.T / scale, -dynamic / scale]])
    right = np.block([[one, none], [none, coupling / scale]])
    values, vectors = eig(left, right, homogeneous_eigvals=True)
    finite = np.min(np.abs(values), axis=0) > FINITE * np.max(np.abs(values), axis=0)
    factor = values[0, finite] / values[1, finite]
    shape = vectors[:d, finite]
    shape = shape / np.linalg.norm(shape, axis=0)

    # The mean power that a cell gives to the coupling: -Re(f* v)/2 of the force f = -B lambda u with which the next
    # cell pulls, and v = i omega u.
    flux = omega / 2 * np.imag(factor * np.einsum("dw,de,ew->w", shape.conj(), coupling, shape))
    growth = np.log(np.abs(factor))
    # By growth, those that decay to higher cells first; waves that do not decay are sorted by the sign of their flux.
    order = np.argsort(np.where(np.abs(growth) < NEUTRAL, -np.sign(flux) * NEUTRAL, growth))
    return Waves(factor=factor[order], shape=shape[:, order], flux=flux[order], dynamic=dynamic, coupling=coupling)


def decay_length(cell: UnitCell, omega: float) -> float:
    """Return cells in which the wave of ``omega`` (rad/s) that goes farthest decays by 1/e; inf without damping."""
    growth = np.abs(np.log(np.abs(damped_waves(cell, omega).factor)))
    slowest = growth.min()
    if slowest <= NEUTRAL:
        return np.inf
    return float(1 / slowest)
