"""A case in terms of ``vipetsc.lattice``, as the engines simulate it."""

from dataclasses import dataclass

import numpy as np

from vipetsc.case.drive import wave_speed
from vipetsc.case.initial import InitialTable
from vipetsc.lattice import Chain, Drive, Waveform, contacts


@dataclass(frozen=True)
class Model:
    """A case in terms of ``vipetsc.lattice``: indices from 0, SI units, every choice resolved.

    ``atol`` are the absolute tolerances of displacements (m) and velocities (m/s); ``scale`` is the displacement in m
    of the drives' linear waves or of the ``initial`` state, ``packet`` the frequency in rad/s of the wave that arrives
    first, infinite for a pulse.
    """

    chain: Chain
    drives: tuple[Drive, ...]
    end: float
    sample_interval: float
    method: str
    rtol: float
    atol: tuple[float, float]
    scale: float
    packet: float
    initial: InitialTable | None = None

    @property
    def speed(self) -> float:
        """The group velocity in cells/s of the wave that arrives first, by which ``time.end = "traverse"`` is set."""
        # Computed only when it is needed: the bands of a cell take longer than the rest of a model.
        return wave_speed(self.chain.cell, self.packet)

    @property
    def has_rigid_sites(self) -> bool:
        """Whether any site has a stop that does not yield."""
        return any(law.is_rigid for law in self.chain.sites.laws)

    @property
    def shared_masses(self) -> np.ndarray:
        """The masses, counted through all cells, on which more than one rigid site acts."""
        elements = contacts(self.chain)
        rigid = self.chain.sites.are_rigid
        ends = np.concatenate([elements.start[rigid], elements.end[rigid]])
        masses, times = np.unique(ends[ends >= 0], return_counts=True)
        return masses[times > 1]

    @property
    def effective_restitution(self) -> float | list[float]:
        """The effective restitution of each site's law, or of all where they are alike."""
        # Once for each law, since it takes a root search, and many sites have few laws.
        values = np.array([law.effective_restitution for law in self.chain.sites.laws])
        if len(values) == 1:
            return float(values[0])
        return list(values[self.chain.sites.table["law"]].tolist())

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
