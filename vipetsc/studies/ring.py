"""Runs on a ring that acts as an infinite lattice with one site: the geometry of the law and of the prediction.

The lattice is a ring of N cells, driven at one, with the site d cells on. The burst lasts T_b. The speed v is that of
its slow waves: all but 1e-3 of the energy in its band is faster. V is the largest group velocity of all bands.
``LawCase.one_site`` chooses N, d and the end t_e of a run by three conditions:

- t_e = d/v + s T_b with s = ``law.settle``: at d/v + T_b the last slow waves have passed the site, and contacts die
  away in the time that is left.
- N >= d + V t_e: no wave comes round the ring. What the drive sends in the other direction would reach the site from
  behind after (N - d)/V; what leaves the site would be back N/V after the wave has arrived there.
- d >= V T_b/2: the burst is over before a wave is back at the drive from the site, so that the drive does the work that
  it does without a site.

A ring has no wall. Where the case moves one, a force on the mass next to it sends the wave instead; at a site this has
the form of the wall's wave if the burst is narrow in frequency. How far the wall has to move for such a wave follows
from a run of a lattice with that wall (``Ring.wall_peak``).
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from vipetsc.case.law import NO_SITES, LawCase, contacts_of_one
from vipetsc.studies.pair_motion import PairMotion
from vipetsc.studies.recorded_runs import RecordedRuns


class Ring:
    """Runs of ``case`` on the ring, simulated by the teams of ``recorded``; ``setting`` holds its sizes and times.

    The argument ``kind`` is the number of the kind of site (``case.kinds``), by default that of the site ``law.site``.
    """

    def __init__(self, case: LawCase, recorded: RecordedRuns, kind: int | None = None) -> None:
        self.case = case
        self.setting = case.one_site(kind)
        self.kind = case.kinds.kinds[self.setting.kind]
        self.recorded = recorded

    def amplitude(self, z: float, peak: float) -> float:
        """Return the amplitude in N at which the linear wave reaches ``z`` clearances at the site.

        ``peak`` in m is what the wave of 1 N reaches there, as ``peak_of`` measures it.
        """
        return z * self.setting.clearance / peak

    def peak_of(self, motion: PairMotion) -> float:
        """Return largest w in m of a ``motion``; on a side whose clearance is r times the lesser one, w counts as w/r.

        The motion touches a stop if this exceeds the lesser clearance.
        """
        return motion.reached([self.kind.sides])[0]

    def motion(self, run: xr.Dataset) -> PairMotion:
        """Return the relative motion of the site's masses in a ``run_at_site``."""
        (column,) = np.flatnonzero(run["cell"].values == self.setting.site + 1)
        return PairMotion.between(run, [int(column)], [self.kind.pair])

    def run_to_end(self, amplitude: float, *, with_site: bool) -> xr.Dataset:
        """Run under ``amplitude`` in N; the dataset has all cells at the first and the last sample."""
        return self._run(amplitude, with_site, {"stride": self.setting.samples})

    def run_at_site(self, amplitude: float, *, with_site: bool, neighbours: int = 0) -> xr.Dataset:
        """Run under ``amplitude`` in N; the dataset has all samples of the site's cells.

        These are the site's cell, the next one if the contact joins both, and ``neighbours`` cells on either side.
        """
        cell = self.setting.site + 1
        first = max(cell - neighbours, 1)
        last = min(cell + self.kind.pair.offset + neighbours, self.setting.cells)
        return self._run(amplitude, with_site, {"window": [first, last]})

    def wall_peak(self) -> float:
        """Return largest w in m of the linear wave at the site's distance from the case's wall, which moves by 1 m."""
        setting = self.setting
        # The lattice has the case's ends, and the length of the ring, within which no wave returns before the end.
        cell = setting.distance + 1
        if self.case.drive.end == "right":
            cell = setting.cells - setting.distance
        case = self.case.varied(
            without=("output",),
            lattice={"cells": setting.cells, "absorbing": None},
            drive={"cell": None, "mass": None, "amplitude": 1.0},
            contacts=NO_SITES,
            time={"end": setting.end, "sample_interval": setting.interval},
            output={"window": [cell, cell + self.kind.pair.offset]},
        )
        run = self.recorded.run_in_memory(case)[0]
        return self.peak_of(PairMotion.between(run, [0], [self.kind.pair]))

    def _contacts(self) -> dict[str, Any]:
        """Return the changes of ``[contacts]`` that leave one site of the kind."""
        sites = self.case.kinds.sites(self.setting.kind)
        cell = self.setting.site + 1
        # Every run has the law's one clearance: z is changed by the amplitude alone.
        return contacts_of_one(self.case.contacts, sites[0], self.kind, cell, self.setting.clearance)

    def _run(self, amplitude: float, with_site: bool, output: Mapping[str, object]) -> xr.Dataset:
        """Run the ring under ``amplitude`` in N, and return what the section ``output`` keeps of it."""
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
