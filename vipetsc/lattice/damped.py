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
FINITE = 1e-9  # |lambda| below this, or above its inverse: a wave that does not reach the next cell


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
    """The waves of ``cell`` at real wavenumbers ``kappa`` in rad per cell, from the eigenvalues of the state."""
    kappa = np.asarray(kappa, float)
    d = cell.dofs
    inverse = 1 / np.asarray(cell.masses)[:, None]
    stiffness = inverse * cell.stiffness_matrix(kappa)
    damping = inverse * cell.damping_matrix(kappa)

    # The state is (scale u, u'): displacements and velocities of one size.
    scale = np.sqrt(np.abs(stiffness).sum(axis=-1).max())
    state = np.zeros((*kappa.shape, 2 * d, 2 * d), complex)
    state[..., :d, d:] = scale * np.eye(d)
    state[..., d:, :d] = -stiffness / scale
    state[..., d:, d:] = -damping
    rate, vectors = np.linalg.eig(state)

    # Half of the waves, by Im s from above and then by size, and those sorted by Im s from below.
    order = np.lexsort((np.abs(rate), -rate.imag))[..., :d]
    order = np.take_along_axis(order, np.argsort(np.take_along_axis(rate.imag, order, -1), axis=-1), -1)
    shapes = np.take_along_axis(vectors, order[..., None, :], -1)[..., :d, :]
    return DampedPoint(
        rate=np.take_along_axis(rate, order, -1), vectors=shapes / np.linalg.norm(shapes, axis=-2, keepdims=True)
    )


@lru_cache
def fitted_dashpots(cell: UnitCell, loss: tuple[tuple[int, float], ...]) -> tuple[np.ndarray, np.ndarray]:
    """Dashpots in N s/m to ground (dof,) and parallel to the springs (spring,) that bring bands near to a ``loss``.

    It is given by band (from 1), as twice the damping ratio. A wave phi of omega, phi* M phi = 1, has phi* C phi/omega
    if C is small, which is linear in the dashpots: not negative, they minimise the sum over ``KAPPAS`` and these bands
    of the squared difference over the loss asked, over the mean where none is. Those that ``cell`` has are counted.
    """
    numbers, asked = np.array(loss).T
    bands = numbers.astype(int) - 1
    point = bloch(cell, KAPPAS)

    # What a dashpot of 1 N s/m adds to phi* C phi: |phi|^2 of its mass to ground, |difference|^2 of its spring's ends.
    turn = np.exp(1j * np.multiply.outer(KAPPAS, [s.next_cell for s in cell.springs]))[:, :, None]
    start = point.vectors[:, [s.start for s in cell.springs]]
    end = point.vectors[:, [s.end for s in cell.springs]]
    rows = np.abs(np.concatenate([point.vectors, end * turn - start], axis=1)) ** 2

    scale = np.where(asked > 0, asked, asked.mean() or 1.0)
    rows = np.moveaxis(rows[..., bands] / (point.frequency[:, bands] * scale)[:, None], 1, -1)
    given = [*(cell.grounding or [0.0] * cell.dofs), *(s.damping for s in cell.springs)]
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
    d = cell.dofs
    # The Bloch matrix is inside + B exp(i kappa) + B^T exp(-i kappa): three wavenumbers give its parts.
    kappa = np.array([0.0, np.pi / 2, np.pi])
    zero, quarter, half = cell.stiffness_matrix(kappa) + 1j * omega * cell.damping_matrix(kappa)
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

    flux = omega / 2 * np.imag(factor * np.einsum("dw,de,ew->w", shape.conj(), coupling, shape))
    growth = np.log(np.abs(factor))
    order = np.argsort(np.where(np.abs(growth) < NEUTRAL, -np.sign(flux) * NEUTRAL, growth))
    return Waves(factor=factor[order], shape=shape[:, order], flux=flux[order], coupling=coupling)


