"""Costs of four-band cells over (lambda, eta), by which the supplement chooses the best cell for transfer."""

import itertools
import sys
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.lattice.bands import BlochPoint, bloch
from vipetsc.lattice.cell import Reading, UnitCell, four_band

COSTS = ("deflection", "group_velocity", "weighted")
PAPER_CELL = (0.1, 0.5)  # the (lambda, eta) that the paper takes (sec. III.A; Suppl. 3)
DRIVEN = 2  # the band, from 1, of the wave that closes the contacts; group velocities count from this band upwards
# Product of two displacements, of vectors of unit norm, below which their phase has no meaning: at the zone's border
# one of them vanishes by symmetry, and comes out as a rounding error of either sign.
AT_REST = 1e-12


@dataclass(frozen=True)
class CellSearch:
    """Bloch bands over a grid of four-band cells, and the costs of the cells.

    The axes are ``lam`` (lambda,), ``eta`` (eta,) and ``wavenumber`` (kappa,) in rad per cell, in the irreducible
    Brillouin zone. Over them are ``frequency`` (lambda, eta, kappa, band) in rad/s, ``signed_deflection`` (lambda, eta,
    kappa) of the second band (see the function of this name), and ``speed`` (lambda, eta, band), the largest
    |group velocity| in cells/s over the wavenumber.
    """

    lam: np.ndarray
    eta: np.ndarray
    wavenumber: np.ndarray
    frequency: np.ndarray
    signed_deflection: np.ndarray
    speed: np.ndarray

    @property
    def out_of_phase(self) -> np.ndarray:
        """Mask (lambda, eta) of the cells whose host and resonator move out of phase at every kappa of the second band.

        Wavenumbers at which one of them stands still, as by symmetry at the zone's border, do not count.
        """
        return (self.signed_deflection >= 0).all(axis=-1) & (self.signed_deflection > 0).any(axis=-1)

    def cost(self, name: str) -> np.ndarray:
        """Return the cost ``name``, one of ``COSTS``, over (lambda, eta); the larger the better.

        ``deflection``, without unit, is the largest signed deflection over kappa. ``group_velocity`` in cells/s is the
        sum over bands 2 to 4 of the largest |v_g|. ``weighted`` in cells/s is their product, Eq. (8) of the paper.
        """
        deflection = self.signed_deflection.max(axis=-1)
        speed = self.speed[..., DRIVEN - 1 :].sum(axis=-1)
        costs = {"deflection": deflection, "group_velocity": speed, "weighted": speed * deflection}
        return costs[name]

    def optimum(self, name: str) -> tuple[int, int] | None:
        """Return the indices (lambda, eta) of the best cost ``name`` among cells out of phase; None for none."""
        if not self.out_of_phase.any():
            return None

        # Minus infinity elsewhere, not a selection, so that the argmax is an index of the whole grid.
        cost = np.where(self.out_of_phase, self.cost(name), -np.inf)
        row, column = np.unravel_index(np.argmax(cost), cost.shape)
        return int(row), int(column)


def search_cells(reading: Reading, lam: ArrayLike, eta: ArrayLike, wavenumber: ArrayLike) -> CellSearch:
    """Solve the Bloch problem of every four-band cell of the grid ``lam`` x ``eta`` at every ``wavenumber``.

    ``lam`` and ``eta`` (value,) have no unit, ``wavenumber`` (kappa,) is in rad per cell. Raises ValueError if a lambda
    is not positive or an eta not between 0 and 1: at eta = 1 the host has no mass left.
    """
    lams, etas, kappa = (np.atleast_1d(np.asarray(values, float)) for values in (lam, eta, wavenumber))
    frequency = []
    deflection = []
    speed = []
    # In the order of the grid, into whose shape the lists are brought at the end.
    for one_lam, one_eta in itertools.product(lams, etas):
        sys.audit("vipetsc.step")
        cell = four_band(reading, one_lam, one_eta)
        waves = bloch(cell, kappa)
        # Only what the costs need is kept: Bloch vectors of a fine grid would fill the memory.
        frequency.append(waves.frequency)
        deflection.append(signed_deflection(cell, waves)[:, DRIVEN - 1])
        speed.append(np.abs(waves.group_velocity).max(axis=0))

    grid = (len(lams), len(etas))
    return CellSearch(
        lam=lams,
        eta=etas,
        wavenumber=kappa,
        frequency=np.reshape(frequency, (*grid, *frequency[0].shape)),
        signed_deflection=np.reshape(deflection, (*grid, *deflection[0].shape)),
        speed=np.reshape(speed, (*grid, *speed[0].shape)),
    )


def signed_deflection(cell: UnitCell, point: BlochPoint) -> np.ndarray:
    """Return the deflection |u3 - u2| sign(-u2 u3) (..., band) of the contact pair, positive out of phase.

    u2 is the host's displacement and u3 the resonator's in the waves ``point`` of a ``cell``. The paper leaves the
    length of the Bloch vectors open. They have unit norm here, which puts the optimum near the paper's eta = 0.5 in
    both readings; unit modal mass would favour a light resonator (calibrated: eta = 0.16).
    """
    u = unit_vectors(point)
    host = u[..., cell.host, :]
    resonator = u[..., cell.resonator, :]
    product = (host * resonator.conj()).real
    side = np.where(np.abs(product) < AT_REST, 0.0, -np.sign(product))
    return np.abs(resonator - host) * side


def unit_vectors(point: BlochPoint) -> np.ndarray:
    """Return Bloch vectors (..., dof, band) of ``point``, scaled such that the sum of |u|^2 over the masses is 1."""
    return point.vectors / np.linalg.norm(point.vectors, axis=-2, keepdims=True)
