"""Inter-band transfer beside the slope of frequency-energy branches: ``backbone.h5`` (paper, section IV.C)."""

import hashlib
import json
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import xarray as xr
from scipy.optimize import minimize_scalar

import vipetsc
from vipetsc.case import Case, case_id
from vipetsc.io.folder import FolderError
from vipetsc.io.netcdf import Variables, open_netcdf, tabulated, write_netcdf
from vipetsc.io.read import curves, open_ensemble, open_run
from vipetsc.spectra import PowerLaw, power_law
from vipetsc.studies.members import leading_cell, linear_case

FORMAT_VERSION = 1
BRANCH = "branch-out-of-phase.h5"  # the branch that the paper plots
VIBRO_IMPACT = 3  # number of the region III
FEWEST = 3  # points of a power law

# Dimensions, units and description of what the group of a curve holds.
LAYOUT = {
    "energy": ("energy", "J", "work of the drive, normalised to the branch"),
    "ibtet": ("energy", "1", "inter-band energy transfer"),
    "fitted": ("energy", "1", "1 in region III at or behind the peak"),
    "point": ("point", "1", "regular point of the branch"),
    "branch/energy": ("point", "J", "energy of the branch"),
    "branch/slope": ("point", "Hz/J", "slope df/dE"),
    "branch/region": ("point", "1", "region of the branch"),
}


@dataclass(frozen=True)
class Slope:
    """df/dE of a branch along its regular points: ``energy`` in J, ``slope`` in Hz/J, ``region`` 1-4.

    ``grazing`` is the energy in J of the last point without contact: the transition from region I to II.
    """

    law: str
    reading: str
    energy: np.ndarray
    slope: np.ndarray
    region: np.ndarray
    grazing: float

    @classmethod
    def read(cls, path: Path) -> Self:
        """The slope of the branch in ``path``; raises OSError, or ValueError if it does not reach a contact."""
        names = "energy", "slope", "region", "contacts", "kind"
        with open_netcdf(path, "branch", (*names, "case")) as file:
            energy, slope, region, contacts, kind = (file[name].values for name in names)
            table = tomllib.loads(file.attrs["case"])
        touching = np.nonzero(contacts > 0)[0]
        if not touching.size or touching[0] == 0:
            raise ValueError(f"{path}: the branch does not pass from region I to II; follow it to higher energy")
        law, reading = table.get("contacts", {}).get("law", ""), table.get("lattice", {}).get("reading", "")
        regular, grazing = kind == 0, float(energy[touching[0] - 1])
        return cls(law, reading, energy[regular], slope[regular], region[regular], grazing)


@dataclass(frozen=True)
class Initiation:
    """What the linear wave needs to touch the first site: ``amplitude`` in N, ``energy`` (drive's work) in J.

    ``onset`` in N touches any site; it is lower where sites behind the first have smaller clearances.
    """

    amplitude: float
    energy: float
    onset: float

    @classmethod
    def of(cls, envelope: np.ndarray, clearance: np.ndarray, first: int, work: float) -> Self:
        """From the linear run at 1 N: largest w (site) in m, and the drive's work in J; ``first`` is a site.

        Until the first contact the lattice is linear, so w grows with the amplitude and the work with its
        square; the smallest amplitude that touches a site is ``clearance`` / ``envelope``. The envelope is that of
        w^2 + (w'/Om)^2, so it does not depend on where the samples fall.
        """
        touching = np.asarray(clearance) / envelope
        amplitude = float(touching[first])
        return cls(amplitude, work * amplitude**2, float(touching.min()))


@dataclass(frozen=True)
class Alignment:
    """A transfer curve in the energies of a branch; ``divisor`` NaN, both laws None for too few points.

    ``energy`` (point): work of the drive times grazing energy over initiation energy, J, rising. ``fitted``: which
    points lie in region III at or behind the largest transfer. ``divisor``: what the slope is divided by, Hz/J.
    ``law``: the transfer's power law over the fitted points, ``steepness`` that of the slope at their energies.
    """

    energy: np.ndarray
    ibtet: np.ndarray
    fitted: np.ndarray
    divisor: float = np.nan
    law: PowerLaw | None = None
    steepness: PowerLaw | None = None


