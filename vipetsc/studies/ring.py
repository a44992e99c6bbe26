"""The ring, which acts as an infinite lattice with one site during a run: the geometry of the law and the prediction.

The lattice is a ring of N cells, driven at one, with the site d cells on. The burst lasts T_b; v is the speed of its
slow waves (all but 1e-3 of the energy in its band is faster), V the largest group velocity of any band. A run ends at
t_e = d/v + s T_b (s = ``law.settle``): at d/v + T_b the slow waves' end has passed, what is left of the time is for
contacts to die away. No wave returns along the ring: what the drive sends in the other direction reaches the site from
behind after (N - d)/V, what leaves the site is back N/V after the wave's arrival there, so N >= d + V t_e makes the
ring infinite. The drive works as without a site if the burst is over before a wave is back from it (d >= V T_b/2). The
drive is in the midst of the lattice, not at a wall. ``LawCase.one_site`` chooses N, d and t_e.
"""

import xarray as xr

from vipetsc.case.law import LawCase
from vipetsc.studies.recorded_runs import RecordedRuns


class Ring:
    """Runs of ``case`` on the ring, simulated by the teams of ``recorded``; ``setting`` holds its sizes and times."""

    def __init__(self, case: LawCase, recorded: RecordedRuns) -> None:
        self.case = case
        self.setting = case.one_site()
        self.recorded = recorded

    def amplitude(self, z: float, peak: float) -> float:
        """Amplitude in N at which the linear wave reaches ``z`` clearances at the site; ``peak`` is its |w| at 1 N."""
        return z * self.setting.clearance / peak

    def run_to_end(self, amplitude: float, *, with_site: bool) -> xr.Dataset:
        """A run under ``amplitude`` in N of which all cells are kept at the first and the last sample."""
        return self._run(amplitude, with_site, {"stride": self.setting.samples})

    def run_at_site(self, amplitude: float, *, with_site: bool) -> xr.Dataset:
        """A run under ``amplitude`` in N of which all samples of the site's cell are kept."""
        cell = self.setting.site + 1
        return self._run(amplitude, with_site, {"window": [cell, cell]})

    def _run(self, amplitude: float, with_site: bool, output: dict[str, object]) -> xr.Dataset:
        setting = self.setting
        contacts: dict[str, list[float]] = {"sites": [], "clearance": []}
        if with_site:
            # Every run has the law's one clearance: z is changed by the amplitude alone.
            contacts = {"sites": [setting.site + 1], "clearance": [setting.clearance]}
        case = self.case.varied(
            without=("output",),
            lattice={"cells": setting.cells, "ends": "periodic"},
            drive={"cell": 1, "amplitude": amplitude},
            contacts=contacts,
            time={"end": setting.end},
            output=output,
        )
        return self.recorded.run_in_memory(case)[0]
