r"""Bloch waves of a cell with dashpots, and what an end sends back.

At a real wavenumber (s^2 M + s C(kappa) + K(kappa)) u = 0 for motion exp(s t): each wave has a damping ratio
-Re s/|s| and decays by 1/e in -1/Re s. At a real frequency, motion exp(i omega t), the cells obey
(B^T/lambda + D + B lambda) u = 0 with u_{n+1} = lambda u_n, D + B + B^T = K(0) + i omega C(0) - omega^2 M and B the
coupling to the next cell: a wave decays by 1/e in 1/|log |lambda|| cells. Cf. Mead, J. Sound Vib. 27 (1973) 235.
"""

from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import eig
from scipy.optimize import nnls

from vipetsc.lattice.bands import bloch
from vipetsc.lattice.cell import UnitCell
from vipetsc.lattice.chain import Chain, Ends
from vipetsc.lattice.variation import Variation
from vipetsc.lattice.waves import NEUTRAL

KAPPAS = np.pi * (np.arange(60) + 0.5) / 60  # wavenumbers at which the loss of bands is fitted


class DampedPoint(NamedTuple):
    """``rate`` s (..., wave) in 1/s of the motion exp(s t), ``vectors`` (..., dof, wave) of unit norm.

    Of each pair of conjugates the one with Im s > 0, lowest first. Of real ones, which are overdamped, the slowest.
    """

    rate: np.ndarray
    vectors: np.ndarray

    @property
    def ratio(self) -> np.ndarray:
        """Damping ratio (..., wave); 0 of a wave at rest."""
        size = np.abs(self.rate)
        return np.divide(-self.rate.real, size, out=np.zeros_like(size), where=size > 0)


def damped_bloch(cell: UnitCell, kappa: ArrayLike) -> DampedPoint:
    """The waves of ``cell`` at real wavenumbers ``kappa`` in rad per cell, from the eigenvalues of the state."""
    kappa, d = np.asarray(kappa, float), cell.dofs
    inverse = 1 / np.asarray(cell.masses)[:, None]
    k, c = (inverse * matrix(kappa) for matrix in (cell.stiffness_matrix, cell.damping_matrix))
    scale = np.sqrt(np.abs(k).sum(axis=-1).max())  # displacements and velocities of one size
    state = np.zeros((*kappa.shape, 2 * d, 2 * d), complex)
    state[..., :d, d:] = scale * np.eye(d)
    state[..., d:, :d], state[..., d:, d:] = -k / scale, -c
    rate, vectors = np.linalg.eig(state)
    order = np.lexsort((np.abs(rate), -rate.imag))[..., :d]
    order = np.take_along_axis(order, np.argsort(np.take_along_axis(rate.imag, order, -1), axis=-1), -1)
    shapes = np.take_along_axis(vectors, order[..., None, :], -1)[..., :d, :]
    return DampedPoint(np.take_along_axis(rate, order, -1), shapes / np.linalg.norm(shapes, axis=-2, keepdims=True))


@lru_cache
def fitted_dashpots(cell: UnitCell, loss: tuple[tuple[int, float], ...]) -> tuple[np.ndarray, np.ndarray]:
    """Dashpots in N s/m to ground (dof,) and beside the springs (spring,) that bring bands near to a ``loss``.

    It is given by band (from 1), as twice the damping ratio. A wave phi of omega, phi* M phi = 1, has phi* C phi/omega
    if C is small, which is linear in the dashpots: not negative, they minimise the sum over ``KAPPAS`` and these bands
    of the squared difference over the loss asked, over the mean where none is. Those that ``cell`` has are counted.
    """
    bands, asked = np.array(loss).T
    point, springs, bands = bloch(cell, KAPPAS), cell.springs, bands.astype(int) - 1
    turn = np.exp(1j * np.multiply.outer(KAPPAS, [s.next_cell for s in springs]))[:, :, None]
    first, second = (point.vectors[:, [getattr(s, end) for s in springs]] for end in ("start", "end"))
    rows = np.abs(np.concatenate([point.vectors, second * turn - first], axis=1)) ** 2
    scale = np.where(asked > 0, asked, asked.mean() or 1.0)
    rows = np.moveaxis(rows[..., bands] / (point.frequency[:, bands] * scale)[:, None], 1, -1)
    given = [*(cell.grounding or [0.0] * cell.dofs), *(s.damping for s in springs)]
    fitted = nnls(rows.reshape(-1, len(given)), (asked / scale - rows @ given).ravel())[0]
    return fitted[: cell.dofs], fitted[cell.dofs :]


class Waves(NamedTuple):
    """All waves of a cell at a real frequency; those that decay or carry energy to higher cells come first.

    ``factor`` lambda (wave,), ``shape`` (dof, wave), ``flux`` in W to higher cells, and ``coupling`` B.
    """

    factor: np.ndarray
    shape: np.ndarray
    flux: np.ndarray
    coupling: np.ndarray