def align(work: np.ndarray, ibtet: np.ndarray, initiation: float, floor: float, slope: Slope) -> Alignment:
    """Lay the transfer ``ibtet`` (point) at the drive's ``work`` (point, J) over ``slope``.

    The paper's three steps: the lattice's energy is scaled so that the ``initiation`` energy (J) falls on the
    transition from region I to II; the slope is divided by a scalar s; the linear transfer ``floor`` is added.
    s makes the sum over the fitted points of [ln(slope/s + floor) - ln(ibtet)]^2 least, the slope interpolated
    between the branch's points of region III in logarithms. Raises ValueError for a branch without region III.
    """
    valid = np.isfinite(ibtet) & (ibtet > 0) & np.isfinite(work)
    order = np.argsort(work[valid], kind="stable")
    energy, ibtet = work[valid][order] * (slope.grazing / initiation), ibtet[valid][order]
    region = (slope.region == VIBRO_IMPACT) & np.isfinite(slope.slope) & (slope.slope > 0)
    if not region.any():
        raise ValueError("the branch has no region III; follow it to higher energy")
    known, steep = slope.energy[region], slope.slope[region]
    fitted = (energy >= known.min()) & (energy <= known.max()) & (np.arange(len(energy)) >= np.argmax(ibtet))
    if fitted.sum() < FEWEST:
        return Alignment(energy, ibtet, fitted)
    order = np.argsort(known)
    at = np.interp(np.log(energy[fitted]), np.log(known[order]), np.log(steep[order]))
    measured = np.log(ibtet[fitted])

    def misfit(logarithm: float) -> float:
        return float(np.sum((np.log(np.exp(at - logarithm) + floor) - measured) ** 2))

    # Without a floor the mean of the differences is the answer; the floor only asks for a larger divisor.
    start = float(np.mean(at - measured))
    best = minimize_scalar(misfit, bracket=(start, start + 0.5), options={"xtol": 1e-10})
    law, steepness = (power_law(energy[fitted], y) for y in (ibtet[fitted], np.exp(at)))
    return Alignment(energy, ibtet, fitted, float(np.exp(best.x)), law, steepness)


def initiation_of(folder: Path, case: Case) -> Initiation:
    """The initiation of the members like ``case`` of the sweep in ``folder``, from their linear run; raises OSError."""
    linear = folder / "linear" / case_id(linear_case(case))
    sites = np.asarray(case.contacts.sites)
    with open_netcdf(linear / "wave.h5", "linear wave") as wave, open_run(linear / "run.h5") as run:
        envelope, work = wave["envelope"].values[sites - 1], float(run["energy/work"][-1])
    first = int(np.argmax(sites == leading_cell(case)))
    return Initiation.of(envelope, np.asarray(case.contacts.clearance), first, work)


def relate(ensemble: xr.Dataset, branches: Sequence[Path]) -> Path | None:
    """Write ``backbone.h5`` beside the ensemble: a group a curve; returns its path, None if there is no such curve.

    A curve over the amplitude is laid over the branch of its law and reading, or of its law alone if there is
    none of its reading. ``branches`` are folders with ``branch-out-of-phase.h5``. What could not be related is
    named in the attribute ``left_out``. Raises OSError or ValueError for a branch or a linear run that cannot be used.
    """
    if "ibtet" not in ensemble or bool(ensemble["ibtet"].isnull().all()):
        return None
    slopes, folder = [Slope.read(branch / BRANCH) for branch in branches], Path(ensemble.attrs["folder"])
    variables: Variables = {}
    attributes: dict[str, Any] = {}
    left_out = []
    for curve, member in curves(ensemble):
        case = Case.load(member / "case.toml")
        sites = len(np.asarray(case.contacts.sites))
        name = f"{case.lattice.reading}-{case.contacts.law}-{sites}-sites-{case.drive.cycles:g}-cycles"
        related: Any = "another curve has the same law, reading, sites and cycles"
        if f"{name}/case" not in attributes:
            related = _relate_curve(curve, case, slopes, folder) if sites else None
        if isinstance(related, str):
            left_out.append(f"{name}: {related}")
        elif related:
            layout = {f"{name}/{key}": (f"{name}/{dim}", unit, text) for key, (dim, unit, text) in LAYOUT.items()}
            variables |= tabulated(layout, {f"{name}/{key}": values for key, values in related[0].items()})
            attributes |= {f"{name}/{key}": value for key, value in related[1].items()}
    version = {"format_version": FORMAT_VERSION, "vipetsc_version": vipetsc.__version__}
    sources = {"case": ensemble.attrs["case"], "left_out": left_out, "sources": _sources(folder, branches)}
    write_netcdf(folder / "backbone.h5", xr.Dataset(variables, attrs=version | sources | attributes))
    return folder / "backbone.h5" if variables else None


