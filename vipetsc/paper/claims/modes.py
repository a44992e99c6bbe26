"""C15-C17: the reduced model's frequency-energy branches beside the lattice (the paper's section IV and supplement)."""

import json
from dataclasses import dataclass
from typing import Self

import numpy as np
import xarray as xr

from vipetsc.case import NnmCase
from vipetsc.io.read import field_interval, nearest_cell, open_run
from vipetsc.lattice import pass_bands, waves_at
from vipetsc.modes.branch import KINDS
from vipetsc.modes.system import System
from vipetsc.paper.claims.claim import Measurement, MissingEvidence
from vipetsc.paper.claims.evidence import Evidence, MeasuredRun
from vipetsc.paper.claims.thresholds import FEWEST_FOLDS, HERTZ_LIMIT, LAWS, SAME_EXPONENT, SAME_MOTION
from vipetsc.studies.backbone import BRANCH

INTERBAND, ONE_SITE = "interband", "interband-one-site"
MAIN = "5-sites-30-cycles"


def branches(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C15: slope, folds and stability over regions I-IV of the out-of-phase branch (Fig. 11)."""
    for law in LAWS:
        step = f"nnm-{law}" + ("" if reading == "printed" else f"-{reading}")
        branch = evidence.open(step, BRANCH)
        case = NnmCase.from_toml(branch.attrs["case"])
        if case.lattice.reading != reading or case.contacts.law != law:
            raise MissingEvidence(f"{step} holds a branch of the law {case.contacts.law}, {case.lattice.reading}")
        names = ("energy", "frequency", "slope", "region", "multiplier_max", "kind")
        energy, frequency, slope, region, multiplier, kind = (branch[name].values for name in names)
        regular = kind == 0
        steepness = np.abs(slope * energy / frequency)
        first, last = np.nonzero((region == 1) & regular)[0], np.nonzero(regular)[0][-1]
        folds = int(np.sum((kind == KINDS.index("fold-energy")) & (region == 2)))
        fit = json.loads(branch.attrs["fits"]).get("III", {})
        result.value |= {
            f"regions, {law}": len(set(region[region > 0].tolist())),
            f"largest |d ln f / d ln E| in region I, {law}": _largest(steepness[first]),
            f"energy folds in region II, {law}": folds,
            f"largest |multiplier| in region II, {law}": _largest(multiplier[region == 2]),
            f"adjusted R^2 of the slope in region III, {law}": fit.get("adjusted_r2"),
            f"exponent of the slope in region III, {law}": fit.get("exponent"),
            f"last frequency (Hz), {law}": frequency[last],
            f"energy at the end of region I (J), {law}": energy[first[-1]] if first.size else None,
        }
        result.uncertainty[f"points in region III, {law}"] = fit.get("points", 0)
        result.uncertainty[f"energy of the last point (J), {law}"] = energy[last]
        if law == "bilinear":
            limit = System.from_case(case).closed_frequencies()[-1] / (2 * np.pi)
            result.value["high-energy limit (Hz), bilinear"] = limit
            distance = abs(frequency[last] / limit - 1)
            result.value["last frequency's relative distance from the limit, bilinear"] = distance
        else:
            distance = abs(steepness[last] - HERTZ_LIMIT)
            result.value["last d ln f / d ln E's distance from the 3/2 law's .1, hertz"] = distance
        if folds < FEWEST_FOLDS:
            modulus = f" at {case.contacts.modulus / 1e6:g} MPa" if case.contacts.modulus else ""
            result.reasons.append(f"the {law} branch{modulus} has {folds} energy folds at grazing")


def _largest(values: np.ndarray) -> float | None:
    return float(np.nanmax(values)) if np.isfinite(values).any() else None


def follows_slope(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C16: power law of the transfer in region III beside that of the branch's slope (Figs. 12, S7, S8)."""
    relation = evidence.open(INTERBAND, "backbone.h5")
    left_out = [str(text) for text in np.atleast_1d(relation.attrs.get("left_out", []))]
    curves = sorted({str(name).partition("/")[0] for name in relation.variables if str(name).startswith(f"{reading}-")})
    if not any(name.startswith(f"{reading}-{law}-{MAIN}") for name in curves for law in LAWS):
        raise MissingEvidence("; ".join([f"backbone.h5 holds no curve of the reading {reading}", *left_out]))
    for name in curves:
        _, law, sites, _, cycles, _ = name.split("-")
        main = name.endswith(MAIN)
        label = law if main else f"{law}, {sites} site{'s' if sites != '1' else ''}, {cycles} cycles"
        about = {key: relation.attrs[f"{name}/{key}"] for key in ("exponent", "slope_exponent", "branch_reading")}
        difference = abs(float(about["exponent"] - about["slope_exponent"]))
        fitted = relation[f"{name}/fitted"].values.astype(bool)
        low, high = (relation.attrs[f"{name}/exponent_{end}"] for end in ("low", "high"))
        result.value |= {
            f"adjusted R^2 in region III, {label}": float(relation.attrs[f"{name}/r2_adjusted"]),
            f"exponent of the transfer, {label}": float(about["exponent"]),
            f"exponent of the slope, {label}": float(about["slope_exponent"]),
            f"mean factor between transfer and slope, {label}": _mean_factor(relation, name, fitted),
            f"difference of the exponents, {label}": difference,
        }
        result.uncertainty[f"transfer exponent's 95 % interval (+/-), {label}"] = float((high - low) / 2)
        result.uncertainty[f"points of the fit, {label}"] = int(fitted.sum())
        if main and difference > SAME_EXPONENT:
            result.reasons.append(
                f"{law}: the transfer falls as E^{about['exponent']:.2f}, the slope there as"
                f" E^{about['slope_exponent']:.2f}"
            )
        if about["branch_reading"] != reading:
            result.reasons.append(f"{label}: the branch has the reading {about['branch_reading']}")
    result.reasons += [text for text in left_out if text.startswith(reading)]


def _mean_factor(relation: xr.Dataset, name: str, fitted: np.ndarray) -> float:
    """exp of the rms logarithm of transfer over (slope / divisor + floor), the slope interpolated in region III."""
    energy, ibtet = (relation[f"{name}/{key}"].values[fitted] for key in ("energy", "ibtet"))
    known, slope, region = (relation[f"{name}/branch/{key}"].values for key in ("energy", "slope", "region"))
    inside = (region == 3) & np.isfinite(slope) & (slope > 0)
    known, slope = known[inside], slope[inside]
    order = np.argsort(known)
    slope = np.exp(np.interp(np.log(energy), np.log(known[order]), np.log(slope[order])))
    ratio = np.log(ibtet / (slope / relation.attrs[f"{name}/divisor"] + relation.attrs[f"{name}/floor"]))
    return float(np.exp(np.sqrt(np.mean(ratio**2))))


@dataclass(frozen=True)
class PairMotion:
    """Host and resonator of the contact cell of one run: velocities (t, 2) in m/s, and what tells their regime.

    ``correlation`` of the two velocities; ``above``: share of the pair's kinetic energy at frequencies above the
    driven band, of the whole record under a Hann window.
    """

    run: MeasuredRun
    velocity: np.ndarray
    correlation: float
    above: float

    @classmethod
    def of(cls, run: MeasuredRun, fields: xr.Dataset) -> Self:
        """The motion in ``fields``, an open ``run.h5``; raises MissingEvidence if the cell was not recorded."""
        model = run.case.model()
        cell, site = model.chain.cell, int(fields["sites/cell"].values[0])
        index = nearest_cell(fields, site)
        if "velocity" not in fields or fields["cell"].values[index] != site:
            raise MissingEvidence(f"the velocity of cell {site} was not recorded")
        pair = [cell.host, cell.resonator]
        velocity = fields["velocity"][:, index].values[:, pair]
        spectrum = np.abs(np.fft.rfft(velocity * np.hanning(len(velocity))[:, None], axis=0)) ** 2
        energy = spectrum @ np.asarray(cell.masses)[pair]
        frequency = 2 * np.pi * np.fft.rfftfreq(len(velocity), field_interval(fields))
        waves = waves_at(cell, model.drive.frequency)
        edge = pass_bands(cell)[waves[0][0] - 1].high if waves else model.drive.frequency
        above = float(energy[frequency > edge].sum() / energy.sum())
        return cls(run, velocity, float(np.corrcoef(velocity.T)[0, 1]), above)

    def correlation_with(self, other: Self) -> float:
        """Correlation of the resonator's velocity with that of ``other`` at the same times."""
        n = min(len(self.velocity), len(other.velocity))
        return float(np.corrcoef(self.velocity[:n, 1], other.velocity[:n, 1])[0, 1])


def portraits(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C17: regimes of host and resonator at the only site of the lattice (Suppl., Figs. S4, S5)."""
    evidence.ensemble(ONE_SITE)
    for law in LAWS:
        motions = []
        for run in evidence.runs(ONE_SITE, reading, law=law):
            with open_run(evidence.path(ONE_SITE, run.folder.name, "run.h5")) as fields:
                motions.append(PairMotion.of(run, fields))
        touching = [m for m in motions if m.run.episodes]
        if len(touching) < 2 or motions[0].run.episodes:
            raise MissingEvidence(f"{ONE_SITE}, {law}: one amplitude without contact and two with are needed")
        first, last = touching[0], touching[-1]
        grazing = first.correlation_with(motions[0])
        result.value |= {
            f"I: correlation of host and resonator, {law}": motions[0].correlation,
            f"II: correlation with the motion without contact, {law}": grazing,
            f"III: largest share of energy above the driven band, {law}": max(m.above for m in touching),
            f"IV: correlation of host and resonator, {law}": last.correlation,
            f"IV: share of energy above the driven band, {law}": last.above,
        }
        result.value |= {f"correlation at {m.run.amplitude:g} N, {law}": m.correlation for m in touching[:-1]}
        result.uncertainty[f"amplitudes, {law}"] = len(motions)
        if grazing < SAME_MOTION:
            run = first.run
            beyond = 100 * (run.amplitude / run.onset - 1)
            above = f", {beyond:.2g} % above first contact," if np.isfinite(beyond) else ""
            text = f"{law}: at {run.amplitude:g} N{above} the resonator's motion has already left the linear one"
            result.reasons.append(text)
