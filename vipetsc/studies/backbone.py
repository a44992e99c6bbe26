"""Inter-band transfer compared with the slope of frequency-energy branches: ``backbone.h5`` (paper, section IV.C).

The frequency f(E) of a nonlinear normal mode, followed as a branch, depends on its energy E once contacts act. The
paper compares the transfer of a sweep over the amplitude with df/dE of the out-of-phase branch in its region III, the
vibro-impact regime, and fits a power of the energy to both. ``read_slope`` takes df/dE from a branch, ``initiation_of``
the drive's work at which contact begins from the linear run, ``align`` scales one to the other and fits.
"""

import hashlib
import json
import os
import sys
import tomllib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from scipy.optimize import minimize_scalar

from vipetsc.case import Case, Sweep
from vipetsc.io.folder import FolderError, origin
from vipetsc.io.netcdf import open_netcdf, tabulated, write_netcdf
from vipetsc.io.read import curves, open_ensemble
from vipetsc.sources import source_key
from vipetsc.spectra import power_law
from vipetsc.studies.linear_run import factor, first_site_cell, is_proportional, read_linear

BRANCH = "branch-out-of-phase.h5"  # the branch that the paper plots
VIBRO_IMPACT = 3  # number of the region III
LEAST_FITTED = 3  # points of a fit; which fits are called power laws `vipetsc.spectra.doubt` decides

# Dimensions, units and description of what the group of a curve holds.
LAYOUT = {
    "energy": ("energy", "J", "work of the drive, normalised to the branch"),
    "ibtet": ("energy", "1", "inter-band energy transfer"),
    "fitted": ("energy", "1", "1 in region III at or beyond the peak"),
    "point": ("point", "1", "regular point of the branch"),
    "branch/energy": ("point", "J", "energy of the branch"),
    "branch/slope": ("point", "Hz/J", "slope df/dE"),
    "branch/region": ("point", "1", "region of the branch"),
}


def read_slope(path: Path) -> xr.Dataset:
    """Return df/dE of a branch along its regular points: the variables ``branch/...`` of ``LAYOUT``.

    Attributes: ``law``, ``reading``, and ``grazing``, the energy in J of the last point without contact, where region I
    passes into II. Raises OSError, or ValueError if the branch does not reach a contact.
    """
    with open_netcdf(path, "branch", ("energy", "slope", "region", "contacts", "kind", "case")) as file:
        energy = file["energy"].values
        slope = file["slope"].values
        region = file["region"].values
        contacts = file["contacts"].values
        regular = file["kind"].values == 0
        case = tomllib.loads(file.attrs["case"])

    touching = np.nonzero(contacts > 0)[0]
    if not touching.size or touching[0] == 0:
        raise ValueError(f"{path}: the branch does not pass from region I to II; follow it to higher energy")
    values = {
        "point": np.arange(regular.sum()),
        "branch/energy": energy[regular],
        "branch/slope": slope[regular],
        "branch/region": region[regular],
    }
    about = {
        "grazing": float(energy[touching[0] - 1]),
        "law": case.get("contacts", {}).get("law", ""),
        "reading": case.get("lattice", {}).get("reading", ""),
    }
    return xr.Dataset(tabulated(LAYOUT, values), attrs=about)


