"""C7-C9: the wavenumber entropy of the diatomic lattice against amplitude (the paper's section II.C)."""

from collections.abc import Iterable

import numpy as np
import xarray as xr

from vipetsc.paper.claims.criteria import ABRUPT, FEWEST, HIGH, PEAK, QUIET, SEVERAL, STRAIGHT, STRAIGHT_EVERYWHERE
from vipetsc.paper.claims.evidence import EXCITED, AmplitudeCurve, Evidence, Measurement, MissingEvidence

SPREAD, NEIGHBOURS = "scattering", "scattering-neighbours"
AVERAGES = "energy_weighted", "masked", "joint"
FIT = "points", "r2_log_log", "r2_nonlinear", "exponent", "exponent_low", "exponent_high"


class EntropyDecay:
    """The entropy of one number of ``sites`` at one wavenumber, and the power laws of its fall from the peak on.

    ``r2`` is the adjusted R^2 of the log-log line, ``best`` the better one of line and nonlinear fit, NaN without a
    fit; the ``exponent`` of the line has a 95 % interval of ``half_width`` to either side.
    """

    def __init__(self, members: xr.Dataset, average: str) -> None:
        self.sites, self.curve = int(members["sites"]), AmplitudeCurve.of(members, f"entropy/{average}")
        fit = {name: members[f"fits/entropy/{average}/{name}"].item() for name in FIT}
        self.points, self.r2, self.exponent = int(np.nan_to_num(fit["points"])), fit["r2_log_log"], fit["exponent"]
        self.best = float(np.fmax(self.r2, fit["r2_nonlinear"]))
        self.half_width = (fit["exponent_high"] - fit["exponent_low"]) / 2

    def reaches(self, r2: float, bound: float) -> bool:
        """Whether ``r2``, one of the fits', reaches ``bound`` over enough points."""
        return bool(r2 >= bound and self.points >= FEWEST)

    @property
    def falls(self) -> bool:
        """Whether the peak lies between the ends, and less than half of it is left at either of them."""
        y = self.curve.normalised.value
        return bool(0 < self.curve.peak < len(y) - 1 and y[-1] < 0.5 and y[0] < 0.5)


def decays(evidence: Evidence, step: str, reading: str, average: str, **wanted: float) -> list[EntropyDecay]:
    """The configurations of a sweep with one ``average`` of the entropy; raises MissingEvidence."""
    ensemble = evidence.ensemble(step)
    if f"fits/entropy/{average}/points" not in ensemble or "sites" not in ensemble.coords:
        raise MissingEvidence(f"{step} holds no fits of the entropy over the numbers of sites")
    configurations = (evidence.select(step, reading, **wanted, sites=int(n)) for n in ensemble["sites"].values)
    return [EntropyDecay(members, average) for members in configurations]


def _share(flags: Iterable[bool]) -> float:
    return float(np.mean(list(flags)))


