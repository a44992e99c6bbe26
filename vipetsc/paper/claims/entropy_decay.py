"""C7-C9: the wavenumber entropy of the diatomic lattice against amplitude (the paper's section II.C)."""

import numpy as np
import xarray as xr

from vipetsc.io.errors import is_of_file_system
from vipetsc.paper.claims.criteria import ABRUPT, HIGH, PEAK, QUIET, SEVERAL, STRAIGHT, STRAIGHT_EVERYWHERE
from vipetsc.paper.claims.evidence import EXCITED, AmplitudeCurve, Evidence, Measurement, MissingEvidence
from vipetsc.spectra import FEWEST, doubt, normalised
from vipetsc.wording import counted

# Steps with sites that are spread, and with sites in neighbouring cells.
SPREAD = "scattering"
NEIGHBOURS = "scattering-neighbours"
AVERAGES = ("energy_weighted", "masked", "joint")


class EntropyDecay(AmplitudeCurve):
    """An ``average`` of the entropy over the amplitude, for one number of ``sites`` and one wavenumber, with its fits.

    The values are normalised to 0.01 to 1, as in the paper, and NaN if they are all equal. The power laws are fitted
    from the peak on, to ``points`` points: ``r2`` is the adjusted R^2 of the log-log line, ``best`` the better one of
    this and of the nonlinear fit, NaN without a fit. ``half_width`` is half of the 95 % interval of the line's
    ``exponent``.
    """

    def __init__(self, members: xr.Dataset, average: str) -> None:
        super().__init__(members, f"entropy/{average}")
        self.members = members
        self.sites = int(members["sites"])
        if np.ptp(self.value) > 0:
            self.value = normalised(self.value)
        else:
            self.value = np.full_like(self.value, np.nan)

        def fitted(name: str) -> float:
            return float(members[f"normalised_fits/entropy/{average}/{name}"].item())

        self.points = int(np.nan_to_num(fitted("points")))
        self.r2 = fitted("r2_log_log")
        # ``fmax`` takes the number where the other fit gave NaN.
        self.best = float(np.fmax(self.r2, fitted("r2_nonlinear")))
        self.exponent = fitted("exponent")
        self.half_width = (fitted("exponent_high") - fitted("exponent_low")) / 2

    def reaches(self, r2: float, bound: float) -> bool:
        """Return whether ``r2``, that of one of the fits, reaches the ``bound``, and the fit has enough points."""
        return bool(r2 >= bound and self.points >= FEWEST)

    @property
    def falls(self) -> bool:
        """Whether the peak lies within the range of amplitudes, and both ends are below half of it."""
        y = self.value
        return bool(0 < self.peak < len(y) - 1 and y[-1] < 0.5 and y[0] < 0.5)


def decays(evidence: Evidence, step: str, reading: str, average: str, **wanted: float) -> list[EntropyDecay]:
    """Return the curves of one ``average`` of the entropy in the sweep ``step``, one for each number of sites.

    ``wanted`` are coordinates of the sweep, as of `Evidence.select`. Raises MissingEvidence.
    """
    ensemble = evidence.ensemble(step)
    if f"normalised_fits/entropy/{average}/points" not in ensemble or "sites" not in ensemble.coords:
        raise MissingEvidence(f"{step} holds no fits of the entropy over the numbers of sites")
    sites = ensemble["sites"].values.tolist()
    return [EntropyDecay(evidence.select(step, reading, **wanted, sites=n), average) for n in sites]