def log_slope(energy: np.ndarray, branch_energy: np.ndarray, slope: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Return ln(df/dE) at ``energy`` (point) in J of a branch with the ``slope`` in Hz/J at its energies and regions.

    It is interpolated in logarithms between the branch's points of region III, NaN beyond them. Raises ValueError if
    there are none.
    """
    inside = (region == VIBRO_IMPACT) & np.isfinite(slope) & (slope > 0)
    if not inside.any():
        raise ValueError("the branch has no region III; follow it to higher energy")
    # A branch turns back at its folds; interpolation needs rising energies.
    order = np.argsort(branch_energy[inside])
    x = np.log(branch_energy[inside][order])
    y = np.log(slope[inside][order])
    return np.asarray(np.interp(np.log(energy), x, y, left=np.nan, right=np.nan))


@dataclass(frozen=True)
class Initiation:
    """Initiation of contact at the first site by the linear wave: ``amplitude`` in N, ``energy`` (drive's work) in J.

    ``onset`` in N touches any site; it is lower where sites behind the first have smaller clearances.
    """

    amplitude: float
    energy: float
    onset: float


def initiation_of(folder: Path, case: Case) -> Initiation:
    """Return the initiation of the members like ``case`` of the sweep in ``folder``, from their linear run.

    Until the first contact the lattice is linear, so w grows with the amplitude and the drive's work with its square:
    the smallest amplitude that touches a site is its lesser clearance over the envelope at 1 N. The envelope is that of
    w^2 + (w'/Om)^2, so it does not depend on where the samples fall. Raises OSError if there is no record of the linear
    run, ValueError if contacts act at any amplitude, or if the motion before them is not proportional to it.
    """
    if not is_proportional(case):
        raise ValueError("the motion before the first contact is not proportional to the drive's amplitude")
    linear = read_linear(folder, case)
    if linear is None:
        raise OSError(f"{folder}: its records contain no linear run of this lattice and drive")
    with np.errstate(divide="ignore"):
        touching = factor(case) / linear.reached(case)
    if not touching.all():
        raise ValueError("a contact that touches at rest acts at any amplitude")

    sites = np.asarray(case.contacts.sites)
    amplitude = float(touching[np.argmax(sites == first_site_cell(case))])
    energy = linear.statistics["work"] * amplitude**2
    return Initiation(amplitude, energy, onset=float(touching.min()))


def align(work: np.ndarray, ibtet: np.ndarray, initiation: float, floor: float, branch: xr.Dataset) -> xr.Dataset:
    """Align the transfer ``ibtet`` (point) at the drive's ``work`` (point, J) with the slope of ``branch``.

    The paper's three steps: the lattice's energy is scaled so that the ``initiation`` energy (J) falls on the
    transition from region I to II; the slope is divided by a scalar s; the linear transfer ``floor`` is added.
    s minimises the sum of [ln(slope/s + floor) - ln(ibtet)]^2 over the fitted points. Raises as ``log_slope``, and
    ValueError if most of these points are not above the floor, so that no s is best.

    Returns ``energy``, ``ibtet`` and ``fitted`` of ``LAYOUT``, energies rising, with the ``branch``. Attributes, unless
    there are too few points to fit: the ``divisor`` s in Hz/J, the root mean square ``misfit`` of the logarithms, the
    transfer's power law (``factor``, ``exponent`` with the ends of its 95 % interval, ``r2_adjusted``), and
    ``slope_exponent`` at the fitted energies.
    """
    valid = np.isfinite(ibtet) & (ibtet > 0) & np.isfinite(work)
    # By energy, not amplitude: the drive's work need not grow with the amplitude once sites are in contact.
    order = np.argsort(work[valid], kind="stable")
    energy = work[valid][order] * (branch.attrs["grazing"] / initiation)
    ibtet = ibtet[valid][order]
    log_slopes = log_slope(
        energy,
        branch_energy=branch["branch/energy"].values,
        slope=branch["branch/slope"].values,
        region=branch["branch/region"].values,
    )
    # Before its peak the transfer still grows as contacts set in.
    fitted = np.isfinite(log_slopes) & (np.arange(len(energy)) >= np.argmax(ibtet))
    values = {"energy": energy, "ibtet": ibtet, "fitted": fitted.astype(np.int8)}
    aligned = xr.merge([xr.Dataset(tabulated(LAYOUT, values)), branch], combine_attrs="override")
    if fitted.sum() < LEAST_FITTED:
        return aligned

    log_transfer = np.log(ibtet[fitted])
    log_slopes = log_slopes[fitted]
    # A divisor that grows without a limit leaves the floor alone: no divisor is best where that fits most points better
    # than the sum, which is larger.
    middle = float(np.median(ibtet[fitted]))
    if middle <= floor:
        raise ValueError(
            f"the transfer without contact, {floor:.3g}, is not below that of the fitted points, {middle:.3g} in the"
            " middle: no divisor of the branch's slope is best"
        )

    def misfit(log_divisor: float) -> float:
        return float(np.sum((np.log(np.exp(log_slopes - log_divisor) + floor) - log_transfer) ** 2))

    # The search is one for ln s, so that no divisor is negative. Without a floor ln s is the mean of the differences;
    # the floor only makes it larger. From there and its first step of 0.5 the bracket grows as far as it must.
    start = float(np.mean(log_slopes - log_transfer))
    best = minimize_scalar(misfit, bracket=(start, start + 0.5), options={"xtol": 1e-10})
    law = power_law(energy[fitted], ibtet[fitted])
    slope_law = power_law(energy[fitted], np.exp(log_slopes))
    low, high = law.exponent_interval
    return aligned.assign_attrs(
        divisor=float(np.exp(best.x)),
        misfit=float(np.sqrt(best.fun / len(log_transfer))),
        factor=law.factor,
        exponent=law.exponent,
        exponent_low=low,
        exponent_high=high,
        r2_adjusted=law.r2_adjusted,
        slope_exponent=slope_law.exponent,
    )


def _relate(ensemble: xr.Dataset, branches: Sequence[Path]) -> Path | None:
    """Write ``backbone.h5`` in the folder of the ensemble, a group a curve; returns its path, None without curves."""
    if "ibtet" not in ensemble or bool(ensemble["ibtet"].isnull().all()):
        return None

    folder = Path(ensemble.attrs["folder"])
    slopes = [read_slope(branch / BRANCH) for branch in branches]
    sweep = Sweep.of(ensemble)
    related: dict[str, xr.Dataset] = {}
    left_out: list[str] = []
    for curve, number in curves(ensemble):
        case = sweep.case(number)
        sites = len(np.asarray(case.contacts.sites))
        if not sites:
            continue
        name = f"{case.lattice.reading}-{case.contacts.law}-{sites}-sites-{case.drive.cycles:g}-cycles"
        if name in related:
            # Another key tells the curves apart: figures name it by the member's number.
            name += f"-{number}"
        relation = _relate_curve(curve, case, slopes, folder)
        if isinstance(relation, str):
            left_out.append(f"{name}: {relation}")
        else:
            related[name] = relation.assign_attrs(number=number)

    about: dict[str, Any] = origin() | {
        "case": ensemble.attrs["case"],
        "left_out": left_out,
        "sources": _sources(folder, branches),
    }
    groups = []
    for name, data in related.items():
        about |= {f"{name}/{key}": value for key, value in data.attrs.items()}
        groups.append(data.rename({key: f"{name}/{key}" for key in data.variables}))
    path = folder / "backbone.h5"
    write_netcdf(path, xr.merge([xr.Dataset(attrs=about), *groups], combine_attrs="override"))
    return path if related else None


def _relate_curve(curve: xr.Dataset, case: Case, slopes: Sequence[xr.Dataset], folder: Path) -> xr.Dataset | str:
    """Return curve aligned with its branch, or the reason why there is no branch."""
    same_law = [slope for slope in slopes if slope.attrs["law"] == case.contacts.law]
    if not same_law:
        return f"no branch of the law {case.contacts.law}"
    untouched = curve["ibtet"].values[curve["contact_episodes"].values == 0]
    if not untouched.size:
        return "no member without contact"

    # A branch of the same reading if there is one, else any of the law.
    slope = min(same_law, key=lambda slope: slope.attrs["reading"] != case.lattice.reading)
    try:
        initiation = initiation_of(folder, case)
    except ValueError as error:
        return str(error)
    floor = float(untouched.mean())
    work = curve["work"].values
    try:
        aligned = align(work, curve["ibtet"].values, initiation.energy, floor, slope)
    except ValueError as error:
        return str(error)
    if "exponent" not in aligned.attrs:
        count = int(aligned["fitted"].sum())
        remedy = "follow the branch to more energy (nnm.energy), or sweep more amplitudes"
        counted = f"amplitudes beyond the peak that lie in region III of the branch: {count}"
        return f"{counted}, of {LEAST_FITTED} needed; {remedy}"
    return aligned.assign_attrs(
        case=case.to_toml(),
        branch_reading=slope.attrs["reading"],
        grazing_energy=slope.attrs["grazing"],
        floor=floor,
        initiation_amplitude=initiation.amplitude,
        initiation_energy=initiation.energy,
        onset_amplitude=initiation.onset,
    )


def _sources(folder: Path, branches: Sequence[Path]) -> dict[str, str]:
    """Return SHA-256 of the files that ``backbone.h5`` is computed from, by folder within their common one."""
    files = {folder.resolve(): "ensemble.h5"} | {branch.resolve(): BRANCH for branch in branches}
    common = os.path.commonpath([path.parent for path in files])
    return {
        path.relative_to(common).as_posix(): hashlib.sha256((path / name).read_bytes()).hexdigest()
        for path, name in files.items()
    }


def is_related(folder: Path, branches: Sequence[Path]) -> bool:
    """Return whether ``folder/backbone.h5`` is of this version, and of sweep and ``branches`` as they are now."""
    with suppress(OSError), open_netcdf(folder / "backbone.h5", "relation") as file:  # none, or one that was cut off
        if file.attrs.get("source") == source_key():
            return bool(json.loads(file.attrs.get("sources", "{}")) == _sources(folder, branches))
    return False


def relate_folders(folders: Sequence[Path]) -> list[Path]:
    """Relate every finished sweep among ``folders`` to the branches in the others; returns the files written.

    A curve over the amplitude is compared with the branch of its law and reading, or of its law if there is none of
    its reading; the attribute ``left_out`` names curves without a branch. Raises FolderError if one of the
    other folders contains no out-of-phase branch, or a file cannot be used.
    """
    sweeps = [folder for folder in folders if (folder / "ensemble.h5").exists()]
    branches = [folder for folder in folders if folder not in sweeps]
    for folder in branches:
        if not (folder / BRANCH).exists():
            raise FolderError(f"{folder}: contains no {BRANCH}; compute it with the verb nnm and [nnm] modes = [2]")
    if not branches:
        return []

    written = []
    for folder in sweeps:
        sys.audit("vipetsc.relate", str(folder))
        try:
            path = _relate(open_ensemble(folder), branches)
        except (KeyError, OSError, ValueError) as error:
            raise FolderError(f"{folder} with {', '.join(map(str, branches))}: {error}") from None
        if path:
            written.append(path)
    return written
