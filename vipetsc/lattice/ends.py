r"""Waves that the cells at an end of a lattice send back when a wave comes to them, and ends that absorb.

The section of the last cells is condensed onto its innermost cell. From the outermost one inwards, with n counted
outwards and B the coupling outwards, Z_n = K_nn + i omega C_nn - omega^2 M_n - B Z_{n+1}^-1 B^T. The innermost cell
then obeys Z u = -B^T u_before. Here u_before = sum_j a_j shape_j is the motion of the last cell before the section, a
sum of waves that come and waves that go back. The equation of motion of that last cell has u in the term B u alone.
Waves fulfil it with sum_j a_j step_j shape_j in place of u, where step_j is the factor of wave j from a cell to the
next one outwards. Both must therefore agree,

    B (sum_j a_j step_j shape_j + Z^-1 B^T sum_j a_j shape_j) = 0,

which gives the amplitudes a_j of the waves that go back.
"""

from typing import Literal, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from vipetsc.lattice.cell import UnitCell
from vipetsc.lattice.chain import Chain, Ends
from vipetsc.lattice.damped import Waves, damped_waves
from vipetsc.lattice.variation import Variation
from vipetsc.lattice.waves import NEUTRAL

End = Literal["left", "right"]


class Side(NamedTuple):
    """The waves of one ``end``: slices of those ``towards`` it and ``back``, and the coupling outwards.

    ``step`` (wave,) is the factor from a cell to the next one outwards.
    """

    towards: slice
    back: slice
    coupling: np.ndarray
    step: np.ndarray

    @classmethod
    def at(cls, end: End, waves: Waves) -> "Side":
        """Return the side of an end at the frequency of ``waves``."""
        half = len(waves.factor) // 2
        to_higher = slice(0, half)
        to_lower = slice(half, None)
        if end == "right":
            return cls(towards=to_higher, back=to_lower, coupling=waves.coupling, step=waves.factor)
        return cls(towards=to_lower, back=to_higher, coupling=waves.coupling.T, step=1 / waves.factor)

    def decay(self) -> np.ndarray:
        """Return |log| of the factors (wave,) of the waves towards the end."""
        return np.asarray(np.abs(np.log(np.abs(self.step[self.towards]))))


class EndSection(NamedTuple):
    """The last ``cells`` of a ``chain`` at an ``end``; those before them are as its reference cell."""

    chain: Chain
    cells: int
    end: End


def condensed(section: EndSection, omegas: np.ndarray) -> np.ndarray:
    """Return Z (omega, dof, dof) in N/m of a ``section`` at ``omegas`` in rad/s, on its innermost cell."""
    chain, cells, end = section
    d = chain.cell.dofs
    # From the outermost cell inwards; ``outwards`` is the block of a row that couples it to the cell farther out.
    first = 0
    outwards = 0
    order = range(cells)
    if end == "right":
        first = chain.cells - cells
        outwards = 2
        order = order[::-1]
    stiffness = _blocks(chain.stiffness_rows(first, first + cells), first, d)
    damping = _blocks(chain.damping_rows(first, first + cells), first, d)
    masses = chain.masses()[first * d : (first + cells) * d].reshape(cells, d)

    w = omegas[:, None, None]
    outer: np.ndarray | None = None
    for n in order:
        z = stiffness[1, n] + 1j * w * damping[1, n] - w**2 * np.diag(masses[n])
        if outer is not None:
            coupling = stiffness[outwards, n] + 1j * w * damping[outwards, n]
            z = z - coupling @ np.linalg.solve(outer, coupling.swapaxes(1, 2))
        outer = z
    assert outer is not None
    return outer


def _blocks(rows: csr_matrix, first: int, d: int) -> np.ndarray:
    """Return blocks (3, cell, dof, dof) of a matrix's ``rows``, of cells from ``first``: cell before, same, next."""
    blocks = rows.tobsr(blocksize=(d, d))
    cells = rows.shape[0] // d
    row = np.repeat(np.arange(cells), np.diff(blocks.indptr))
    out = np.zeros((3, cells, d, d))
    # Offsets are -1, 0 or 1: those between the last and the first cell of a ring do not occur, since a section is a
    # part of a lattice with ends.
    out[blocks.indices - first - row + 1, row] = blocks.data
    return out


def amplitudes_back(z: np.ndarray, waves: Waves, end: End) -> np.ndarray:
    """Return amplitudes (wave back, wave towards) of the waves that unit waves towards an ``end`` send back.

    Both are at the last cell before the section, which is condensed to ``z`` (dof, dof).
    """
    towards, back, coupling, step = Side.at(end, waves)
    half = len(waves.factor) // 2
    # The coupling has rank ``half``: only its range is compared, in an orthonormal basis.
    ranges = np.linalg.svd(coupling)[0][:, :half].conj().T @ coupling
    felt = ranges @ (waves.shape * step + np.linalg.solve(z, coupling.T @ waves.shape))
    return np.asarray(-np.linalg.solve(felt[:, back], felt[:, towards]))


def reflections(z: np.ndarray, waves: Waves, end: End) -> np.ndarray:
    """Return fractions (wave towards,) of the waves' energies that come back from a section condensed to ``z``."""
    side = Side.at(end, waves)
    flux = np.abs(waves.flux)
    return np.asarray(flux[side.back] @ np.abs(amplitudes_back(z, waves, end)) ** 2 / flux[side.towards])


def reflection(chain: Chain, omega: float, cells: int, end: End = "right") -> float:
    """Return the largest share of a wave's energy at ``omega`` (rad/s) that returns from ``cells`` at an ``end``.

    The cells before them go on for ever, as the reference cell, and so must be the springs and dashpots that join the
    two parts. Incoming are waves that do not decay, in a damped cell the one that decays least. NaN in a gap.
    """
    waves = damped_waves(chain.cell, omega)
    side = Side.at(end, waves)

    # Which of the waves that go towards the section carry energy to it.
    growth = side.decay()
    incoming = (growth <= max(growth.min() * (1 + 1e-9), NEUTRAL)) & (np.abs(waves.flux[side.towards]) > 0)
    if not chain.cell.is_damped:
        incoming &= growth < NEUTRAL
    if not incoming.any():
        return np.nan
    z = condensed(EndSection(chain, cells, end), np.array([omega]))[0]
    return float(reflections(z, waves, end)[incoming].max())


def absorber(cell: UnitCell, ends: Ends, cells: int, strength: float, before: int = 1) -> Chain:
    """Return a right end of ``cells`` with dashpots to ground, ``strength`` (1/s) x^3 times masses; ``before`` it.

    x goes from 0 to 1 over the cells, taken in their middles.
    """
    x = np.concatenate([np.zeros(before), (np.arange(cells) + 0.5) / cells])
    present = np.array(cell.grounding or (0.0,) * cell.dofs)
    grounding = np.outer(strength * x**3, cell.masses) + present
    return Chain(cell, cells + before, ends, variation=Variation(grounding=grounding))


def absorbing_section(cell: UnitCell, ends: Ends, cells: int, strength: float, end: End) -> EndSection:
    """Return the section of an ``absorber`` at an ``end``."""
    right = absorber(cell, ends, cells, strength, before=0)
    if end == "right":
        return EndSection(right, cells, end)
    assert right.variation is not None and right.variation.grounding is not None
    mirrored = Variation(grounding=right.variation.grounding[::-1])
    return EndSection(Chain(cell, cells, ends, variation=mirrored), cells, end)
