"""Compliance of a small system between its contact pairs, from all its linear modes.

With K phi_n = Om_n^2 M phi_n and phi_n^T M phi_n = 1, and z = rows u, it is the sum over modes of
z_n z_n^T/(Om_n^2 - omega^2) with z_n = rows phi_n.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import eigh

RIGID = 1e-12  # squared frequencies, or losses of a mode, below this fraction of the largest are 0: rigid motions
UNMOVED = 1e-10  # a rigid motion whose relative displacements are below this fraction of the largest moves no pair


class DenseCompliance:
    """Compliance of a small system, from all its linear modes.

    ``masses`` (dofs,) in kg and ``stiffness`` (dofs, dofs) in N/m; ``rows`` (pairs, dofs) pick the relative
    displacements z = rows u. ``squared`` (mode,) are the squared frequencies in (rad/s)^2, ``vectors`` (dofs, mode) the
    mass-normalised modes, ``parts`` (pairs, mode) their relative displacements.
    """

    def __init__(self, masses: np.ndarray, stiffness: np.ndarray, rows: np.ndarray) -> None:
        root = 1 / np.sqrt(masses)
        squared, vectors = eigh(stiffness * np.outer(root, root))
        rigid = np.abs(squared) < RIGID * np.abs(squared).max()

        self.squared = np.where(rigid, 0, squared)
        self.vectors = vectors * root[:, None]
        self.parts = rows * root @ vectors

        # Forces of pairs do not move a rigid motion without relative displacement. Rounding would make them do so, and
        # at omega = 0 without bound.
        relative = np.abs(self.parts).max(axis=0, initial=0.0)
        self.parts[:, rigid & (relative < UNMOVED * np.abs(self.parts).max(initial=0.0))] = 0

    @property
    def highest(self) -> float:
        """The highest frequency of a mode in rad/s."""
        return float(np.sqrt(self.squared.max(initial=0.0)))

    def at(self, omegas: ArrayLike) -> np.ndarray:
        """Return relative displacements (omega, pair, pair) in m/N at ``omegas`` in rad/s, real or complex."""
        gain = self._gain(np.atleast_1d(omegas))
        return np.asarray((self.parts * gain[:, None, :]) @ self.parts.T)

    def with_springs(self, omegas: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
        """Return the compliance (omega, pair, pair) in m/N with a spring of ``stiffness`` (omega,) in N/m at each pair.

        It is Z (diag(Om_n^2 - omega^2) + k Z^T Z)^-1 Z^T, with the columns z_n in Z and the stiffness k.
        """
        # (1 + k G)^-1 G of the compliance G without springs is the same, but loses digits close to a pole of G.
        return np.asarray(self.parts @ self._motions(omegas, stiffness))

    def rate(self, omegas: np.ndarray) -> np.ndarray:
        """Return derivative (omega, pair, pair) by the frequency of the compliance at ``omegas`` (omega,) in rad/s."""
        gain = 2 * omegas[:, None] * self._gain(omegas) ** 2
        return np.asarray((self.parts * gain[:, None, :]) @ self.parts.T)

    def rate_with_springs(self, omegas: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
        """Return the derivative (omega, pair, pair) by the frequency of the compliance ``with_springs``."""
        motions = self._motions(omegas, stiffness)
        return np.asarray(2 * omegas[:, None, None] * (motions.swapaxes(1, 2) @ motions))

    def _motions(self, omegas: ArrayLike, stiffness: ArrayLike) -> np.ndarray:
        """Return amplitudes of the modes (omega, mode, pair) under a unit load at each pair, ``with_springs``."""
        dynamic = self.dynamic_stiffness(omegas, stiffness)
        loads = np.broadcast_to(self.parts.T, (len(dynamic), *self.parts.T.shape))
        return np.asarray(np.linalg.solve(dynamic, loads))

    def dynamic_stiffness(self, omegas: ArrayLike, stiffness: ArrayLike) -> np.ndarray:
        """Return diag(Om_n^2 - omega^2) + k Z^T Z (omega, mode, mode) in (rad/s)^2, of the modes' amplitudes.

        ``omegas`` (omega,) in rad/s; a spring of ``stiffness`` (omega,) in N/m is added at each pair. A mode at rest
        that no pair moves has 1 on the diagonal in place of 0: its amplitude is then 0, as no force acts on it.
        """
        gap = self.squared - np.asarray(omegas)[:, None] ** 2
        gap = np.where(self._moved | (gap != 0), gap, 1.0)
        dynamic = np.eye(len(self.squared)) * gap[:, None]
        return np.asarray(dynamic + np.asarray(stiffness)[:, None, None] * (self.parts.T @ self.parts))

    def field(self, omega: complex, forces: np.ndarray) -> np.ndarray:
        """Return the displacement (dofs,) in m that ``forces`` (pairs,) in N, which pull pairs together, make."""
        gain = self._gain(np.array([omega]))[0]
        return np.asarray(-self.vectors @ (gain * (forces @ self.parts)))

    def _gain(self, omega: np.ndarray) -> np.ndarray:
        """Return the factor 1/(Om_n^2 - omega^2) (omega, mode); 0 of a mode at rest that no pair moves."""
        gap = self.squared - omega[:, None] ** 2
        return np.divide(1, gap, out=np.zeros_like(gap), where=self._moved | (gap != 0))

    @property
    def _moved(self) -> np.ndarray:
        """Mask (mode,) of the modes with a relative displacement of a pair."""
        return np.asarray(np.any(self.parts != 0, axis=0))