def _relate_curve(
    curve: xr.Dataset, case: Case, slopes: Sequence[Slope], folder: Path
) -> tuple[dict[str, np.ndarray], dict[str, Any]] | str:
    """Values and attributes of one curve's group, or why there is none."""
    of_law = [slope for slope in slopes if slope.law == case.contacts.law]
    of_law.sort(key=lambda slope: slope.reading != case.lattice.reading)
    untouched = curve["ibtet"].values[curve["contact_episodes"].values == 0]
    if not of_law:
        return f"no branch of the law {case.contacts.law}"
    if not untouched.size:
        return "no member without contact"
    slope, initiation, floor = of_law[0], initiation_of(folder, case), float(untouched.mean())
    aligned = align(curve["work"].values, curve["ibtet"].values, initiation.energy, floor, slope)
    if aligned.law is None or aligned.steepness is None:
        return f"{aligned.fitted.sum()} points in region III behind the peak"
    values = {"energy": aligned.energy, "ibtet": aligned.ibtet, "fitted": aligned.fitted.astype(np.int8)}
    values |= {"point": np.arange(len(slope.energy)), "branch/energy": slope.energy}
    values |= {"branch/slope": slope.slope, "branch/region": slope.region}
    law, (low, high) = aligned.law, aligned.law.exponent_interval
    about = {"case": case.to_toml(), "branch_reading": slope.reading, "grazing_energy": slope.grazing, "floor": floor}
    about |= {"initiation_amplitude": initiation.amplitude, "initiation_energy": initiation.energy}
    about |= {"onset_amplitude": initiation.onset, "divisor": aligned.divisor, "factor": law.factor}
    about |= {"exponent": law.exponent, "exponent_low": low, "exponent_high": high, "r2_adjusted": law.r2_adjusted}
    return values, about | {"slope_exponent": aligned.steepness.exponent}


def _sources(folder: Path, branches: Sequence[Path]) -> dict[str, str]:
    """SHA-256 of the files that ``backbone.h5`` is made from, by folder."""
    files = {folder.name: folder / "ensemble.h5"} | {branch.name: branch / BRANCH for branch in branches}
    return {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items()}


def is_related(folder: Path, branches: Sequence[Path]) -> bool:
    """Whether ``folder/backbone.h5`` is what this version makes of the sweep and the ``branches`` as they are now."""
    if not (folder / "backbone.h5").exists():
        return False
    with open_netcdf(folder / "backbone.h5", "relation") as file:
        made, version = file.attrs.get("sources", "{}"), file.attrs.get("vipetsc_version")
    return version == vipetsc.__version__ and json.loads(made) == _sources(folder, branches)


def relate_folders(folders: Sequence[Path]) -> list[Path]:
    """``relate`` every finished sweep among ``folders`` to the branches in the others; the files written.

    Raises FolderError if one of the others holds no out-of-phase branch, or a file cannot be used.
    """
    sweeps = [f for f in folders if (f / "ensemble.h5").exists()]
    branches = [f for f in folders if f not in sweeps]
    for folder in branches:
        if not (folder / BRANCH).exists():
            raise FolderError(f"{folder}: holds no {BRANCH}; the verb nnm makes it, with [nnm] modes = [2]")
    written = []
    for folder in sweeps if branches else ():
        try:
            written.append(relate(open_ensemble(folder), branches))
        except (KeyError, OSError, ValueError) as error:
            raise FolderError(f"{folder} beside {', '.join(map(str, branches))}: {error}") from None
    return [path for path in written if path]
