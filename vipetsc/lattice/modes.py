"""The linear modes of a finite lattice, or waves on a ring where modes are too many.

Without contacts M u'' + K u = f. With x = M^(1/2) u and the orthonormal vectors of M^(-1/2) K M^(-1/2) v = Om^2 v the
complex amplitudes z = v*.x' + i Om v*.x obey z' = i Om z + v*.M^(-1/2) f. Forces alone change the energy |z|^2/2 of a
mode, and the energies of all modes sum to the kinetic energy and that of the springs.

The modes of a ring are Bloch waves, at 2 pi/cells times whole numbers. Beyond ``MOST_DOFS`` the modes of a lattice with
ends are replaced by the waves of a ring of which it is a part, and are not exact. Between fixed ends the ring has one
more cell, at rest, which is the wall on both sides: energies still sum to the whole. Free ends lack the spring that the
ring has between them. A wave that meets an end is seen in other bands too until it has left.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import eig_banded, eigh, lapack
from scipy.sparse import csc_matrix, diags

from vipetsc.lattice.bands import bloch
from vipetsc.lattice.chain import Chain
from vipetsc.lattice.inertia import count_below
from vipetsc.lattice.sites import NO_SITES

MOST_DOFS = 4000  # of a lattice with ends whose modes are computed: a square matrix of this size has 128 MB
EPS = float(np.finfo(float).eps)
AT_REST = 1e-13  # squared frequencies below this fraction of the largest are those of a rigid translation
# Inverse iterations; few, since the shift is an eigenvalue to rounding. One leaves errors of 2e-12, two of 1e-15, in a
# fifth less of CPU time than three, which leave room for eigenvalues that are less exact; six take half as much again.
ITERATIONS = 3


@dataclass(frozen=True, eq=False)
class Modes:
    """Modes of ``chain``: ``frequency`` (mode) in rad/s, ``wavenumber`` (mode) in rad per cell, ``vectors``.

    Of a lattice with ends ``vectors`` is (cell and dof, mode), and a wavenumber, in [0, pi], is that of the standing
    wave, in a gap its real part. A ring, and a lattice with ends of more than ``MOST_DOFS`` masses, whose modes are not
    ``exact``, have waves on a ring of ``cells`` cells instead: ``vectors`` is (k, dof, band) for k >= 0, and waves of
    positive wavenumber go to higher cells.
    """

    chain: Chain
    frequency: np.ndarray
    wavenumber: np.ndarray
    vectors: np.ndarray
    exact: bool
    cells: int

    def amplitudes(self, displacement: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return amplitudes z (t, mode) in sqrt(J) of fields (t, cell, dof) in m and m/s."""
        nt = len(velocity)
        if self.vectors.ndim == 2:
            root = np.sqrt(self.chain.masses()).reshape(self.chain.cells, -1)
            fields = np.concatenate([velocity * root, displacement * root])
            parts = fields.reshape(2 * nt, -1) @ self.vectors
            return np.asarray(parts[:nt] + 1j * self.frequency * parts[nt:])

        root = np.sqrt(self.chain.cell.masses)
        fields = np.concatenate([velocity * root, displacement * root])
        spectrum = np.fft.rfft(fields, self.cells, axis=1, norm="ortho").swapaxes(0, 1)
        waves = (spectrum @ self.vectors.conj()).swapaxes(0, 1)
        rate = waves[:nt]
        frequency = self.frequency[: waves[0].size].reshape(waves.shape[1:])
        turned = 1j * frequency * waves[nt:]

        # A real field has conjugate transforms at k and -k: one transform gives the waves of both directions.
        forward = rate + turned
        back = (rate - turned)[:, self._backward(waves.shape[1])].conj()
        return np.concatenate([forward.reshape(nt, -1), back.reshape(nt, -1)], axis=1)

    def _backward(self, count: int) -> slice:
        """Return slice of ``count`` wavenumbers k >= 0 that leaves out 0 and pi, which are their own opposites."""
        return slice(1, count - (self.cells % 2 == 0))

    def force(self, cell: int, mass: int) -> np.ndarray:
        """Return the rate z' (mode) in 1/sqrt(kg) that a force of 1 N on a ``mass`` of a ``cell`` (0-based) adds."""
        root = np.sqrt(self.chain.coefficients(cell, cell + 1).masses[0, mass])
        if self.vectors.ndim == 2:
            return np.asarray(self.vectors[cell * self.chain.cell.dofs + mass] / root)

        k = np.arange(len(self.vectors))
        shift = np.exp(-2j * np.pi * k * cell / self.cells) / np.sqrt(self.cells)
        waves = self.vectors[:, mass].conj() * shift[:, None]
        back = waves[self._backward(len(k))].conj()
        return np.concatenate([waves.ravel(), back.ravel()]) / root