def damped_waves(cell: UnitCell, omega: float) -> Waves:
    """The waves at ``omega`` in rad/s."""
    d, kappa = cell.dofs, np.array([0.0, np.pi / 2, np.pi])
    zero, quarter, half = cell.stiffness_matrix(kappa) + 1j * omega * cell.damping_matrix(kappa)
    inside = (zero + half) / 2
    b = ((zero - half) / 2 - 1j * (quarter - inside)) / 2  # of B + B^T and i (B - B^T)
    dynamic = inside - omega**2 * np.diag(cell.masses)
    one, none = np.eye(d), np.zeros((d, d))
    scale = np.abs(dynamic).max()
    left = np.block([[none, one], [-b.T / scale, -dynamic / scale]])
    values, vectors = eig(left, np.block([[one, none], [none, b / scale]]), homogeneous_eigvals=True)
    finite = np.min(np.abs(values), axis=0) > 1e-9 * np.max(np.abs(values), axis=0)
    factor, shape = values[0, finite] / values[1, finite], vectors[:d, finite]
    shape = shape / np.linalg.norm(shape, axis=0)
    flux = omega / 2 * np.imag(factor * np.einsum("dw,de,ew->w", shape.conj(), b, shape))
    growth = np.log(np.abs(factor))
    order = np.argsort(np.where(np.abs(growth) < NEUTRAL, -np.sign(flux) * NEUTRAL, growth))
    return Waves(factor[order], shape[:, order], flux[order], b)


def decay_length(cell: UnitCell, omega: float) -> float:
    """Cells in which the wave of ``omega`` (rad/s) that goes farthest decays by 1/e; inf without damping."""
    growth = np.abs(np.log(np.abs(damped_waves(cell, omega).factor)))
    return float(1 / growth.min()) if growth.min() > NEUTRAL else np.inf


def reflection(chain: Chain, omega: float, cells: int, end: Literal["left", "right"] = "right") -> float:
    """Largest share of the energy of a wave of ``omega`` (rad/s) that comes back from the last ``cells`` at an ``end``.

    The cells before go on for ever, as the reference cell; the outermost of ``cells`` must be one of them. Incoming
    are waves that do not decay, in a damped cell the one that decays least. NaN in a gap.
    """
    d, n, waves = chain.cell.dofs, chain.cells, damped_waves(chain.cell, omega)
    r, size, right = len(waves.factor) // 2, cells * chain.cell.dofs, end == "right"
    a, b = ((n - cells) * d, n * d) if right else (0, size)
    rows = chain.stiffness_rows(a // d, b // d) + 1j * omega * chain.damping_rows(a // d, b // d)
    # Amplitudes count from the cell beside the section: half of the waves go towards it, the others come back.
    towards, back = (slice(0, r), slice(r, None)) if right else (slice(r, None), slice(0, r))
    edge = slice(0, d) if right else slice(size - d, size)
    coupling, beside = (waves.coupling if right else waves.coupling.T), waves.factor ** (1 if right else -1)
    ranges = np.linalg.svd(coupling)[0][:, :r].conj().T @ coupling
    matrix, loads = np.zeros((size + r, size + r), complex), np.zeros((size + r, r), complex)
    matrix[:size, :size] = rows.toarray()[:, a:b] - np.diag(omega**2 * chain.masses()[a:b])
    matrix[edge, size:], loads[edge] = coupling.T @ waves.shape[:, back], -coupling.T @ waves.shape[:, towards]
    inner = ranges @ (waves.shape * beside)
    matrix[size:, edge], matrix[size:, size:], loads[size:] = ranges, -inner[:, back], inner[:, towards]
    amplitudes = np.linalg.solve(matrix, loads)[size:]
    growth, flux = np.abs(np.log(np.abs(waves.factor[towards]))), np.abs(waves.flux)
    comes = (growth <= max(growth.min() * (1 + 1e-9), NEUTRAL)) & (flux[towards] > 0)
    if not chain.cell.is_damped:
        comes &= growth < NEUTRAL
    shares = (flux[back, None] * np.abs(amplitudes) ** 2).sum(axis=0)[comes] / flux[towards][comes]
    return float(shares.max()) if comes.any() else np.nan


def absorber(cell: UnitCell, ends: Ends, cells: int, strength: float, before: int = 1) -> Chain:
    """An end of ``cells`` with dashpots to ground, ``strength`` (1/s) x^3 times each mass, and cells ``before`` it.

    x goes from 0 to 1 over the cells, taken in their middles.
    """
    x = np.concatenate([np.zeros(before), (np.arange(cells) + 0.5) / cells])
    grounding = np.outer(strength * x**3, cell.masses) + np.array(cell.grounding or (0.0,) * cell.dofs)
    return Chain(cell, cells + before, ends, variation=Variation(grounding=grounding))
