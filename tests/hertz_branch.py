"""An invented branch of the reduced model with Hertz's law, as files of studies hold it."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from vipetsc.studies.backbone import BRANCH

# Energy in J at which the motion of the branch just touches its stop.
GRAZING = 0.03


def write_branch(folder: Path, largest: float, last_region: float = np.inf) -> None:
    """Write into ``folder`` a branch whose slope falls with the energy E as 1/E from the grazing energy on.

    The branch ends at ``largest`` times the grazing energy; region IV begins at the energy ``last_region`` in J.
    """
    energy = GRAZING * np.concatenate([[0.1, 1.0], np.geomspace(1.001, largest, 60)])
    region = np.select([energy <= GRAZING, energy < 1.2 * GRAZING, energy < last_region], [1, 2, 3], 4)
    with h5py.File(folder / BRANCH, "w") as file:
        file["energy"] = energy
        file["region"] = region
        file["slope"] = np.where(region == 1, 0.0, 700.0 / energy)
        file["contacts"] = (region > 1).astype(int)
        file["kind"] = np.zeros(len(energy), np.int8)
        file.attrs["case"] = '[lattice]\nreading = "printed"\n[contacts]\nlaw = "hertz"\n'
