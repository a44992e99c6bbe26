"""What the pictures of a sweep share: its whole members opened one by one, and how members are named."""

from __future__ import annotations

from collections.abc import Iterator

import h5py

from vipetsc.case import Case
from vipetsc.figures.study import Study
from vipetsc.io.run_file import RunFile


def transfer_members(study: Study) -> Iterator[tuple[RunFile, h5py.File]]:
    """The whole members (run, analysis) with sites and a band above the driven one, each open until the next."""
    for ensemble in study.ensembles:
        for _, folder in ensemble.whole_members():
            with RunFile(folder / "run.h5") as run, h5py.File(folder / "analysis.h5") as analysis:
                # The transfer of a lattice without a higher band is not a number.
                if "ibtet" in analysis and analysis["ibtet"][()] >= 0 and len(run.site_cells):
                    yield run, analysis


def law_name(case: Case) -> str:
    """The contact law with a capital."""
    return case.contacts.law.capitalize()


def configuration(case: Case) -> str:
    """Number of sites and cycles, such as "5 sites, 30 cycles"."""
    sites = len(case.contacts.sites)
    return f"{sites} site{'s' if sites != 1 else ''}, {case.drive.cycles:g} cycles"


def title(case: Case) -> str:
    """Law, reading, configuration and amplitude: what every picture of one member says."""
    return f"{law_name(case)}, {case.lattice.reading}, {configuration(case)}, {case.drive.amplitude:.4g} N"


def configuration_stem(case: Case) -> str:
    """Reading and configuration in a file's name, such as "calibrated-5-sites-30-cycles"."""
    return f"{case.lattice.reading}-{configuration(case)}".replace(",", "").replace(" ", "-")


def stem(case: Case) -> str:
    """A member in a file's name: law, reading, configuration, amplitude."""
    return f"{case.contacts.law}-{configuration_stem(case)}-{case.drive.amplitude:.4g}N"
