"""A case in terms of ``vipetsc.lattice``, as the engines simulate it."""

from dataclasses import dataclass

import numpy as np

from vipetsc.case.contacts import Gaps
from vipetsc.case.drive import wave_speed
from vipetsc.case.initial import InitialTable
from vipetsc.lattice import Chain, Contact, Drive, Waveform


@dataclass(frozen=True)
class Model:
    """A case in the terms of ``vipetsc.lattice``: 0-based indices, seconds, newtons, everything decided.

    ``atol`` is the pair (displacement m, velocity m/s); ``scale`` the displacement in m of the drive's
    linear wave or of the ``initial`` state, ``packet`` the frequency in rad/s of the wave that arrives first, infinite
    for a pulse. The law of each site is in ``laws`` (() if all have ``contact``), its clearances in m on the sides +
    and - are in ``gaps`` (() if the chain's are those of both).
    """

    chain: Chain
    contact: Contact
    drives: tuple[Drive, ...]
    end: float
    sample_interval: float
    method: str
    rtol: float
    atol: tuple[float, float]
    scale: float
    packet: float
    initial: InitialTable | None = None
    laws: tuple[Contact, ...] = ()
    gaps: Gaps = ()

    @property
    def speed(self) -> float:
        """The group velocity in cells/s that ``traverse`` uses."""
        # Only where it is asked for: the bands of a cell take longer than all else in a model.
        return wave_speed(self.chain.cell, self.packet)

    @property
    def used_laws(self) -> tuple[Contact, ...]:
        """The law of each site, or the one of all: not ``contact`` where each has its own, which may have no limit."""
        return self.laws or (self.contact,)

    @property
    def effective_restitution(self) -> float | list[float]:
        """The effective restitution of each site's law, or of all where they are alike."""
        if not self.laws:
            return self.contact.effective_restitution
        # A root search each: sites have few laws.
        values = {law: law.effective_restitution for law in set(self.laws)}
        return [values[law] for law in self.laws]

    @property
    def drive(self) -> Waveform:
        """The waveform of the first drive, by which frequency, wave and times are judged."""
        return self.drives[0].waveform

    @property
    def is_driven(self) -> bool:
        """Whether the first drive has an amplitude."""
        return self.drive.amplitude != 0

    @property
    def drive_cell(self) -> int:
        """The cell (0-based) of the first drive."""
        return self.drives[0].cell

    @property
    def drive_mass(self) -> int:
        """The mass (0-based) of the first drive."""
        return self.drives[0].mass

    @property
    def samples(self) -> int:
        """Number of uniform samples, the one at t = 0 included."""
        # Where the end is a whole number of intervals, rounding must not lose the last sample.
        return int(np.floor(self.end / self.sample_interval * (1 + 1e-12))) + 1
