"""The ring, which acts as an infinite lattice with one site during a run: the geometry of the law and the prediction.

The lattice is a ring of N cells, driven at one, with the site d cells on. The burst lasts T_b; v is the speed of its
slow waves (all but 1e-3 of the energy in its band is faster), V the largest group velocity of any band. A run ends at
t_e = d/v + s T_b (s = ``law.settle``): at d/v + T_b the slow waves' end has passed, what is left of the time is for
contacts to die away. No wave returns along the ring: what the drive sends in the other direction reaches the site from
behind after (N - d)/V, what leaves the site is back N/V after the wave's arrival there, so N >= d + V t_e makes the
ring infinite. The drive works as without a site if the burst is over before a wave is back from it (d >= V T_b/2). The
drive is in the midst of the lattice, not at a wall: where the case moves one, a force on the mass next to it sends the
wave, which has the same form at a site as that of the wall if it is narrow in frequency. How far the wall moves for it
follows from a run in which it does. ``LawCase.one_site`` chooses N, d and t_e.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from vipetsc.case.kinds import NO_SITES, contacts_of_one
from vipetsc.case.law import LawCase
from vipetsc.studies.pair_motion import PairMotion
from vipetsc.studies.recorded_runs import RecordedRuns


class Ring:
    """Runs of ``case`` on the ring, simulated by the teams of ``recorded``; ``setting`` holds its sizes and times.

    The site is of the ``kind`` of that number, by default that of ``law.site``.
    """

    def __init__(self, case: LawCase, recorded: RecordedRuns, kind: int | None = None) -> None:
        self.case = case
        self.setting = case.one_site(kind)
        self.kind = case.kinds.kinds[self.setting.kind]
        self.recorded = recorded

    def amplitude(self, z: float, peak: float) -> float:
        """Amplitude in N at which the linear wave reaches ``z`` clearances at the site; ``peak`` is that of 1 N in m.

        Of sides that differ the peak is that of the side whose stop the wave reaches first, as ``peak_of`` has it.
        """
        return z * self.setting.clearance / peak

    def peak_of(self, motion: PairMotion) -> float:
        """Largest w in m of a ``motion``, each side's over that side's clearance in lesser clearances."""
        return motion.reached([self.kind.sides])[0]

    def motion(self, run: xr.Dataset) -> PairMotion:
        """The relative motion of the site's masses in a ``run_at_site``."""
        (column,) = np.flatnonzero(run["cell"].values == self.setting.site + 1)
        return PairMotion.between(run, [int(column)], [self.kind.pair])

    def run_to_end(self, amplitude: float, *, with_site: bool) -> xr.Dataset:
        """A run under ``amplitude`` in N of which all cells are kept at the first and the last sample."""
        return self._run(amplitude, with_site, {"stride": self.setting.samples})

    def run_at_site(self, amplitude: float, *, with_site: bool, neighbours: int = 0) -> xr.Dataset:
        """A run under ``amplitude`` in N of which all samples of the site's cells are kept.

        So are those of as many ``neighbours`` of it on either side.
        """
        cell = self.setting.site + 1
        first = max(cell - neighbours, 1)
        last = min(cell + self.kind.pair.next_cell + neighbours, self.setting.cells)
        return self._run(amplitude, with_site, {"window": [first, last]})

    def wall_peak(self) -> float:
        """Largest w in m of the linear wave at the site's distance from the case's wall, which moves by 1 m."""
        setting = self.setting
        # A ring has no wall: the waves come from the one of the case's lattice, here as long as the ring.
        cell = setting.distance + 1
        if self.case.drive.end == "right":
            cell = setting.cells - setting.distance
        case = self.case.varied(
            without=("output",),
            lattice={"cells": setting.cells, "absorbing": None},
            drive={"cell": None, "mass": None, "amplitude": 1.0},
            contacts=NO_SITES,
            time={"end": setting.end, "sample_interval": setting.interval},
            output={"window": [cell, cell + self.kind.pair.next_cell]},
        )
        run = self.recorded.run_in_memory(case)[0]
        return self.peak_of(PairMotion.between(run, [0], [self.kind.pair]))

    def _contacts(self) -> dict[str, Any]:
        """The changes of ``[contacts]`` that leave one site of the kind."""
        sites = self.case.kinds.sites(self.setting.kind)
        cell = self.setting.site + 1
        # Every run has the law's one clearance: z is changed by the amplitude alone.
        return contacts_of_one(self.case.contacts, sites[0], self.kind, cell, self.setting.clearance)

    def _run(self, amplitude: float, with_site: bool, output: Mapping[str, object]) -> xr.Dataset:
        setting = self.setting
        contacts = self._contacts() if with_site else NO_SITES
        case = self.case.varied(
            without=("output",),
            lattice={"cells": setting.cells, "ends": "periodic", "absorbing": None},
            # Where the case moves a wall, a force sends a wave of the same form.
            drive={"cell": 1, "amplitude": amplitude, "end": None},
            contacts=contacts,
            time={"end": setting.end, "sample_interval": setting.interval},
            output=output,
        )
        return self.recorded.run_in_memory(case)[0]