def linear_modes(chain: Chain) -> Modes:
    """Return the modes of ``chain`` with linear springs alone, without its sites and dashpots, computed once.

    1200 DoFs take a quarter of a second, 4000 a quarter of a minute. Raises ValueError for a lattice of more than
    ``MOST_DOFS`` whose cells differ: its modes are no waves.
    """
    return _modes(replace(chain.linearised(), sites=NO_SITES))


@lru_cache(maxsize=4)
def _modes(chain: Chain) -> Modes:
    """Return the modes of a chain without sites, as ``linear_modes``."""
    ring = chain.topology.is_ring
    many = chain.cells * chain.cell.dofs > MOST_DOFS
    if chain.is_uniform() and (ring or many):
        # A wall on both sides is a cell of the ring that is at rest.
        return _ring(chain, chain.cells + (chain.ends == "fixed"), exact=ring)
    if many:
        raise ValueError(f"modes of {chain.cells} cells that differ, with more than {MOST_DOFS} masses")

    matrix = _scaled(chain)
    if ring:
        squared, vectors = eigh(matrix.toarray(), driver="evr")
    else:
        band = _band(matrix)
        squared, vectors = eig_banded(band[2 * (len(band) // 3) :], lower=True)

    squared[squared < AT_REST * squared[-1]] = 0.0  # free ends
    return Modes(
        chain=chain,
        frequency=np.sqrt(squared),
        wavenumber=_wavenumbers(vectors, chain),
        vectors=vectors,
        exact=True,
        cells=chain.cells,
    )


def _ring(chain: Chain, cells: int, exact: bool) -> Modes:
    """Return the Bloch waves on a ring of ``cells``: k >= 0, to lower cells, then k < 0 where these are others."""
    kappa = 2 * np.pi * np.arange(cells // 2 + 1) / cells
    waves = bloch(chain.cell, kappa)
    back = slice(1, len(kappa) - (cells % 2 == 0))
    # exp(i (k x + Om t)) goes to lower cells.
    number = np.concatenate([-kappa, kappa[back]])
    return Modes(
        chain=chain,
        frequency=np.concatenate([waves.frequency, waves.frequency[back]]).ravel(),
        wavenumber=np.repeat(number, chain.cell.dofs),
        vectors=waves.vectors * np.sqrt(chain.cell.masses)[:, None],
        exact=exact,
        cells=cells,
    )


def number_near(chain: Chain, omega: float) -> int:
    """Return the number (from 1, lowest first) of the mode whose frequency is nearest to ``omega`` in rad/s."""
    if chain.topology.is_ring:
        frequency = np.sort(_ring(chain, chain.cells, exact=True).frequency)
        return int(np.argmin(np.abs(frequency - omega))) + 1

    below = _spectrum_counter(chain).below(omega**2)
    neighbours = range(max(below, 1), min(below + 1, chain.cells * chain.cell.dofs) + 1)
    return min(neighbours, key=lambda number: abs(mode_frequency(chain, number) - omega))


@lru_cache(maxsize=4)
def mode_frequency(chain: Chain, number: int) -> float:
    """Return the frequency in rad/s of mode ``number`` (from 1, lowest first) of a chain with ends, by bisection."""
    if chain.topology.is_ring:
        frequencies = np.sort(_ring(chain, chain.cells, exact=True).frequency)
        squared = frequencies[number - 1] ** 2
        top = frequencies[-1] ** 2
    else:
        # Bisection to rounding: of a frequency to its own, of squared frequencies near 0 to that of the largest.
        counter = _spectrum_counter(chain)
        top = counter.top
        low = 0.0
        squared = top
        while squared > 64 * EPS * top and squared - low > 2 * EPS * squared:
            middle = (low + squared) / 2
            if counter.below(middle) < number:
                low = middle
            else:
                squared = middle

    if squared <= 64 * EPS * top:
        return 0.0  # the rigid translation of a lattice with free ends
    return float(np.sqrt(squared))


@lru_cache(maxsize=4)
def mode_shape(chain: Chain, number: int) -> np.ndarray:
    """Return the displacement (cell, dof) in m of mode ``number`` (from 1, lowest first), the largest 1 m.

    Of the two modes of a wave on a ring, the one that is largest at cell 1 has the lower number.
    """
    if chain.topology.is_ring:
        shape = _ring_shape(chain, number)
    else:
        shape = _standing_shape(chain, number)
    return np.asarray(shape / shape.flat[np.argmax(np.abs(shape))])


def _ring_shape(chain: Chain, number: int) -> np.ndarray:
    """Return the shape (cell, dof) of a mode of a ring: real or imaginary part of its Bloch wave."""
    ring = _ring(chain, chain.cells, exact=True)
    place = np.argsort(ring.frequency, kind="stable")[number - 1]
    kappa = ring.wavenumber[place]
    wave = bloch(chain.cell, kappa).vectors[:, place % chain.cell.dofs]
    # Turned so that its largest mass is largest at the first cell.
    turned = wave / wave[np.argmax(np.abs(wave))] * np.exp(1j * kappa * np.arange(chain.cells))[:, None]
    if kappa > 0:
        return turned.imag
    return turned.real


def _standing_shape(chain: Chain, number: int) -> np.ndarray:
    """Return the shape (cell, dof) of a mode of a lattice with ends, by inverse iteration."""
    band = _band(_scaled(chain))
    root = 1 / np.sqrt(chain.masses())
    # A hair above the eigenvalue, so that the shifted matrix can be inverted.
    shift = mode_frequency(chain, number) ** 2 + 4 * EPS * _spectrum_counter(chain).top
    width = len(band) // 3
    band[2 * width] -= shift
    factor, pivots, _ = lapack.dgbtrf(band, width, width, overwrite_ab=True)
    x = np.random.default_rng(number).standard_normal(len(root))
    for _ in range(ITERATIONS):
        x, _ = lapack.dgbtrs(factor, width, width, x, pivots)
        x /= np.linalg.norm(x)
    return (x * root).reshape(chain.cells, -1)


class _SpectrumCounter(NamedTuple):
    """Counter of squared frequencies ``below`` a number; ``top`` in (rad/s)^2 is a bound of all of them."""

    below: Callable[[float], int]
    top: float


@lru_cache(maxsize=1)
def _spectrum_counter(chain: Chain) -> _SpectrumCounter:
    """Return counter of a chain with ends, by the inertia of its band matrix; the bound is of Gershgorin's circles."""
    matrix = _scaled(chain)
    top = float(abs(matrix).sum(axis=0).max())
    with_room = _band(matrix)
    width = len(with_room) // 3
    band = np.ascontiguousarray(with_room[2 * width :].T)
    return _SpectrumCounter(below=lambda shift: count_below(band.copy(), shift, EPS**2 * top), top=top)


def _scaled(chain: Chain) -> csc_matrix:
    """Return M^(-1/2) K M^(-1/2) in (rad/s)^2."""
    root = diags(1 / np.sqrt(chain.masses()))
    return csc_matrix(root @ chain.stiffness_matrix() @ root)


def _band(matrix: csc_matrix) -> np.ndarray:
    """Return the band of ``matrix`` (3 width + 1, n) in the layout of LAPACK's ``dgbtrf``, which fills the top."""
    # One free mass has no spring: its matrix is 0, and has no entry.
    width = int(np.abs(np.subtract(*matrix.nonzero())).max(initial=0))
    band = np.zeros((3 * width + 1, matrix.shape[0]))
    for k in range(-width, width + 1):
        diagonal = matrix.diagonal(k)
        first = max(k, 0)
        band[2 * width - k, first : first + len(diagonal)] = diagonal
    return band


def _wavenumbers(vectors: np.ndarray, chain: Chain) -> np.ndarray:
    """Return wavenumbers (mode): of a standing wave two neighbours of a cell sum to 2 cos(kappa) times itself."""
    shapes = vectors.reshape(chain.cells, -1, vectors.shape[1])
    sums = np.zeros_like(shapes)
    sums[1:] += shapes[:-1]
    sums[:-1] += shapes[1:]

    inside = slice(None)
    if chain.cells > 2:
        # The cells at the ends have a neighbour less.
        inside = slice(1, -1)
    products = np.einsum("xdn,xdn->n", shapes[inside], sums[inside])
    norms = np.einsum("xdn,xdn->n", shapes[inside], shapes[inside])
    # A mode may be at rest in the one cell between two others.
    cosines = np.divide(products, 2 * norms, out=np.zeros_like(norms), where=norms > 1e-12)
    return np.arccos(np.clip(cosines, -1, 1))