def decay_length(cell: UnitCell, omega: float) -> float:
    """Cells in which the wave of ``omega`` (rad/s) that goes farthest decays by 1/e; inf without damping."""
    growth = np.abs(np.log(np.abs(damped_waves(cell, omega).factor)))
    slowest = growth.min()
    return float(1 / slowest) if slowest > NEUTRAL else np.inf


def reflection(chain: Chain, omega: float, cells: int, end: Literal["left", "right"] = "right") -> float:
    """Largest fraction of a wave's energy at ``omega`` (rad/s) that comes back from the last ``cells`` at an ``end``.

    The cells before go on for ever, as the reference cell; the outermost of ``cells`` must be one of them. Incoming
    are waves that do not decay, in a damped cell the one that decays least. NaN in a gap.
    """
    waves = damped_waves(chain.cell, omega)
    half = len(waves.factor) // 2
    towards = slice(0, half)
    back = slice(half, None)
    if end == "left":
        towards, back = back, towards

    # Which of the waves that go towards the section carry energy to it.
    growth = np.abs(np.log(np.abs(waves.factor[towards])))
    flux = np.abs(waves.flux)
    incoming = (growth <= max(growth.min() * (1 + 1e-9), NEUTRAL)) & (flux[towards] > 0)
    if not chain.cell.is_damped:
        incoming &= growth < NEUTRAL
    if not incoming.any():
        return np.nan

    amplitudes = _sent_back(chain, omega, cells, end, waves)
    returned = (flux[back, None] * np.abs(amplitudes) ** 2).sum(axis=0)
    return float((returned[incoming] / flux[towards][incoming]).max())


def _sent_back(chain: Chain, omega: float, cells: int, end: Literal["left", "right"], waves: Waves) -> np.ndarray:
    """Amplitudes (wave back, wave towards) at the cell next to the section of the last ``cells`` at an ``end``.

    Half of the waves go towards the section, the others come back. Unknowns are the section's displacements and these
    amplitudes. Its cells obey the equations of motion; the displacement of the section's first cell must be that of the
    waves, as far as the coupling feels it.
    """
    d = chain.cell.dofs
    half = len(waves.factor) // 2
    size = cells * d
    if end == "right":
        first = chain.cells - cells
        edge = slice(0, d)
        towards = slice(0, half)
        back = slice(half, None)
        coupling = waves.coupling
        step = waves.factor
    else:
        first = 0
        edge = slice(size - d, size)
        towards = slice(half, None)
        back = slice(0, half)
        coupling = waves.coupling.T
        step = waves.factor ** (-1)

    stiffness = chain.stiffness_rows(first, first + cells) + 1j * omega * chain.damping_rows(first, first + cells)
    masses = chain.masses()[first * d : first * d + size]
    matrix = np.zeros((size + half, size + half), complex)
    loads = np.zeros((size + half, half), complex)
    matrix[:size, :size] = stiffness.toarray()[:, first * d : first * d + size] - np.diag(omega**2 * masses)
    matrix[edge, size:] = coupling.T @ waves.shape[:, back]
    loads[edge] = -coupling.T @ waves.shape[:, towards]

    # The coupling has rank ``half``: only its range is compared, in an orthonormal basis.
    ranges = np.linalg.svd(coupling)[0][:, :half].conj().T @ coupling
    inner = ranges @ (waves.shape * step)
    matrix[size:, edge] = ranges
    matrix[size:, size:] = -inner[:, back]
    loads[size:] = inner[:, towards]
    return np.asarray(np.linalg.solve(matrix, loads)[size:])


def absorber(cell: UnitCell, ends: Ends, cells: int, strength: float, before: int = 1) -> Chain:
    """An end of ``cells`` with dashpots to ground, ``strength`` (1/s) x^3 times each mass, and cells ``before`` it.

    x goes from 0 to 1 over the cells, taken in their middles.
    """
    x = np.concatenate([np.zeros(before), (np.arange(cells) + 0.5) / cells])
    present = np.array(cell.grounding or (0.0,) * cell.dofs)
    grounding = np.outer(strength * x**3, cell.masses) + present
    return Chain(cell, cells + before, ends, variation=Variation(grounding=grounding))
