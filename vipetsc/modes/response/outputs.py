"""Outputs of a steady state that ``[output]`` asks for: motion of named masses, forces of contacts and on walls.

The harmonics F_k in N of the contact forces, which pull back, and the force P of the drive, which acts at Om alone,
give those of every displacement,

    U_k = H(k Om) (P delta_k1 - F_k),

where H is the response of the linear lattice (its ``field``). An incident wave adds its displacement to U_1. Velocity
and acceleration follow by factors i k Om. Peaks are those of the sum of all harmonics. The harmonics of a contact force
converge slowly at its kinks: its peak is taken along each contact episode from the law itself.
"""

import cmath
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vipetsc.case.nfrc import WALLS, NfrcCase
from vipetsc.lattice import Chain, ModalCompliance, WaveCompliance
from vipetsc.modes.balance.harmonics import Episode
from vipetsc.modes.stops import Stops
from vipetsc.spectra.measures import MOTIONS

# Samples of the period, per harmonic, near the largest of which the largest value is looked for. A sample misses the
# peak of the last harmonic by a phase of pi/16 at most, so by 2 % of this harmonic; four steps of Newton's method leave
# nothing of that.
SAMPLES_A_HARMONIC = 16
NEWTON_STEPS = 4
# Samples of one contact episode. The force between two of them is larger than the largest sample by 1e-4 at most, if it
# grows and falls as sin^(3/2), as Hertz's force does.
SAMPLES_AN_EPISODE = 129


class HarmonicMotion(NamedTuple):
    """A steady state in harmonics of ``omega`` in rad/s; the drive has the ``amplitude`` in its unit.

    Its frequency is ``drive_order`` times omega.

    ``relative`` (pairs, K + 1) are the displacements of the pairs in m, ``forces`` (pairs, K + 1) those on them in N,
    without the static load of contacts that are pressed at rest, and without that of a spring which the linear lattice
    has in the place of such a contact; ``driving`` (driven masses,) are forces in N; ``episodes`` are the contact
    episodes. ``incident`` (cells, dofs) in m is an incident wave at the named cells.
    """

    omega: float
    drive_order: int
    amplitude: float
    relative: np.ndarray
    forces: np.ndarray
    driving: np.ndarray
    episodes: Sequence[Episode]
    incident: np.ndarray | float = 0.0


