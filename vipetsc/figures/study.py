"""What the pictures of sweeps are drawn from: ensembles, their members with fields, branches; and their names."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import xarray as xr

from vipetsc.case import Case, Model
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import axes, curves, open_ensemble, open_run, whole_members

AMPLITUDE = "amplitude"
T = TypeVar("T")


@dataclass(frozen=True)
class Study:
    """Ensembles of finished sweeps (`vipetsc.io.read.open_ensemble`), and folders of frequency-energy branches."""

    ensembles: tuple[xr.Dataset, ...]
    branches: tuple[Path, ...] = ()

    @classmethod
    def read(cls, folders: Iterable[Path]) -> Study:
        """The sweeps and branches in ``folders``; raises OSError or ValueError."""
        folders = list(folders)
        sweeps = tuple(open_ensemble(folder) for folder in folders if (folder / "ensemble.h5").exists())
        return cls(sweeps, tuple(folder for folder in folders if any(folder.glob("branch-*.h5"))))

    def measuring(self, measure: str) -> Study:
        """The same without the sweeps that do not take the ``measure``."""
        return replace(self, ensembles=tuple(e for e in self.ensembles if measure in table(e)["sweep"]["measures"]))


@dataclass(frozen=True)
class MeasuredRun:
    """A member of a sweep with its fields: its case, ``run.h5`` and ``analysis.h5``."""

    folder: Path
    case: Case
    run: xr.Dataset
    analysis: xr.Dataset

    @classmethod
    @contextmanager
    def open(cls, folder: Path) -> Iterator[MeasuredRun]:
        """The member in ``folder``, its files open for the time of the block; raises OSError or ValueError."""
        with open_run(folder / "run.h5") as run, open_netcdf(folder / "analysis.h5", "analysis") as analysis:
            yield cls(folder, Case.of(run), run, analysis)

    @cached_property
    def model(self) -> Model:
        """The case in the lattice's own terms (0-based)."""
        return self.case.model()

    @property
    def amplitude(self) -> float:
        """The drive's amplitude in N."""
        return self.case.drive.amplitude


def transfer_members(study: Study) -> Iterator[MeasuredRun]:
    """The whole members with sites and a band above the driven one, each open until the next is asked for."""
    for ensemble in study.ensembles:
        for _, folder in whole_members(ensemble):
            with MeasuredRun.open(folder) as member:
                # The transfer of a lattice without a higher band is not a number.
                if member.analysis.get("ibtet", -1) >= 0 and member.run.sizes["site"]:
                    yield member


def table(ensemble: xr.Dataset) -> dict[str, Any]:
    """The sweep's case file."""
    return tomllib.loads(ensemble.attrs["case"])


def grouped(items: Iterable[T], key: Callable[[T], str]) -> dict[str, list[T]]:
    """The ``items`` by their ``key``, in the order in which they come."""
    groups: dict[str, list[T]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def reading_of(ensemble: xr.Dataset) -> str:
    """The reading that all members of a sweep share which does not vary it."""
    return next((Case.load(folder / "case.toml").lattice.reading for _, folder in curves(ensemble)), "")


def suffix(member: xr.Dataset, ensemble: xr.Dataset, named: bool, dims: Collection[str] | None = None) -> str:
    """What tells ``member`` (or a row of them) from others of the ensemble in a file's name; the amplitude aside.

    The sweep's name if it is to be ``named``, the reading, and whatever else has several values; of the axes only
    ``dims``, by default all.
    """
    parts = [table(ensemble)["name"]] if named else []
    parts += [] if "reading" in axes(ensemble) else [reading_of(ensemble)]
    for name in axes(ensemble):
        tells = name in ("reading", "wavenumber") or ensemble.sizes[name] > 1
        if name != AMPLITUDE and tells and (dims is None or name in dims):
            parts.append(_in_a_file_name(name, member[name].item()))
    return "-".join(parts)


def _in_a_file_name(name: str, value: Any) -> str:
    if name == "wavenumber":
        return in_pi(value).replace("π", "pi").replace("/", "-")
    text = value if isinstance(value, str) else f"{name}-{value:g}"
    return "".join(c if c.isalnum() or c in "-." else "-" for c in text)


def in_pi(wavenumber: float) -> str:
    """A wavenumber in rad/cell as 5π/9, or as a decimal where no such fraction is near."""
    share = float(wavenumber) / np.pi
    near = Fraction(share).limit_denominator(36)
    if abs(float(near) - share) > 1e-6:
        return f"{share:.3f}π"
    over = f"/{near.denominator}" if near.denominator > 1 else ""
    return f"{'' if near.numerator == 1 else near.numerator}π{over}"


def counted(number: int, noun: str) -> str:
    """``1 site``, ``5 sites``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def law_name(case: Case) -> str:
    """The contact law with a capital."""
    return case.contacts.law.capitalize()


def sites_of(case: Case) -> list[int]:
    """Cells of the contact sites, from 1."""
    sites = case.contacts.sites
    assert isinstance(sites, list)  # those of a resolved case are
    return sites


def configuration(case: Case) -> str:
    """Number of sites and cycles, such as "5 sites, 30 cycles"."""
    return f"{counted(len(sites_of(case)), 'site')}, {case.drive.cycles:g} cycles"


def configuration_heading(case: Case) -> str:
    """Reading and configuration at the head of a page: "Calibrated, 5 sites, 30 cycles"."""
    return f"{case.lattice.reading.capitalize()}, {configuration(case)}"


def configuration_stem(case: Case) -> str:
    """Reading and configuration in a file's name, such as "calibrated-5-sites-30-cycles"."""
    return f"{case.lattice.reading}-{configuration(case)}".replace(",", "").replace(" ", "-")


def member_heading(case: Case) -> str:
    """Law, reading, configuration and amplitude: what every picture of one member says."""
    return f"{law_name(case)}, {case.lattice.reading}, {configuration(case)}, {case.drive.amplitude:.4g} N"


def member_stem(case: Case) -> str:
    """A member in a file's name: law, reading, configuration, amplitude."""
    return f"{case.contacts.law}-{configuration_stem(case)}-{case.drive.amplitude:.4g}N"
