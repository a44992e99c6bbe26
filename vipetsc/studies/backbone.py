"""Inter-band transfer beside the slope of frequency-energy branches: ``backbone.h5`` (paper, section IV.C)."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from scipy.optimize import minimize_scalar

import vipetsc
from vipetsc.case import Case, case_id
from vipetsc.io.folder import FolderError
from vipetsc.io.netcdf import Variables, open_netcdf, variable, write_netcdf
from vipetsc.io.read import curves, open_ensemble, open_run
from vipetsc.spectra import PowerLaw, power_law
from vipetsc.studies.linear import LinearWave, leading_cell, linear_case

FORMAT_VERSION = 1
BRANCH = "branch-out-of-phase.h5"  # the branch that the paper plots
GRAZING, VIBRO_IMPACT = 2, 3  # numbers of the regions II and III
FEWEST = 3


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
    def read(cls, path: Path) -> Slope:
        """The slope of the branch in ``path``.

        Raises
        ------
        OSError
            If the file cannot be opened.
        ValueError
            If it holds no branch of ours, or one that does not reach a contact.
        """
        with open_netcdf(path, "branch", ("energy", "slope", "region", "contacts", "kind", "case")) as file:
            names = "energy", "slope", "region", "contacts", "kind"
            energy, slope, region, contacts, kind = (file[name].values for name in names)
            table = tomllib.loads(file.attrs["case"])
        touched = np.nonzero(contacts > 0)[0]
        if not touched.size or touched[0] == 0:
            raise ValueError(f"{path}: the branch does not pass from region I to II; follow it to higher energy")
        regular = kind == 0
        law, reading = table.get("contacts", {}).get("law", ""), table.get("lattice", {}).get("reading", "")
        grazing = float(energy[touched[0] - 1])
        return cls(law, reading, energy[regular], slope[regular], region[regular], grazing)

    def inside(self, region: int) -> np.ndarray:
        """Which points (point) of ``region`` have a slope above zero."""
        return (self.region == region) & np.isfinite(self.slope) & (self.slope > 0)


@dataclass(frozen=True)
class Initiation:
    """What the linear wave needs to touch the first site: ``amplitude`` in N, ``energy`` (drive's work) in J.

    ``onset`` in N touches any site; it is lower where sites behind the first have smaller clearances.
    """

    amplitude: float
    energy: float
    onset: float

    @classmethod
    def of(cls, envelope: np.ndarray, clearance: np.ndarray, first: int, work: float) -> Initiation:
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
    """A transfer curve in the energies of a branch.

    ``energy`` (point): work of the drive times grazing energy over initiation energy, J, rising. ``fitted``: which
    points lie in region III at or behind the largest transfer. ``divisor``: what the slope is divided by, Hz/J.
    ``law``: the transfer's power law over the fitted points, ``steepness`` that of the slope at their energies;
    both None, and ``divisor`` NaN, for too few points.
    """

    energy: np.ndarray
    ibtet: np.ndarray
    fitted: np.ndarray
    divisor: float
    law: PowerLaw | None
    steepness: PowerLaw | None


def align(work: np.ndarray, ibtet: np.ndarray, initiation: float, floor: float, slope: Slope) -> Alignment:
    """Lay the transfer ``ibtet`` (point) at the drive's ``work`` (point, J) over ``slope``.

    The paper's three steps: the lattice's energy is scaled so that the ``initiation`` energy (J) falls on the
    transition from region I to II; the slope is divided by a scalar s; the linear transfer ``floor`` is added.
    s makes the sum over the fitted points of [ln(slope/s + floor) - ln(ibtet)]^2 least, the slope interpolated
    between the branch's points of region III in logarithms.

    Raises
    ------
    ValueError
        If the branch has no region III.
    """
    valid = np.isfinite(ibtet) & (ibtet > 0) & np.isfinite(work)
    order = np.argsort(work[valid], kind="stable")
    energy, ibtet = work[valid][order] * (slope.grazing / initiation), ibtet[valid][order]
    region = slope.inside(VIBRO_IMPACT)
    if not region.any():
        raise ValueError("the branch has no region III; follow it to higher energy")
    known, steep = slope.energy[region], slope.slope[region]
    fitted = (energy >= known.min()) & (energy <= known.max()) & (np.arange(len(energy)) >= np.argmax(ibtet))
    if fitted.sum() < FEWEST:
        return Alignment(energy, ibtet, fitted, np.nan, None, None)
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
    """The initiation of the members like ``case`` of the sweep in ``folder``, from their linear run.

    Raises
    ------
    OSError, ValueError
        If the linear run is gone or cannot be read.
    """
    linear = folder / "linear" / case_id(linear_case(case))
    wave = LinearWave.read(linear / "wave.h5")
    with open_run(linear / "run.h5") as run:
        work = float(run["energy/work"][-1])
    sites = np.asarray(case.contacts.sites)
    first = int(np.argmax(sites == leading_cell(case)))
    return Initiation.of(wave.envelope[sites - 1], np.asarray(case.contacts.clearance), first, work)


def relate(ensemble: xr.Dataset, branches: Sequence[Path]) -> Path | None:
    """Write ``backbone.h5`` beside the ensemble: a group a curve; returns its path, None if there is no such curve.

    A curve over the amplitude is laid over the branch of its law and reading, or of its law alone if there is
    none of its reading. ``branches`` are folders with ``branch-out-of-phase.h5``. What could not be related is
    named in the attribute ``left_out``.

    Raises
    ------
    OSError, ValueError
        If a branch or a linear run cannot be read, or a branch has no region III.
    """
    if "ibtet" not in ensemble or bool(ensemble["ibtet"].isnull().all()):
        return None
    slopes = [Slope.read(folder / BRANCH) for folder in branches]
    folder, left_out = Path(ensemble.attrs["folder"]), []
    variables: Variables = {}
    attributes: dict[str, Any] = {}
    for curve, member in curves(ensemble):
        case = Case.load(member / "case.toml")
        if not case.contacts.sites:
            continue
        name = _name(case)
        if f"{name}/case" in attributes:
            left_out.append(f"{name}: another curve has the same law, reading, sites and cycles")
            continue
        result = _relate_curve(curve, case, slopes, folder)
        if isinstance(result, str):
            left_out.append(f"{name}: {result}")
            continue
        variables |= {f"{name}/{key}": _inside(name, item) for key, item in result[0].items()}
        attributes |= {f"{name}/{key}": value for key, value in (result[1] | {"case": case.to_toml()}).items()}
    about = {"format_version": FORMAT_VERSION, "case": ensemble.attrs["case"], "left_out": left_out}
    about |= {"vipetsc_version": vipetsc.__version__, "sources": _sources(folder, branches)}
    write_netcdf(folder / "backbone.h5", xr.Dataset(variables, attrs=about | attributes))
    return folder / "backbone.h5" if variables else None


def _name(case: Case) -> str:
    """The group of a curve: reading, law, number of sites and cycles."""
    sites = len(np.asarray(case.contacts.sites))
    return f"{case.lattice.reading}-{case.contacts.law}-{sites}-sites-{case.drive.cycles:g}-cycles"


def _relate_curve(
    curve: xr.Dataset, case: Case, slopes: Sequence[Slope], folder: Path
) -> tuple[Variables, dict[str, Any]] | str:
    """Variables and attributes of one curve's group, or why there is none."""
    reading, law = case.lattice.reading, case.contacts.law
    of_law = [slope for slope in slopes if slope.law == law]
    candidates = [slope for slope in of_law if slope.reading == reading] or of_law
    work, ibtet = curve["work"].values, curve["ibtet"].values
    untouched = ibtet[curve["contact_episodes"].values == 0]
    if not candidates:
        return f"no branch of the law {law}"
    if not untouched.size:
        return "no member without contact"
    slope, initiation, floor = candidates[0], initiation_of(folder, case), float(untouched.mean())
    aligned = align(work, ibtet, initiation.energy, floor, slope)
    if aligned.law is None or aligned.steepness is None:
        return f"{aligned.fitted.sum()} points in region III behind the peak"
    fitted = aligned.fitted.astype(np.int8)
    variables = {
        "energy": variable("energy", aligned.energy, "J", "work of the drive, normalised to the branch"),
        "ibtet": variable("energy", aligned.ibtet, "1", "inter-band energy transfer"),
        "fitted": variable("energy", fitted, "1", "1 in region III at or behind the peak"),
        "point": variable("point", np.arange(len(slope.energy)), "1", "regular point of the branch"),
        "branch/energy": variable("point", slope.energy, "J", "energy of the branch"),
        "branch/slope": variable("point", slope.slope, "Hz/J", "slope df/dE"),
        "branch/region": variable("point", slope.region, "1", "region of the branch"),
    }
    low, high = aligned.law.exponent_interval
    return variables, {
        "branch_reading": slope.reading,
        "grazing_energy": slope.grazing,
        "initiation_amplitude": initiation.amplitude,
        "initiation_energy": initiation.energy,
        "onset_amplitude": initiation.onset,
        "floor": floor,
        "divisor": aligned.divisor,
        "exponent": aligned.law.exponent,
        "exponent_low": low,
        "exponent_high": high,
        "factor": aligned.law.factor,
        "r2_adjusted": aligned.law.r2_adjusted,
        "slope_exponent": aligned.steepness.exponent,
    }


def _inside(group: str, item: xr.Variable) -> xr.Variable:
    """``item`` over the dimensions of ``group``."""
    return xr.Variable([f"{group}/{dim}" for dim in item.dims], item.values, item.attrs)


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

    Raises
    ------
    FolderError
        If one of the others holds no out-of-phase branch, or a file cannot be used.
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