class ResponseOutputs:
    """The outputs that a ``case`` asks for: ``points``, pairs of them (``transmission``), ``forces``.

    ``cells`` are those, from 0, of the named masses and, for the forces on walls, of the two ends. ``contacts`` are the
    stops of the sites. Forces on walls exist only where a finite lattice has them: at fixed ends.
    """

    def __init__(self, case: NfrcCase, compliance: WaveCompliance | ModalCompliance, contacts: Sequence[Stops]) -> None:
        output = case.output
        self.compliance = compliance
        self.contacts = tuple(contacts)
        self.wants_forces = bool(output.forces)
        names = [point.name for point in output.points or []]
        self.pairs = [(names.index(source), names.index(receiver)) for source, receiver in output.transmission or []]

        chain = compliance.chain
        self._springs: list[tuple[int, int]] = []
        if isinstance(compliance, ModalCompliance):
            self._springs = compliance.springs.mass_pairs()
        self.walls: list[WallSprings] = []
        if self.wants_forces and not (case.nfrc.infinite or case.nfrc.open_ends) and chain.ends == "fixed":
            self.walls = [wall_springs(chain, wall) for wall in WALLS]
        self._moved = [(drive.end, ratio) for drive, ratio in case.drive.ratios if drive.end]
        self._masses = [(point.cell - 1, point.mass - 1) for point in output.points or []]
        self.cells = sorted({cell for cell, _ in self._masses} | {wall.cell for wall in self.walls})

    def of(self, motion: HarmonicMotion) -> dict[str, np.ndarray]:
        """Return the values of a steady state by their names in its file (``spectra.responses``)."""
        values: dict[str, np.ndarray] = {}
        if self._springs:
            elongations = motion.relative[len(self.contacts) :]
            values |= {
                "largest_elongation": largest_values(elongations),
                "spring_harmonics": elongations.real,
                "spring_harmonics_imaginary": elongations.imag,
            }

        # Of all displacements only those in the named cells are computed.
        field = np.empty(0)
        if self.cells:
            field = self._field(motion)
        if self._masses:
            places = [(self.cells.index(cell), mass) for cell, mass in self._masses]
            values |= self._motion(motion, np.array([field[:, cell, mass] for cell, mass in places]))

        if self.wants_forces:
            peaks = [
                largest_force(stops, relative, [e for e in motion.episodes if e.pair == pair], motion.omega)
                for pair, (stops, relative) in enumerate(zip(self.contacts, motion.relative, strict=False))
            ]
            # The forces of a motion leave out the springs of the linear lattice in the place of pressed contacts.
            springs = np.array([stops.spring for stops in self.contacts])
            first = (
                motion.forces[: len(springs), motion.drive_order]
                + springs * motion.relative[: len(springs), motion.drive_order]
            )
            values |= {"largest_force": np.array(peaks), "first_force": magnitude(first), "force_lag": lag(first)}
        if self.walls:
            values |= self._on_walls(motion, field)
        return values

    def _field(self, motion: HarmonicMotion) -> np.ndarray:
        """Return harmonics (order, cells, dofs) in m of the displacements in the named cells."""
        orders = motion.forces.shape[1]
        field = np.zeros((orders, len(self.cells), self.compliance.chain.cell.dofs), complex)
        for order in range(orders):
            acting = motion.forces[:, order]
            if order == motion.drive_order:
                acting = np.append(acting, motion.driving)
            # Even orders of a symmetric motion have no force, and need no solution.
            if np.any(acting):
                field[order] = self.compliance.field(order * motion.omega, acting, self.cells)
        field[motion.drive_order] += motion.incident
        return field

    def _motion(self, motion: HarmonicMotion, harmonics: np.ndarray) -> dict[str, np.ndarray]:
        """Return peaks, first harmonics and phases of named masses from their ``harmonics`` (masses, K + 1) in m."""
        rate = 1j * motion.omega * np.arange(harmonics.shape[1])
        values = {"location_harmonics": harmonics.real, "location_harmonics_imaginary": harmonics.imag}
        # Each quantity is the derivative by time of the one before.
        for power, quantity in enumerate(MOTIONS):
            series = harmonics * rate**power
            values[f"peak_{quantity}"] = largest_values(series)
            values[f"first_{quantity}"] = magnitude(series[:, motion.drive_order])
        values["lag"] = lag(harmonics[:, motion.drive_order])
        if self.pairs:
            # The mean square of a velocity is the sum of those of its harmonics. At rest a quotient is 0/0: NaN.
            speed = magnitude(harmonics * rate)
            rms = np.sqrt((speed**2).sum(axis=1) / 2)
            source, receiver = np.array(self.pairs).T
            with np.errstate(divide="ignore", invalid="ignore"):
                values["transmission"] = rms[receiver] / rms[source]
                values["steady_transmission"] = speed[receiver, motion.drive_order] / speed[source, motion.drive_order]
        return values

    def _on_walls(self, motion: HarmonicMotion, field: np.ndarray) -> dict[str, np.ndarray]:
        """Return peaks, first harmonics and phases of the forces on the two walls, from the ``field`` of ``cells``."""
        forces = []
        for name, wall in zip(WALLS, self.walls, strict=True):
            u = field[:, self.cells.index(wall.cell)][:, wall.masses]
            rate = 1j * motion.omega * np.arange(len(u))[:, None]
            force = (wall.stiffness * u + wall.damping * rate * u).sum(axis=1)
            # Forces are positive towards higher cells at both walls. A nonlinear spring pulls the left wall that way
            # where u > 0 stretches it, and the right wall the other way where u < 0 stretches it.
            for (start, end), beyond in zip(self._springs, motion.forces[len(self.contacts) :], strict=True):
                if name == "left" and start < 0:
                    force += beyond
                if name != "left" and end < 0:
                    force -= beyond
            # A wall that moves by w stretches its springs by u - w.
            for moved, ratio in self._moved:
                if name == moved:
                    force[motion.drive_order] -= wall.stiffness.sum() * ratio * motion.amplitude
            forces.append(force)
        harmonics = np.array(forces)
        return {
            "largest_wall_force": largest_values(harmonics),
            "first_wall_force": magnitude(harmonics[:, motion.drive_order]),
            "wall_force_lag": lag(harmonics[:, motion.drive_order]),
        }


class WallSprings(NamedTuple):
    """Springs between a wall and the ``masses`` (spring,) of a ``cell``, both from 0, in N/m and N s/m."""

    cell: int
    masses: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray


