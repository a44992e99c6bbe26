"""A finite lattice: its cells, its ends, its contact sites, the tone burst that drives it, its linear response."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, diags
from scipy.sparse.linalg import spsolve

from vipetsc.lattice.cell import UnitCell

Ends = Literal["fixed", "free", "periodic"]
Envelope = Literal["paper", "hann"]

LONGEST = 400  # cells whose linear response is solved for


@dataclass(frozen=True)
class ToneBurst:
    """The drive of one mass, Eq. (3) of the paper: F(t) = A [1 - cos(Om t/Nc)] sin(Om t) for 0 < t < 2 pi Nc/Om.

    ``amplitude`` A in N, ``frequency`` Om in rad/s, ``cycles`` Nc. The paper's envelope peaks at 2A; the
    authors' code has a factor 1/2 before it, here ``envelope = "hann"``.
    """

    amplitude: float
    frequency: float
    cycles: int
    envelope: Envelope = "paper"

    @property
    def duration(self) -> float:
        """Length of the burst in s; 0 of none."""
        return 2 * np.pi * self.cycles / self.frequency if self.amplitude else 0.0

    @property
    def window_amplitude(self) -> float:
        """The factor in N before 1 - cos."""
        return self.amplitude if self.envelope == "paper" else self.amplitude / 2

    def force(self, t: ArrayLike) -> np.ndarray:
        """Force in N at time t in s."""
        t = np.asarray(t, float)
        phase = self.frequency * t
        burst = self.window_amplitude * (1 - np.cos(phase / self.cycles)) * np.sin(phase)
        return np.where((t > 0) & (t < self.duration), burst, 0.0)

    def spectrum(self, frequency: ArrayLike) -> np.ndarray:
        """Fourier transform in N s at ``frequency`` w in rad/s: the integral of F(t) exp(-i w t)."""
        w = np.asarray(frequency, float) * (1 + 1e-7j)  # off the poles, which the first factor cancels
        lines = {self.frequency * (1 + k / self.cycles): 1 - 1.5 * abs(k) for k in (-1, 0, 1)}
        sines = sum(factor * line / (line**2 - w**2) for line, factor in lines.items())
        return self.window_amplitude * (1 - np.exp(-1j * w * self.duration)) * np.asarray(sines)


@dataclass(frozen=True)
class Chain:
    """``cells`` unit cells in a row; contact ``sites`` are 0-based cells, ``clearances`` in m, one a site.

    ``ends``: ``fixed`` puts a wall at either end, held by the inter-cell springs; ``free`` cuts those
    springs; ``periodic`` joins the last cell to the first.
    """

    cell: UnitCell
    cells: int
    ends: Ends = "fixed"
    sites: tuple[int, ...] = ()
    clearances: tuple[float, ...] = ()

    def stiffness_matrix(self) -> csc_matrix:
        """Sparse stiffness (cells dofs, cells dofs) in N/m, ordered cell by cell; needs little for <= 1e6."""
        return self.stiffness_rows(0, self.cells).tocsc()

    def stiffness_rows(self, start: int, stop: int) -> csr_matrix:
        """The rows ((stop - start) dofs, cells dofs) of the stiffness in N/m of cells ``start`` to ``stop``."""
        n, d = self.cells, self.cell.dofs
        rows, columns, values = [], [], []
        index, every = np.arange(start, stop, dtype=np.int64), np.ones(stop - start, bool)
        for mass, offset, other, stiffness in self.cell.couplings():
            neighbour = index + offset
            inside = every if self.ends == "periodic" else (neighbour >= 0) & (neighbour < n)
            held = every if self.ends == "fixed" else inside
            here = index * d + mass
            rows += [here[held] - start * d, here[inside] - start * d]
            columns += [here[held], neighbour[inside] % n * d + other]
            values += [np.full(held.sum(), stiffness), np.full(inside.sum(), -stiffness)]
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        return coo_matrix(entries, shape=((stop - start) * d, n * d)).tocsr()

    def masses(self) -> np.ndarray:
        """Masses (cells dofs,) in kg, ordered cell by cell."""
        return np.tile(np.asarray(self.cell.masses), self.cells)

    def wave_scale(self, drive: ToneBurst, cell: int = 0, mass: int = 0) -> float:
        """Displacement amplitude in m of the linear wave that ``drive`` makes; velocity is Om times that.

        The largest steady response to the burst's peak force at the complex frequency Om (1 - i/Nc), whose
        imaginary part stands for the finite burst. Scales exactly with the drive's amplitude. A lattice
        longer than LONGEST cells is cut there: the wave is evanescent at that frequency.
        """
        cut = Chain(self.cell, min(self.cells, LONGEST), self.ends)
        driven = cell if cell < cut.cells // 2 else max(cut.cells - (self.cells - cell), 0)
        omega = drive.frequency * (1 - 1j / drive.cycles)
        dynamic = cut.stiffness_matrix() - diags(cut.masses() * omega**2)
        force = np.zeros(cut.cells * self.cell.dofs, complex)
        force[driven * self.cell.dofs + mass] = 1.0
        response = float(np.abs(spsolve(dynamic.tocsc(), force)).max())
        return response * 2 * abs(drive.window_amplitude)


def cells_between(cell: ArrayLike, other: int, cells: int, ends: Ends) -> np.ndarray:
    """Number of cells from ``cell`` to ``other`` in a lattice of ``cells``; the shorter way around a ring."""
    way = np.abs(np.asarray(cell, np.int64) - other)
    return np.asarray(np.minimum(way, cells - way) if ends == "periodic" else way)