def power_law(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C7: floor, abrupt rise, peak and power-law decay at 5 pi/9 (Fig. 5)."""
    spread = decays(evidence, SPREAD, reading, "energy_weighted", wavenumber=EXCITED)

    quiet = np.concatenate([c.value[c.untouched] for c in spread])
    abrupt = np.mean([c.growth_ratio(QUIET, 0.5) <= ABRUPT for c in spread])
    in_place = np.mean([PEAK[0] <= c.peak_amplitude <= PEAK[1] for c in spread])
    several = [c for c in spread if c.sites >= SEVERAL]
    # Where the peak lies at a higher amplitude, the value belongs to the rise, not to the decay.
    behind = [c.interpolate(HIGH) for c in several if c.peak_amplitude < HIGH]
    highest = None
    if several:
        highest = np.nan
        if len(behind) == len(several):
            highest = np.max(behind)
    floor = None
    if quiet.size:
        floor = quiet.max()
    result.value |= {
        "floor of the normalised entropy": floor,
        "fraction of configurations with an abrupt rise": abrupt,
        f"fraction of configurations with the peak at {PEAK[0]:g} to {PEAK[1]:g} N": in_place,
        f"normalised entropy at {HIGH:g} N behind the peak, {SEVERAL} sites or more": highest,
    }
    _list_fits(result, spread, "spread", "spread")
    try:
        _list_fits(result, decays(evidence, NEIGHBOURS, reading, "masked"), "neighbouring", "neighbours, masked")
    # Without this sweep the numbers of spread sites are reported alone.
    except (MissingEvidence, OSError, ValueError) as missing:
        if is_of_file_system(missing):
            raise
        result.reasons.append(str(missing).replace(f"{evidence.root}/", ""))

    result.uncertainty["amplitudes"] = len(spread[0].amplitude)
    onsets = (c.amplitude[~c.untouched].min() for c in spread if not c.untouched.all())
    result.value["smallest amplitude with contact (N)"] = min(onsets, default=None)
    late = [c for c in spread if c.peak_amplitude > PEAK[1]]
    if late:
        first = min(c.peak_amplitude for c in late)
        fewest = min(c.points for c in spread)
        result.reasons.append(
            f"{len(late)} of {len(spread)} configurations peak only from {first:.3g} N on, so that as few as {fewest}"
            f" of {len(late[0].amplitude)} amplitudes are left for a power law"
        )
    weak = [f"{c.sites} ({c.r2:.3f})" for c in spread if c.r2 < STRAIGHT and not doubt(c.points, c.r2)]
    if weak:
        result.reasons.append(f"spread sites short of {STRAIGHT:g}: {', '.join(weak)}")


def _list_fits(result: Measurement, configurations: list[EntropyDecay], sites: str, kind: str) -> None:
    """Add the fraction of ``configurations`` that have a power law, and the fit of each, to ``result``.

    ``sites`` and ``kind`` are the words for them in the names of numbers.
    """
    straight = np.mean([c.reaches(c.r2, STRAIGHT) for c in configurations])
    fit = f"adjusted R^2 >= {STRAIGHT:g} over {FEWEST} points or more"
    result.value[f"fraction of configurations of {sites} sites with {fit}"] = straight
    for c in configurations:
        # Numbers that cannot be relied on are missing.
        r2 = None
        exponent = None
        half_width = None
        name = f"{counted(c.sites, 'site')}, {kind}"
        doubts = doubt(c.points, c.r2)
        if c.points >= FEWEST:
            r2 = c.r2
        if doubts:
            result.reasons.append(f"no power law with {name}: {doubts}")
        else:
            exponent = c.exponent
            half_width = c.half_width
        result.value[f"adjusted R^2 (log-log), {name}"] = r2
        result.value[f"exponent, {name}"] = exponent
        result.value[f"peak (N), {name}"] = c.peak_amplitude
        result.uncertainty[f"exponent's 95 % interval (+/-), {name}"] = half_width
        result.uncertainty[f"points of the fit, {name}"] = c.points


def everywhere(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C8: rise, peak and decay at every wavenumber from 2 pi/9 to 7 pi/9 (Suppl., Fig. S2).

    Raises MissingEvidence if results are missing.
    """
    ensemble = evidence.ensemble(SPREAD)
    if "wavenumber" not in ensemble.coords:
        raise MissingEvidence(f"{SPREAD} does not vary the wavenumber")
    wavenumbers = ensemble["wavenumber"].values.tolist()
    by_average: dict[str, list[EntropyDecay]] = {}
    straight: dict[str, np.floating] = {}
    for average in AVERAGES:
        curves: list[EntropyDecay] = []
        for wavenumber in wavenumbers:
            curves += decays(evidence, SPREAD, reading, average, wavenumber=wavenumber)
        by_average[average] = curves
        straight[average] = np.mean([c.reaches(c.best, STRAIGHT_EVERYWHERE) for c in curves])
    primary = by_average["energy_weighted"]

    fit = f"fraction of curves with adjusted R^2 >= {STRAIGHT_EVERYWHERE:g} over {FEWEST} points or more"
    median = None
    finite = [c.r2 for c in primary if np.isfinite(c.r2) and c.points >= FEWEST]
    if finite:
        median = np.median(finite)
    result.value |= {
        "fraction of curves that rise, peak and fall by half": np.mean([c.falls for c in primary]),
        fit: straight["energy_weighted"],
        f"{fit}, log-log line alone": np.mean([c.reaches(c.r2, STRAIGHT_EVERYWHERE) for c in primary]),
        "median adjusted R^2 (log-log)": median,
        "curves": len(primary),
    }
    result.uncertainty |= {f"{fit}, {average} mean": straight[average] for average in AVERAGES[1:]}
    result.uncertainty["fewest points of a fit"] = min(c.points for c in primary)

    # At most two points lie behind the peak.
    late = sum(c.peak >= len(c.amplitude) - 3 for c in primary)
    if late:
        text = f"{late} of {len(primary)} curves have their peak among the three largest amplitudes"
        result.reasons.append(f"{text}: too few points are left for a power law")
    weak = sum(c.sites == 1 and not c.reaches(c.best, STRAIGHT_EVERYWHERE) for c in primary)
    if weak:
        result.reasons.append(f"one site falls short at {weak} of {len(wavenumbers)} wavenumbers")


def error_bars(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C9: error bars at high amplitude over those at the peak and without contact (Fig. 5)."""
    configurations = decays(evidence, SPREAD, reading, "energy_weighted", wavenumber=EXCITED)
    over_peak = []
    over_quiet = []
    for c in configurations:
        error = AmplitudeCurve(c.members, "entropy/error")
        high = error.value[error.amplitude >= HIGH]
        if not high.size:
            raise MissingEvidence(f"{SPREAD} has no amplitude of {HIGH:g} N or more")
        # A peak at a high amplitude itself has no error bars behind it to compare with.
        at_peak = error.value[(error.amplitude == c.peak_amplitude) & (error.amplitude < HIGH)]
        ratio = np.nan
        if at_peak.size:
            ratio = high.mean() / at_peak[0]
        over_peak.append(ratio)
        if error.untouched.any():
            over_quiet.append(high.mean() / error.value[error.untouched].mean())

    growth = f"fraction of configurations with larger error bars from {HIGH:g} N on than"
    result.value[f"{growth} at the peak"] = np.mean(np.greater(over_peak, 1))
    if over_quiet:
        result.value[f"{growth} without contact"] = np.mean(np.greater(over_quiet, 1))
        result.value["mean ratio to the error bars without contact"] = np.mean(over_quiet)
    finite = [ratio for ratio in over_peak if np.isfinite(ratio)]
    if finite:
        result.value["mean ratio to the error bars at the peak"] = np.mean(finite)
        result.uncertainty["smallest ratio to the error bars at the peak"] = min(finite)
        result.uncertainty["largest ratio to the error bars at the peak"] = max(finite)
    result.uncertainty["configurations"] = len(configurations)
    late = sum(c.peak_amplitude >= HIGH for c in configurations)
    if late:
        text = f"{late} of {len(configurations)} configurations have their peak at {HIGH:g} N or above"
        result.reasons.append(f"{text}: nothing is behind it")