def power_law(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C7: floor, abrupt rise, peak and power-law decay at 5 pi/9 (Fig. 5)."""
    spread = decays(evidence, SPREAD, reading, "energy_weighted", wavenumber=EXCITED)
    curves = [c.curve for c in spread]
    quiet = np.concatenate([c.normalised.value[c.untouched] for c in curves])
    several = [c.curve for c in spread if c.sites >= SEVERAL]
    behind = [c.normalised.interpolate(HIGH) if c.peak_amplitude < HIGH else np.nan for c in several]
    fit = f"adjusted R^2 >= {STRAIGHT:g} over {FEWEST} points or more"
    abrupt = _share(c.normalised.growth_ratio(QUIET, 0.5) <= ABRUPT for c in curves)
    in_place = _share(PEAK[0] <= c.peak_amplitude <= PEAK[1] for c in curves)
    highest = float(np.max(behind)) if behind else None
    result.value |= {
        "floor of the normalised entropy": float(quiet.max()) if quiet.size else None,
        "share of configurations with an abrupt rise": abrupt,
        f"share of configurations with the peak at {PEAK[0]:g} to {PEAK[1]:g} N": in_place,
        f"normalised entropy at {HIGH:g} N behind the peak, {SEVERAL} sites or more": highest,
        f"share of configurations of spread sites with {fit}": _share(c.reaches(c.r2, STRAIGHT) for c in spread),
    }
    _list_fits(result, spread, "spread")
    try:
        masked = decays(evidence, NEIGHBOURS, reading, "masked")
    except (MissingEvidence, OSError, ValueError) as missing:
        result.reasons.append(str(missing).replace(f"{evidence.root}/", ""))
    else:
        shares = _share(c.reaches(c.r2, STRAIGHT) for c in masked)
        result.value[f"share of configurations of neighbouring sites with {fit}"] = shares
        _list_fits(result, masked, "neighbours, masked")
    result.uncertainty["amplitudes"] = len(curves[0].amplitude)
    onsets = [float(c.amplitude[~c.untouched].min()) for c in curves if not c.untouched.all()]
    result.value["smallest amplitude with contact (N)"] = min(onsets, default=None)
    late = [c for c in curves if c.peak_amplitude > PEAK[1]]
    if late:
        first, fewest = min(c.peak_amplitude for c in late), min(c.points for c in spread)
        result.reasons.append(
            f"{len(late)} of {len(spread)} configurations peak only from {first:.3g} N on, so that as few as {fewest}"
            f" of {len(late[0].amplitude)} amplitudes are left for a power law"
        )
    weak = [f"{c.sites} ({c.r2:.3f})" for c in spread if c.r2 < STRAIGHT]
    if weak:
        result.reasons.append(f"spread sites short of {STRAIGHT:g}: {', '.join(weak)}")


def _list_fits(result: Measurement, configurations: list[EntropyDecay], kind: str) -> None:
    for c in configurations:
        name = f"{c.sites} {'site' if c.sites == 1 else 'sites'}, {kind}"
        result.value[f"adjusted R^2 (log-log), {name}"] = c.r2
        result.value[f"exponent, {name}"] = c.exponent
        result.value[f"peak (N), {name}"] = c.curve.peak_amplitude
        result.uncertainty[f"exponent's 95 % interval (+/-), {name}"] = c.half_width
        result.uncertainty[f"points of the fit, {name}"] = c.points


def everywhere(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C8: the same at every wavenumber from 2 pi/9 to 7 pi/9 (Suppl., Fig. S2)."""
    ensemble = evidence.ensemble(SPREAD)
    wavenumbers = [float(k) for k in ensemble["wavenumber"].values] if "wavenumber" in ensemble.coords else []
    if not wavenumbers:
        raise MissingEvidence(f"{SPREAD} does not vary the wavenumber")
    by_average = {
        average: [c for k in wavenumbers for c in decays(evidence, SPREAD, reading, average, wavenumber=k)]
        for average in AVERAGES
    }
    primary = by_average["energy_weighted"]
    shares = {a: _share(c.reaches(c.best, STRAIGHT_EVERYWHERE) for c in cs) for a, cs in by_average.items()}
    fit = f"share of curves with adjusted R^2 >= {STRAIGHT_EVERYWHERE:g} over {FEWEST} points or more"
    finite = [c.r2 for c in primary if np.isfinite(c.r2)]
    result.value |= {
        "share of curves that rise, peak and fall by half": _share(c.falls for c in primary),
        fit: shares["energy_weighted"],
        f"{fit}, log-log line alone": _share(c.reaches(c.r2, STRAIGHT_EVERYWHERE) for c in primary),
        "median adjusted R^2 (log-log)": float(np.median(finite)) if finite else None,
        "curves": len(primary),
    }
    result.uncertainty |= {f"{fit}, {average} mean": shares[average] for average in AVERAGES[1:]}
    result.uncertainty["fewest points of a fit"] = min(c.points for c in primary)
    late = sum(c.curve.peak >= len(c.curve.amplitude) - 3 for c in primary)
    if late:
        text = f"{late} of {len(primary)} curves have their peak among the three largest amplitudes"
        result.reasons.append(f"{text}: too few points are left for a power law")
    weak = sum(c.sites == 1 and not c.reaches(c.best, STRAIGHT_EVERYWHERE) for c in primary)
    if weak:
        result.reasons.append(f"one site falls short at {weak} of {len(wavenumbers)} wavenumbers")


def error_bars(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C9: error bars at high amplitude over those at the peak and without contact (Fig. 5)."""
    configurations = decays(evidence, SPREAD, reading, "energy_weighted", wavenumber=EXCITED)
    peaks = [c.curve.peak_amplitude for c in configurations]
    over_peak, over_quiet = [], []
    for c, peak in zip(configurations, peaks, strict=True):
        members = evidence.select(SPREAD, reading, wavenumber=EXCITED, sites=c.sites)
        error = AmplitudeCurve.of(members, "entropy/error")
        high = error.value[error.amplitude >= HIGH]
        if not high.size:
            raise MissingEvidence(f"{SPREAD} has no amplitude of {HIGH:g} N or more")
        # Where the peak is no lower than that, nothing lies behind it to compare with.
        at_peak = error.value[(error.amplitude == peak) & (peak < HIGH)]
        over_peak.append(float(high.mean() / at_peak[0]) if at_peak.size else np.nan)
        if error.untouched.any():
            over_quiet.append(float(high.mean() / error.value[error.untouched].mean()))
    growth = f"share of configurations with larger error bars from {HIGH:g} N on than"
    result.value[f"{growth} at the peak"] = _share(ratio > 1 for ratio in over_peak)
    if over_quiet:
        result.value[f"{growth} without contact"] = _share(ratio > 1 for ratio in over_quiet)
        result.value["mean ratio to the error bars without contact"] = float(np.mean(over_quiet))
    finite = [ratio for ratio in over_peak if np.isfinite(ratio)]
    if finite:
        result.value["mean ratio to the error bars at the peak"] = float(np.mean(finite))
        result.uncertainty["smallest ratio to the error bars at the peak"] = min(finite)
        result.uncertainty["largest ratio to the error bars at the peak"] = max(finite)
    result.uncertainty["configurations"] = len(configurations)
    late = sum(peak >= HIGH for peak in peaks)
    if late:
        text = f"{late} of {len(peaks)} configurations have their peak at {HIGH:g} N or above: nothing is behind it"
        result.reasons.append(text)
