r"""The energy that a drive sends to the ends of a lattice, by frequency, and what of it comes back from them.

In an infinite lattice a force exp(i omega t) makes waves j of amplitude a_j to each side. An end receives the
waves of its own side, and those of the other side once the other end has sent them back. If that one is near, both add
with their phases, so that a wall may cancel waves. If it is far, their energies add, since phases turn fast with the
frequency. With flux_j the mean power of wave j of amplitude 1, a force F(t) of transform F(omega) sends 2/pi
|F(omega)|^2 flux_j |a_j|^2 at the frequency omega > 0, in J s/rad: by Parseval its work is the integral of Re(F* V)/pi
over omega > 0, V being the velocity's transform, and flux is half of such a product.

At the edges of bands waves stand, and absorbing ends send them back. How much a drive sends there decides what comes
back: densities are integrated adaptively, from edge to edge, over every wave that propagates.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.polynomial.legendre import leggauss

from vipetsc.lattice.bands import pass_bands
from vipetsc.lattice.cell import UnitCell
from vipetsc.lattice.chain import Chain, Ends
from vipetsc.lattice.damped import Waves, damped_waves
from vipetsc.lattice.drive import Waveform
from vipetsc.lattice.ends import End, EndSection, Side, amplitudes_back, condensed, reflections
from vipetsc.lattice.waves import NEUTRAL

# Cells up to which the waves that the other end sends back are added with their phases. Beyond, phases turn so fast
# with the frequency that energies add: for a drive at 40 cells, 64 gives 2e-6 more than 32, in 1.8 of the time, since
# the density then oscillates.
NEAR = 32
OTHER_END: dict[End, End] = {"left": "right", "right": "left"}
# Detunings, in widths of a waveform's spectrum, at which panels of the quadrature end as well, so that the first panels
# do not miss the spectrum. For the bursts of the paper the edges of bands do, and the middle alone gives the same to
# 1e-8.
LOBES = (-8, -2, 0, 2, 8)
# Quadrature: nodes of a panel, error of an integral, and halvings of a panel at most. What comes back is asked to
# a percent; for a burst in a band four nodes err by 2e-6, and a hundredth of the error allowed changes 4e-9. Six
# halvings suffice there; a spectrum's narrow line, of a burst of many cycles, needs one more for each doubling of
# these.
NODES = 8
ACCURACY = 1e-2
HALVINGS = 12


class Source:
    """A force with a ``waveform`` on the masses of a cell, in proportion to ``load`` (dof,).

    ``place`` is its cell, from 0, in a lattice of ``cells`` equal ones; waves are computed once a frequency.
    """

    def __init__(
        self, cell: UnitCell, ends: Ends, cells: int, place: int, load: np.ndarray, waveform: Waveform
    ) -> None:
        self.cell = cell
        self.cells = cells
        self.place = place
        self.load = load
        self.waveform = waveform
        self._uniform = Chain(cell, 1, ends)
        self._waves: dict[float, Waves] = {}
        self._sent: dict[tuple[float, End, bool], np.ndarray] = {}

    def energies(self, sections: Sequence[EndSection]) -> np.ndarray:
        """Return energies (2,) in J that arrive at the ``sections`` and that come back from them."""
        # With sections at both ends, no end is a wall that sends waves back to the other.
        absorbs = len(sections) == 2

        def densities(omegas: np.ndarray) -> np.ndarray:
            return np.sum([self._densities(omegas, section, absorbs) for section in sections], axis=0)

        return integrate(densities, self.edges())

    def edges(self) -> np.ndarray:
        """Return the frequencies (edge,) in rad/s between which densities are smooth: band edges and lobes."""
        bands = pass_bands(self.cell)
        edges = [0.0, *(band.low for band in bands), *(band.high for band in bands)]
        main = self.waveform.frequency
        lobes = [main * (1 + lobe / self.waveform.cycles) for lobe in LOBES]
        return np.unique([*edges, *(w for w in lobes if 0 < w < max(edges))])

    def sent(self, omegas: np.ndarray, end: End, absorbs: bool = False) -> np.ndarray:
        """Return energies (omega, wave) in J s/rad of the waves towards an ``end`` next to the driven cell.

        The other end sends back what comes to it, unless it ``absorbs``, too.
        """
        new = [omega for omega in omegas.tolist() if (omega, end, absorbs) not in self._sent]
        if new:
            walls = condensed(EndSection(self._uniform, 1, OTHER_END[end]), np.array(new))
            force = 2 / np.pi * np.abs(self.waveform.spectrum(np.array(new))) ** 2
            for omega, wall, size in zip(new, walls, force, strict=True):
                energy = self._energy_of_a_unit(omega, end, None if absorbs else wall)
                self._sent[omega, end, absorbs] = size * energy
        return np.array([self._sent[omega, end, absorbs] for omega in omegas.tolist()])

    def _cells_beyond(self, end: End) -> int:
        """Return the number of cells between the driven one and an ``end``."""
        return {"left": self.place, "right": self.cells - 1 - self.place}[end]

    def _waves_at(self, omega: float) -> Waves:
        """Return the waves at ``omega`` in rad/s, which all sections and both ends have in common."""
        if omega not in self._waves:
            self._waves[omega] = damped_waves(self.cell, omega)
        return self._waves[omega]

    def _energy_of_a_unit(self, omega: float, end: End, wall: np.ndarray | None) -> np.ndarray:
        """Return energies (wave,) towards an ``end`` by a unit force, with the ``wall`` (dof, dof) of the other end."""
        waves = self._waves_at(omega)
        side = Side.at(end, waves)
        flux = np.abs(waves.flux[side.towards])
        if not self.cell.is_damped:
            flux = flux * (side.decay() < NEUTRAL)
        if not flux.any():
            return flux

        ahead, behind = amplitudes_sent(waves, self.load, end)
        if wall is None:
            return np.asarray(flux * np.abs(ahead) ** 2)

        # Cells from the driven one to the one next to the last at the other end.
        other = OTHER_END[end]
        distance = self._cells_beyond(other) - 1
        at_wall = behind * side.step[side.back] ** -distance
        image = side.step[side.towards] ** distance * (amplitudes_back(wall, waves, other) @ at_wall)
        if distance < NEAR:
            return np.asarray(flux * np.abs(ahead + image) ** 2)
        return np.asarray(flux * (np.abs(ahead) ** 2 + np.abs(image) ** 2))

    def _densities(self, omegas: np.ndarray, section: EndSection, absorbs: bool) -> np.ndarray:
        """Return energies (2, omega) in J s/rad that arrive at a ``section`` and that come back from it."""
        end = section.end
        distance = max(self._cells_beyond(end) - section.cells, 0)
        sent = self.sent(omegas, end, absorbs)
        (sends,) = np.nonzero(sent.any(axis=1))

        out = np.zeros((2, len(omegas)))
        for i, z in zip(sends.tolist(), condensed(section, omegas[sends]), strict=True):
            waves = self._waves_at(float(omegas[i]))
            # What does not decay arrives as it is sent.
            arriving = sent[i] * np.exp(-2 * distance * Side.at(end, waves).decay())
            out[:, i] = arriving.sum(), arriving @ reflections(z, waves, end)
        return out


def amplitudes_sent(waves: Waves, load: np.ndarray, end: End) -> tuple[np.ndarray, np.ndarray]:
    """Return amplitudes at a cell of an infinite lattice that a ``load`` (dof,) in N on its masses sends out.

    They are (wave,) of the waves towards an ``end`` and of the others, both in m, at the frequency of ``waves``.
    """
    towards, back, coupling, step = Side.at(end, waves)
    d = len(load)
    half = len(waves.factor) // 2
    scale = np.abs(waves.dynamic).max()

    # Unknowns are the cell's displacement u and the amplitudes. The equations: that of motion of the loaded cell; then
    # those of its two neighbours, in which the coupling to the loaded cell must give the same for u as for the waves
    # on that side, continued to the loaded cell.
    matrix = np.zeros((3, d, d + 2 * half), complex)
    matrix[0, :, :d] = waves.dynamic
    matrix[0, :, d : d + half] = coupling @ (waves.shape * step)[:, towards]
    matrix[0, :, d + half :] = coupling.T @ (waves.shape / step)[:, back]
    matrix[1, :, :d] = coupling.T
    matrix[1, :, d : d + half] = -coupling.T @ waves.shape[:, towards]
    matrix[2, :, :d] = coupling
    matrix[2, :, d + half :] = -coupling @ waves.shape[:, back]
    right = np.concatenate([load / scale, np.zeros(2 * d)])
    amplitudes = np.linalg.lstsq(matrix.reshape(3 * d, -1) / scale, right, rcond=None)[0][d:]
    return amplitudes[:half], amplitudes[half:]


def integrate(densities: Callable[[np.ndarray], np.ndarray], edges: np.ndarray) -> np.ndarray:
    """Return integrals (n,) of ``densities`` (n, x) from the first to the last of the ``edges``, each to ``ACCURACY``.

    Next to an edge they may be as the square root of the distance to it, or its inverse: x = a + (b - a) sin^2 angle.
    """
    points, weights = leggauss(NODES)

    def gauss(panels: np.ndarray) -> np.ndarray:
        """Return integrals (n, panel) over ``panels`` (panel, 4): two edges, and two angles between them."""
        a, b, begin, end = panels.T[:, :, None]
        angle = begin + (end - begin) * (points + 1) / 2
        weight = weights * (end - begin) / 2 * (b - a) * np.sin(2 * angle)
        x = a + (b - a) * np.sin(angle) ** 2
        values = densities(x.ravel()).reshape(-1, *x.shape)
        return np.asarray((values * weight).sum(axis=-1))

    count = len(edges) - 1
    panels = np.column_stack([edges[:-1], edges[1:], np.zeros(count), np.full(count, np.pi / 2)])
    whole = gauss(panels)
    done = np.zeros(len(whole))
    for _ in range(HALVINGS):
        middle = panels[:, 2:].mean(axis=1)
        halves = np.concatenate([panels, panels])
        halves[: len(panels), 3] = middle
        halves[len(panels) :, 2] = middle
        values = gauss(halves)

        both = values[:, : len(panels)] + values[:, len(panels) :]
        total = done + both.sum(axis=1)
        rough = (np.abs(both - whole) > ACCURACY / len(panels) * total[:, None]).any(axis=0)
        if not rough.any():
            return np.asarray(total)
        done = done + both[:, ~rough].sum(axis=1)
        refined = np.concatenate([rough, rough])
        panels = halves[refined]
        whole = values[:, refined]
    return np.asarray(done + whole.sum(axis=1))