def wall_springs(chain: Chain, wall: str) -> WallSprings:
    """Return the springs of a lattice with fixed ends to its ``wall``, "left" or "right"."""
    # A spring between cells belongs to the left one: those to the left wall to the cell before the first one.
    numbers = [number for number, spring in enumerate(chain.cell.springs) if spring.offset]
    springs = [chain.cell.springs[number] for number in numbers]
    cell = chain.cells - 1
    owner = chain.cells - 1
    masses = [spring.start for spring in springs]
    if wall == "left":
        cell = 0
        owner = -1
        masses = [spring.end for spring in springs]
    coefficients = chain.coefficients(owner, owner + 1)
    return WallSprings(
        cell=cell,
        masses=np.array(masses, int),
        stiffness=coefficients.stiffness[0, numbers],
        damping=coefficients.damping[0, numbers],
    )


def largest_values(harmonics: np.ndarray) -> np.ndarray:
    """Return the largest magnitude (rows,) of the motions with the ``harmonics`` (rows, K + 1) over a period.

    From the largest of even samples Newton's method leads to the place where the rate is zero.
    """
    # Linear motions have one harmonic, of which nothing need be sought.
    if harmonics.shape[1] == 2 and not harmonics[:, 0].any():
        return magnitude(harmonics[:, 1])
    samples = _samples(harmonics)
    highest = np.argmax(np.abs(samples), axis=1)
    top = np.abs(samples[np.arange(len(samples)), highest])
    spacing = 2 * np.pi / samples.shape[1]
    phase = spacing * highest
    orders = np.arange(harmonics.shape[1])
    # Real numbers throughout: the bits of complex products depend on where the numbers lie in memory.
    for _ in range(NEWTON_STEPS):
        angles = orders * phase[:, None]
        in_phase = harmonics.real * np.cos(angles) - harmonics.imag * np.sin(angles)
        quadrature = harmonics.real * np.sin(angles) + harmonics.imag * np.cos(angles)
        slope = -(orders * quadrature).sum(axis=1)
        bend = -(orders**2 * in_phase).sum(axis=1)
        # Beyond a sample's distance lies another peak. Where nothing bends, nothing moves.
        step = np.divide(-slope, bend, out=np.zeros_like(slope), where=bend != 0)
        phase = phase + np.clip(step, -spacing, spacing)
    angles = orders * phase[:, None]
    highest_value = (harmonics.real * np.cos(angles) - harmonics.imag * np.sin(angles)).sum(axis=1)
    return np.maximum(np.abs(highest_value), top)


def _samples(harmonics: np.ndarray) -> np.ndarray:
    """Return samples (rows, samples) over a period of Re sum Z_k exp(i k Om t), ``harmonics`` Z (rows, K + 1)."""
    half = SAMPLES_A_HARMONIC // 2 * harmonics.shape[1]
    # The inverse transform adds to each order its conjugate, but for the mean: hence the halves.
    padded = np.pad(harmonics, ((0, 0), (0, half - harmonics.shape[1]))) * np.where(np.arange(half), 0.5, 1)
    return np.fft.irfft(padded, axis=1, norm="forward")


def largest_force(stops: Stops, relative: np.ndarray, episodes: Sequence[Episode], omega: float) -> float:
    """Return the largest force in N of a contact whose displacement has the harmonics ``relative`` (K + 1,) in m.

    It is that of the law, with the static load of a contact that is pressed at rest. Each of ``episodes``, those of
    this contact, is sampled at equal phases; ``omega`` in rad/s is the frequency of the motion.
    """
    largest = 0.0
    orders = np.arange(len(relative))
    for episode in episodes:
        phases = episode.onset + episode.length * np.linspace(0, 1, SAMPLES_AN_EPISODE)
        turns = np.exp(1j * np.outer(phases, orders))
        displacement = episode.side * (turns @ relative).real
        velocity = episode.side * omega * (turns @ (1j * orders * relative)).real

        force = stops.law.elastic_force(displacement - stops.clearance_on(episode.side))
        if stops.law.damping:
            force = force * stops.law.dissipation_factor(velocity, episode.approach)
        largest = max(largest, float(np.abs(force).max()))
    return largest


def magnitude(phasors: np.ndarray) -> np.ndarray:
    """Return the magnitude (...) of each of ``phasors`` (...), complex.

    Unlike those of ``np.abs`` its bits do not depend on where the numbers lie in memory.
    """
    return np.hypot(phasors.real, phasors.imag)


def lag(phasors: np.ndarray) -> np.ndarray:
    """Return phase (phasor,) in degrees, from 0 to 360, by which each of ``phasors`` (phasor,) is behind the drive.

    It is NaN where a phasor is zero.
    """
    # Unlike those of np.angle its bits do not depend on where the numbers lie in memory.
    radians = np.array([cmath.phase(phasor) for phasor in phasors.tolist()])
    return np.where(phasors != 0, np.mod(-np.degrees(radians), 360.0), np.nan)
