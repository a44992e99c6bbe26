"""The linear modes of a finite lattice, or waves on a ring where modes are too many.

Without contacts M u'' + K u = f. With x = M^(1/2) u and the orthonormal vectors of M^(-1/2) K M^(-1/2) v = Om^2 v the
complex amplitudes z = v*.x' + i Om v*.x obey z' = i Om z + v*.M^(-1/2) f. The energy |z|^2/2 of a mode changes by
forces alone, and the energies of all modes sum to the kinetic energy and that of the springs.

The modes of a ring are Bloch waves, at 2 pi/cells times whole numbers. Beyond ``MOST_DOFS`` a lattice with ends is
taken for a part of a ring: with one more cell, at rest, that is a wall on both sides, and energies sum up; free ends
lack the spring that a ring has between them. A wave that meets an end is seen in other bands too until it has left.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import eigh, eigvals_banded, lapack
from scipy.sparse import csc_matrix, diags

from vipetsc.lattice.bands import bloch
from vipetsc.lattice.chain import Chain
from vipetsc.lattice.drive import Waveform

MOST_DOFS = 4000  # of a lattice with ends whose modes are computed: a square matrix of this size
CLOSE = 1e-3  # modes nearer than this share of the largest Om^2 are made orthogonal one by one
EPS = float(np.finfo(float).eps)
ORTHONORMAL = 2e-13  # error of the norm of any field in all modes up to which they are taken


@dataclass(frozen=True, eq=False)
class Modes:
    """Modes of ``chain``: ``frequency`` (mode) in rad/s, ``wavenumber`` (mode) in rad per cell, ``vectors``.

    Of a lattice with ends ``vectors`` is (cell and dof, mode), and a wavenumber, in [0, pi], is that of the standing
    wave, in a gap its real part. If it is ``exact`` no more, and of a ring, modes are waves on ``cells`` cells with
    vectors (k, dof, band) for k >= 0; positive wavenumbers go to higher cells.
    """

    chain: Chain
    frequency: np.ndarray
    wavenumber: np.ndarray
    vectors: np.ndarray
    exact: bool
    cells: int

    def amplitudes(self, displacement: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Amplitudes z (t, mode) in sqrt(J) of fields (t, cell, dof) in m and m/s."""
        root, nt = np.sqrt(self.chain.cell.masses), len(velocity)
        if self.vectors.ndim == 2:
            root = np.sqrt(self.chain.masses()).reshape(self.chain.cells, -1)
        fields = np.concatenate([velocity * root, displacement * root])
        if self.vectors.ndim == 2:
            parts = fields.reshape(2 * nt, -1) @ self.vectors
            return np.asarray(parts[:nt] + 1j * self.frequency * parts[nt:])
        spectrum = np.fft.rfft(fields, self.cells, axis=1, norm="ortho").swapaxes(0, 1)
        waves = (spectrum @ self.vectors.conj()).swapaxes(0, 1)
        rate, turned = waves[:nt], 1j * self.frequency[: waves[0].size].reshape(waves.shape[1:]) * waves[nt:]
        back = self._backward(waves.shape[1])
        pairs = rate + turned, (rate - turned)[:, back].conj()
        return np.concatenate([z.reshape(nt, -1) for z in pairs], axis=1)

    def _backward(self, count: int) -> slice:
        """Of ``count`` wavenumbers k >= 0 those whose opposites are others."""
        return slice(1, count - (self.cells % 2 == 0))

    def force(self, cell: int, mass: int) -> np.ndarray:
        """What 1 N on a ``mass`` of a ``cell`` (0-based) adds to z' (mode), in 1/sqrt(kg)."""
        root = np.sqrt(self.chain.coefficients(cell, cell + 1).masses[0, mass])
        if self.vectors.ndim == 2:
            return np.asarray(self.vectors[cell * self.chain.cell.dofs + mass] / root)
        k = np.arange(len(self.vectors))
        shift = np.exp(-2j * np.pi * k * cell / self.cells) / np.sqrt(self.cells)
        waves = self.vectors[:, mass].conj() * shift[:, None]
        return np.concatenate([waves.ravel(), waves[self._backward(len(k))].conj().ravel()]) / root

    def later(self, amplitudes: np.ndarray, interval: float) -> np.ndarray:
        """Free ``amplitudes`` (mode) after an ``interval`` in s."""
        return np.asarray(amplitudes * np.exp(1j * self.frequency * interval))

    def driven(self, drive: Waveform, start: float, stop: float) -> np.ndarray:
        """What ``drive`` adds from ``start`` to ``stop`` (s) to the amplitudes (mode) at ``stop``, for ``force`` 1."""
        return drive.response(self.frequency, start, stop)


