"""Inter-band transfer beside the slope of frequency-energy branches: ``backbone.h5`` (paper, section IV.C)."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from scipy.optimize import minimize_scalar

from vipetsc.case import Case, case_id
from vipetsc.io.atomic import atomic_write
from vipetsc.io.ensemble_file import EnsembleFile
from vipetsc.io.folder import FolderError
from vipetsc.io.run_file import RunFile
from vipetsc.spectra import Fit, power_law
from vipetsc.studies.datasets import put
from vipetsc.studies.members import LinearWave, linear_case

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
        OSError, KeyError
            If the file holds no branch of ours.
        ValueError
            If the branch does not reach a contact.
        """
        with h5py.File(path) as file:
            energy, slope, region, contacts = (file[n][...] for n in ("energy", "slope", "region", "contacts"))
            kind = file["kind"][...]
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
    law: Fit | None
    steepness: Fit | None


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
    there = np.isfinite(ibtet) & (ibtet > 0) & np.isfinite(work)
    order = np.argsort(work[there], kind="stable")
    energy, ibtet = work[there][order] * (slope.grazing / initiation), ibtet[there][order]
    region = slope.inside(VIBRO_IMPACT)
    if not region.any():
        raise ValueError("the branch has no region III; follow it to higher energy")
    known, steep = slope.energy[region], slope.slope[region]
    fitted = (energy >= known.min()) & (energy <= known.max()) & (np.arange(len(energy)) >= np.argmax(ibtet))
    if fitted.sum() < FEWEST:
        return Alignment(energy, ibtet, fitted, np.nan, None, None)
    rising = np.argsort(known)
    at = np.interp(np.log(energy[fitted]), np.log(known[rising]), np.log(steep[rising]))
    seen = np.log(ibtet[fitted])

    def misfit(logarithm: float) -> float:
        return float(np.sum((np.log(np.exp(at - logarithm) + floor) - seen) ** 2))

    # Without a floor the mean of the differences is the answer; the floor only asks for a larger divisor.
    start = float(np.mean(at - seen))
    best = minimize_scalar(misfit, bracket=(start, start + 0.5), options={"xtol": 1e-10})
    law, steepness = (power_law(energy[fitted], y).log_log for y in (ibtet[fitted], np.exp(at)))
    return Alignment(energy, ibtet, fitted, float(np.exp(best.x)), law, steepness)


def initiation_of(ensemble: EnsembleFile, case: Case) -> Initiation:
    """The initiation of the members like ``case``, from their linear run; raises OSError if that is gone."""
    folder = ensemble.folder / "linear" / case_id(linear_case(case))
    wave = LinearWave.read(folder / "wave.h5")
    with RunFile(folder / "run.h5") as run:
        work = float(run.energies["work"][-1])
    sites = np.asarray(case.contacts.sites)
    first = int(np.argmin(np.abs(sites - case.drive.cell)))
    return Initiation.of(wave.envelope[sites - 1], np.asarray(case.contacts.clearance), first, work)


def relate(ensemble: EnsembleFile, branches: Sequence[Path]) -> Path | None:
    """Write ``backbone.h5`` beside the ensemble: a group a curve; returns its path, None if there is no such curve.

    A curve over the amplitude is laid over the branch of its law and reading, or of its law alone if there is
    none of its reading. ``branches`` are folders with ``branch-out-of-phase.h5``. What could not be related is
    named in the attribute ``left_out``.

    Raises
    ------
    OSError, KeyError, ValueError
        If a branch or a linear run cannot be read, or a branch has no region III.
    """
    if "ibtet" not in ensemble or np.all(np.isnan(ensemble.values("ibtet"))):
        return None
    slopes = [Slope.read(folder / BRANCH) for folder in branches]
    path = ensemble.folder / "backbone.h5"
    left_out, made = [], 0
    with atomic_write(path) as aside, h5py.File(aside, "w") as file:
        file.attrs["format_version"] = FORMAT_VERSION
        file.attrs["case"] = ensemble.file.attrs["case"]
        for case, index in ensemble.curves("amplitude"):
            if not case.contacts.sites:
                continue
            reading, law = case.lattice.reading, case.contacts.law
            name = f"{reading}-{law}-{len(case.contacts.sites)}-sites-{case.drive.cycles:g}-cycles"
            own = [s for s in slopes if s.law == law]
            own = [s for s in own if s.reading == reading] or own
            episodes, ibtet = ensemble.values("contact_episodes")[index], ensemble.values("ibtet")[index]
            untouched = ibtet[episodes == 0]
            if name in file:
                left_out.append(f"{name}: another curve has the same law, reading, sites and cycles")
                continue
            if not own or not untouched.size:
                left_out.append(f"{name}: " + ("no member without contact" if own else f"no branch of the law {law}"))
                continue
            initiation, floor = initiation_of(ensemble, case), float(untouched.mean())
            found = align(ensemble.values("work")[index], ibtet, initiation.energy, floor, own[0])
            if found.law is None:
                left_out.append(f"{name}: {found.fitted.sum()} points in region III behind the peak")
                continue
            group = file.create_group(name)
            group.attrs["case"] = case.to_toml()
            _fill(group, found, initiation, floor, own[0])
            made += 1
        file.attrs["left_out"] = left_out
    return path if made else None


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
            with EnsembleFile(folder) as ensemble:
                written.append(relate(ensemble, branches))
        except (KeyError, OSError, ValueError) as error:
            raise FolderError(f"{folder} beside {', '.join(map(str, branches))}: {error}") from None
    return [path for path in written if path]


def _fill(group: h5py.Group, found: Alignment, initiation: Initiation, floor: float, slope: Slope) -> None:
    put(group, "energy", found.energy, "J", "work of the drive, normalised to the branch")
    put(group, "ibtet", found.ibtet, "1", "inter-band energy transfer", "energy")
    put(group, "fitted", found.fitted.astype(np.int8), "1", "1 in region III at or behind the peak", "energy")
    put(group, "point", np.arange(len(slope.energy)), "1", "regular point of the branch")
    put(group, "branch/energy", slope.energy, "J", "energy of the branch", "point")
    put(group, "branch/slope", slope.slope, "Hz/J", "slope df/dE", "point")
    put(group, "branch/region", slope.region, "1", "region of the branch", "point")
    low, high = found.law.exponent_interval
    numbers = {
        "branch_reading": slope.reading,
        "grazing_energy": slope.grazing,
        "initiation_amplitude": initiation.amplitude,
        "initiation_energy": initiation.energy,
        "onset_amplitude": initiation.onset,
        "floor": floor,
        "divisor": found.divisor,
        "exponent": found.law.exponent,
        "exponent_low": low,
        "exponent_high": high,
        "factor": found.law.factor,
        "r2_adjusted": found.law.r2_adjusted,
        "slope_exponent": found.steepness.exponent,
    }
    for key, value in numbers.items():
        group.attrs[key] = value
