"""A case in terms of ``vipetsc.lattice``, as the engines simulate it."""

from dataclasses import dataclass

import numpy as np

from vipetsc.case.contacts import Gaps
from vipetsc.case.drive import wave_speed
from vipetsc.case.initial import InitialTable
from vipetsc.lattice import Chain, Contact, Drive, Waveform, contacts


@dataclass(frozen=True)
class Model:
    """A case in terms of ``vipetsc.lattice``: indices from 0, SI units, every choice resolved.

    ``atol`` are the absolute tolerances of displacements (m) and velocities (m/s); ``scale`` is the displacement in m
    of the drives' linear waves or of the ``initial`` state, ``packet`` the frequency in rad/s of the wave that arrives
    first, infinite for a pulse. ``laws`` has the law of each site, or is () if all have ``contact``; ``gaps`` has the
    clearances in m of each site on the sides + and -, inf without a stop.
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
    gaps: Gaps
    initial: InitialTable | None = None
    laws: tuple[Contact, ...] = ()

    @property
    def speed(self) -> float:
        """The group velocity in cells/s of the wave that arrives first, by which ``time.end = "traverse"`` is set."""
        # Computed only when it is needed: the bands of a cell take longer than the rest of a model.
        return wave_speed(self.chain.cell, self.packet)

    @property
    def used_laws(self) -> tuple[Contact, ...]:
        """The laws of the sites: one for each, or one for all of them.

        Where each site has its own law, ``contact`` holds at none of them, and its numbers may be impossible.
        """
        return self.laws or (self.contact,)

    @property
    def law_of_sites(self) -> tuple[Contact, ...]:
        """The law of each site."""
        return self.laws or (self.contact,) * len(self.chain.sites)

    @property
    def has_rigid_sites(self) -> bool:
        """Whether any site has a stop that does not yield."""
        return bool(self.chain.sites) and any(law.is_rigid for law in self.used_laws)

    @property
    def shared_masses(self) -> np.ndarray:
        """The masses, counted through all cells, on which more than one rigid site acts."""
        elements = contacts(self.chain)
        rigid = np.array([law.is_rigid for law in self.law_of_sites], bool)
        ends = np.concatenate([elements.start[rigid], elements.end[rigid]])
        masses, times = np.unique(ends[ends >= 0], return_counts=True)
        return masses[times > 1]

    @property
    def effective_restitution(self) -> float | list[float]:
        """The effective restitution of each site's law, or of all where they are alike."""
        if not self.laws:
            return self.contact.effective_restitution
        # Once for each law, since it takes a root search, and many sites have few laws.
        values = {law: law.effective_restitution for law in set(self.laws)}
        return [values[law] for law in self.laws]

    @property
    def drive(self) -> Waveform:
        """The waveform of the first drive, to which frequency, wave and times refer."""
        return self.drives[0].waveform

    @property
    def first_drive_acts(self) -> bool:
        """Whether the first drive has an amplitude: it may have none next to a motion at t = 0."""
        return self.drive.amplitude != 0

    @property
    def is_driven(self) -> bool:
        """Whether any drive has an amplitude."""
        return any(drive.waveform.amplitude != 0 for drive in self.drives)

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
        # The end is a whole number of intervals, apart from rounding.
        return round(self.end / self.sample_interval) + 1