def linear_modes(chain: Chain) -> Modes:
    """The modes of ``chain`` without its sites and dashpots, computed once: 1200 DoFs take about a second and 12 MB.

    Raises ValueError for more than ``MOST_DOFS`` of a lattice whose cells differ: no wave is a mode of that.
    """
    return _modes(replace(chain, sites=(), clearances=()))


@lru_cache(maxsize=4)
def _modes(chain: Chain) -> Modes:
    ring, many = chain.ends == "periodic", chain.cells * chain.cell.dofs > MOST_DOFS
    if chain.is_uniform() and (ring or many):
        return _ring(chain, chain.cells + (chain.ends == "fixed"), ring)
    if many:
        raise ValueError(f"modes of {chain.cells} cells that differ, more than {MOST_DOFS} masses")
    matrix = _scaled(chain)
    squared, vectors = eigh(matrix.toarray(), driver="evr") if ring else _near_diagonal(matrix)
    x = np.random.default_rng(0).standard_normal((2, len(squared)))
    if np.any(np.abs(np.sum((x @ vectors) ** 2, axis=1) / np.sum(x**2, axis=1) - 1) > ORTHONORMAL):
        squared, vectors = eigh(matrix.toarray(), driver="evr")
    squared[squared < 1e-13 * squared[-1]] = 0.0  # free ends
    return Modes(chain, np.sqrt(squared), _wavenumbers(vectors, chain), vectors, True, chain.cells)


def _ring(chain: Chain, cells: int, exact: bool) -> Modes:
    kappa = 2 * np.pi * np.arange(cells // 2 + 1) / cells
    waves = bloch(chain.cell, kappa)
    vectors = waves.vectors * np.sqrt(chain.cell.masses)[:, None]
    back = slice(1, len(kappa) - (cells % 2 == 0))
    # exp(i (k x + Om t)) goes to lower cells.
    number = np.concatenate([-kappa, kappa[back]])
    frequency = np.concatenate([waves.frequency, waves.frequency[back]]).ravel()
    return Modes(chain, frequency, np.repeat(number, chain.cell.dofs), vectors, exact, cells)


def number_near(chain: Chain, omega: float) -> int:
    """The number (from 1, lowest first) of the mode whose frequency is nearest to ``omega`` in rad/s."""
    if chain.ends == "periodic":
        return int(np.argmin(np.abs(np.sort(_ring(chain, chain.cells, True).frequency) - omega))) + 1
    below = _counter(chain)[0](omega**2)
    around = range(max(below, 1), min(below + 1, chain.cells * chain.cell.dofs) + 1)
    return min(around, key=lambda number: abs(mode_frequency(chain, number) - omega))


@lru_cache(maxsize=4)
def mode_frequency(chain: Chain, number: int) -> float:
    """Frequency in rad/s of mode ``number`` (from 1, lowest first) of a chain of any length, with ends by bisection."""
    if chain.ends == "periodic":
        every = np.sort(_ring(chain, chain.cells, True).frequency)
        low, high, top = 0.0, every[number - 1] ** 2, every[-1] ** 2
    else:
        count, top = _counter(chain)
        low, high = 0.0, top
        while high > 64 * EPS * top and high - low > 2 * EPS * high:
            middle = (low + high) / 2
            low, high = (middle, high) if count(middle) < number else (low, middle)
    return 0.0 if high <= 64 * EPS * top else float(np.sqrt(high))  # free ends


@lru_cache(maxsize=4)
def mode_shape(chain: Chain, number: int) -> np.ndarray:
    """Displacement (cell, dof) in m of mode ``number`` (from 1, lowest first), the largest 1 m.

    Of a wave that a ring carries both ways, the standing one that is largest at cell 1 has the lower number.
    """
    if chain.ends == "periodic":
        ring = _ring(chain, chain.cells, True)
        place = np.argsort(ring.frequency, kind="stable")[number - 1]
        kappa, dofs = ring.wavenumber[place], chain.cell.dofs
        wave = bloch(chain.cell, kappa).vectors[:, place % dofs]
        turned = wave / wave[np.argmax(np.abs(wave))] * np.exp(1j * kappa * np.arange(chain.cells))[:, None]
        shape = turned.imag if kappa > 0 else turned.real
    else:
        band, root = _band(_scaled(chain)), 1 / np.sqrt(chain.masses())
        width = len(band) // 3
        band[2 * width] -= mode_frequency(chain, number) ** 2 + 4 * EPS * _counter(chain)[1]
        factor, pivots, _ = lapack.dgbtrf(band, width, width, overwrite_ab=True)
        x = np.random.default_rng(number).standard_normal(len(root))
        for _ in range(3):
            x, _ = lapack.dgbtrs(factor, width, width, x, pivots)
            x /= np.linalg.norm(x)
        shape = (x * root).reshape(chain.cells, -1)
    return np.asarray(shape / shape.flat[np.argmax(np.abs(shape))])


@lru_cache(maxsize=1)
def _counter(chain: Chain) -> tuple[Callable[[float], int], float]:
    """What counts squared frequencies below a number, and a bound of all (Gershgorin's circles)."""
    from vipetsc.lattice.inertia import count_below  # numba

    matrix = _scaled(chain)
    top, upper = float(abs(matrix).sum(axis=0).max()), _band(matrix)
    band = np.ascontiguousarray(upper[2 * (len(upper) // 3) :].T)
    return lambda shift: count_below(band.copy(), shift, EPS**2 * top), top


def _scaled(chain: Chain) -> csc_matrix:
    """M^(-1/2) K M^(-1/2) in (rad/s)^2."""
    root = diags(1 / np.sqrt(chain.masses()))
    return csc_matrix(root @ chain.stiffness_matrix() @ root)


def _band(matrix: csc_matrix) -> np.ndarray:
    """The band of ``matrix`` (3 width + 1, n) as LAPACK's factors want it, with room above."""
    width = int(np.abs(np.subtract(*matrix.nonzero())).max())
    band = np.zeros((3 * width + 1, matrix.shape[0]))
    for k in range(-width, width + 1):
        diagonal = matrix.diagonal(k)
        band[2 * width - k, max(k, 0) : max(k, 0) + len(diagonal)] = diagonal
    return band


def _near_diagonal(matrix: csc_matrix) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues, lowest first, and vectors of a symmetric banded ``matrix``, by inverse iteration.

    Vectors of eigenvalues closer than ``CLOSE`` are made orthogonal to one another; whether that made all so, the
    caller finds out. It takes a fifth of the time of a dense solution.
    """
    n, band = matrix.shape[0], _band(matrix)
    width = len(band) // 3
    squared = eigvals_banded(band[2 * width :], lower=True)
    vectors, noise = np.zeros((n, n), order="F"), np.random.default_rng(1).standard_normal((n, n))
    first, shift = 0, -np.inf
    for j, value in enumerate(squared):
        first += int(np.searchsorted(squared[first:j], value - CLOSE * squared[-1]))
        shift = max(value, shift + 4 * EPS * squared[-1])
        shifted = band.copy(order="F")
        shifted[2 * width] -= shift
        factor, pivots, _ = lapack.dgbtrf(shifted, width, width, overwrite_ab=True)
        x, close = noise[j], vectors[:, first:j]
        for _ in range(3):
            x, _ = lapack.dgbtrs(factor, width, width, x, pivots)
            x /= np.linalg.norm(x)
            for _ in range(2):
                x -= close @ (close.T @ x)
                x /= np.linalg.norm(x)
        vectors[:, j] = x
    return squared, vectors


def _wavenumbers(vectors: np.ndarray, chain: Chain) -> np.ndarray:
    """Wavenumbers (mode): of a standing wave two neighbours of a cell sum to 2 cos(kappa) times itself."""
    shapes = vectors.reshape(chain.cells, -1, vectors.shape[1])
    inside = slice(1, -1) if chain.cells > 2 else slice(None)
    sums = np.zeros_like(shapes)
    sums[1:] += shapes[:-1]
    sums[:-1] += shapes[1:]
    products = np.einsum("xdn,xdn->n", shapes[inside], sums[inside])
    norms = np.einsum("xdn,xdn->n", shapes[inside], shapes[inside])
    # A mode may be at rest in the one cell between two others.
    cosines = np.divide(products, 2 * norms, out=np.zeros_like(norms), where=norms > 1e-12)
    return np.arccos(np.clip(cosines, -1, 1))
