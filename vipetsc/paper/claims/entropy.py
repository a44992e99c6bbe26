"""C7-C9: the wavenumber entropy of the diatomic lattice against amplitude (the paper's section II.C)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vipetsc.paper.claims.claim import ClaimSpec, Criterion, Measurement
from vipetsc.paper.claims.evidence import Curve, Evidence, MissingEvidence

SPREAD, NEIGHBOURS = "scattering", "scattering-neighbours"
EXCITED = 5 * np.pi / 9  # rad/cell
CONFIGURATIONS, MOST, NEARLY_ALL = 6, 4, 30  # the paper's six; "the majority" of them, "nearly all" of 36
WAVENUMBERS = 6
STRAIGHT, STRAIGHT_EVERYWHERE = 0.95, 0.9  # adjusted R^2
FEWEST = 4  # points of a fit: three lie near some power law by chance
QUIET = 0.1  # normalised entropy that is still "nearly zero"
ABRUPT = 10**0.5  # ratio of amplitudes, half a decade, in which an abrupt rise goes from QUIET to half the peak
PEAK = 0.9, 1.8  # N
HIGH = 10.0  # N, the paper's high amplitude
FALLEN = 0.17  # normalised entropy at HIGH, of configurations of at least SEVERAL sites
SEVERAL = 3

# Numbers that decide, by name.
FLOOR = "floor of the normalised entropy"
RISES = "share of configurations with an abrupt rise"
PEAKS = f"share of configurations with the peak at {PEAK[0]:g} to {PEAK[1]:g} N"
AT_HIGH = f"normalised entropy at {HIGH:g} N behind the peak, {SEVERAL} sites or more"
SPREAD_LAW = f"share of configurations of spread sites with adjusted R^2 >= {STRAIGHT:g} over {FEWEST} points or more"
NEIGHBOURS_LAW = (
    f"share of configurations of neighbouring sites with adjusted R^2 >= {STRAIGHT:g} over {FEWEST} points or more"
)
TREND = "share of curves that rise, peak and fall by half"
LAW = f"share of curves with adjusted R^2 >= {STRAIGHT_EVERYWHERE:g} over {FEWEST} points or more"
OVER_PEAK = f"share of configurations with larger error bars from {HIGH:g} N on than at the peak"
OVER_QUIET = f"share of configurations with larger error bars from {HIGH:g} N on than without contact"


@dataclass(frozen=True)
class Row:
    """The curve of one configuration and wavenumber, and the power laws of its fall.

    ``r2``, ``r2_nonlinear`` are adjusted and NaN without a fit; ``exponent`` (log-log) has the interval ``low`` to
    ``high``; ``points`` from the peak on.
    """

    sites: int
    curve: Curve
    r2: float
    r2_nonlinear: float
    exponent: float
    low: float
    high: float
    points: int

    @property
    def best(self) -> float:
        """The better adjusted R^2 of the two fits; NaN without one."""
        return float(np.fmax(self.r2, self.r2_nonlinear))

    def straight(self, r2: float, bound: float) -> bool:
        """Whether ``r2``, one of its own, reaches ``bound`` over enough points."""
        return bool(r2 >= bound and self.points >= FEWEST)

    @property
    def falls(self) -> bool:
        """Whether the peak lies between the ends, and less than half of it is left at the upper end."""
        y = self.curve.normalised()
        return bool(0 < self.curve.peak < len(y) - 1 and y[-1] < 0.5 and y[0] < 0.5)


def rows(evidence: Evidence, step: str, reading: str, average: str, **fixed: float) -> list[Row]:
    """The configurations of a sweep with one ``average`` of the entropy; raises MissingEvidence."""
    return list(_rows(evidence, step, reading, average, fixed))


def _rows(evidence: Evidence, step: str, reading: str, average: str, fixed: dict[str, float]) -> Iterator[Row]:
    ensemble = evidence.ensemble(step)
    fits = f"fits/entropy/{average}"
    if fits not in ensemble or "sites" not in ensemble.dimensions:
        raise MissingEvidence(f"{step} holds no fits of the entropy over the numbers of sites")
    along = ensemble.dimensions.index("amplitude")
    for count in ensemble.values("sites"):
        place = evidence.place(step, reading, **fixed, sites=int(count))
        curve = evidence.curve(step, f"entropy/{average}", place)
        there = (*place[:along], *place[along + 1 :])
        names = ("r2_log_log", "r2_nonlinear", "exponent", "exponent_low", "exponent_high", "points")
        r2, nonlinear, *law, points = (float(ensemble.file[f"{fits}/{n}"][there]) for n in names)
        yield Row(int(count), curve, r2, nonlinear, *law, int(points) if np.isfinite(points) else 0)


def _share(flags: list[bool]) -> float:
    return sum(flags) / len(flags)


def power_law(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C7."""
    spread = rows(evidence, SPREAD, reading, "energy_weighted", wavenumber=EXCITED)
    value, about = finding.value, finding.uncertainty
    quiet = np.concatenate([c.normalised()[c.untouched] for c in _curves(spread)])
    value[FLOOR] = float(quiet.max()) if quiet.size else None
    value[RISES] = _share([_rise(c) <= ABRUPT for c in _curves(spread)])
    value[PEAKS] = _share([PEAK[0] <= c.amplitude[c.peak] <= PEAK[1] for c in _curves(spread)])
    several = [_at_high(r.curve) for r in spread if r.sites >= SEVERAL]
    value[AT_HIGH] = float(np.max(several)) if several else None
    value[SPREAD_LAW] = _share([r.straight(r.r2, STRAIGHT) for r in spread])
    for row in spread:
        _tell(finding, row, "spread")
    try:
        masked = rows(evidence, NEIGHBOURS, reading, "masked")
    except MissingEvidence as missing:
        finding.reasons.append(str(missing))
    else:
        value[NEIGHBOURS_LAW] = _share([r.straight(r.r2, STRAIGHT) for r in masked])
        for row in masked:
            _tell(finding, row, "neighbours, masked")
    about["amplitudes"] = len(spread[0].curve.amplitude)
    late = [c for c in _curves(spread) if c.amplitude[c.peak] > PEAK[1]]
    onset = [float(c.amplitude[~c.untouched].min()) for c in _curves(spread) if not c.untouched.all()]
    value["smallest amplitude with contact (N)"] = min(onset, default=None)
    if late:
        finding.reasons.append(
            f"{len(late)} of {len(spread)} configurations peak only from"
            f" {min(c.amplitude[c.peak] for c in late):.3g} N on, so that as few as {min(r.points for r in spread)} of"
            f" {len(late[0].amplitude)} amplitudes are left for a power law"
        )
    weak = [f"{r.sites} ({r.r2:.3f})" for r in spread if not r.r2 >= STRAIGHT and np.isfinite(r.r2)]
    if weak:
        finding.reasons.append(f"spread sites short of {STRAIGHT:g}: {', '.join(weak)}")


def _curves(found: list[Row]) -> list[Curve]:
    return [row.curve for row in found]


def _rise(curve: Curve) -> float:
    """Ratio of amplitudes in which the normalised entropy rises from ``QUIET`` to half its peak; NaN if it does not."""
    return Curve(curve.amplitude, curve.normalised(), curve.episodes).rise(QUIET, 0.5)


def _at_high(curve: Curve) -> float:
    """The normalised entropy at ``HIGH``; NaN if the peak is not below it."""
    if curve.amplitude[curve.peak] >= HIGH:
        return float("nan")
    return Curve(curve.amplitude, curve.normalised(), curve.episodes).at(HIGH)


def _tell(finding: Measurement, row: Row, kind: str) -> None:
    name = f"{row.sites} {'site' if row.sites == 1 else 'sites'}, {kind}"
    finding.value[f"adjusted R^2 (log-log), {name}"] = row.r2
    finding.value[f"exponent, {name}"] = row.exponent
    finding.value[f"peak (N), {name}"] = row.curve.amplitude[row.curve.peak]
    finding.uncertainty[f"exponent's 95 % interval (+/-), {name}"] = (row.high - row.low) / 2
    finding.uncertainty[f"points of the fit, {name}"] = row.points


def everywhere(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C8."""
    ensemble = evidence.ensemble(SPREAD)
    wavenumbers = ensemble.values("wavenumber") if "wavenumber" in ensemble.dimensions else []
    averages = ("energy_weighted", "masked", "joint")
    shares = {}
    for average in averages:
        found = [r for k in wavenumbers for r in rows(evidence, SPREAD, reading, average, wavenumber=float(k))]
        if not found:
            raise MissingEvidence(f"{SPREAD} does not vary the wavenumber")
        shares[average] = _share([r.straight(r.best, STRAIGHT_EVERYWHERE) for r in found])
        if average == averages[0]:
            primary = found
    value = finding.value
    value[TREND] = _share([r.falls for r in primary])
    value[LAW] = shares["energy_weighted"]
    value[f"{LAW}, log-log line alone"] = _share([r.straight(r.r2, STRAIGHT_EVERYWHERE) for r in primary])
    known = [r.r2 for r in primary if np.isfinite(r.r2)]
    value["median adjusted R^2 (log-log)"] = float(np.median(known)) if known else None
    value["curves"] = len(primary)
    for average in averages[1:]:
        finding.uncertainty[f"{LAW}, {average} mean"] = shares[average]
    finding.uncertainty["fewest points of a fit"] = min(r.points for r in primary)
    late = sum(r.curve.peak >= len(r.curve.amplitude) - 3 for r in primary)
    if late:
        finding.reasons.append(
            f"{late} of {len(primary)} curves have their peak among the three largest amplitudes: too few points are"
            " left for a power law"
        )
    weak = [r for r in primary if r.sites == 1 and not r.straight(r.best, STRAIGHT_EVERYWHERE)]
    if weak:
        finding.reasons.append(f"one site falls short at {len(weak)} of {len(wavenumbers)} wavenumbers")


def error_bars(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C9."""
    found = rows(evidence, SPREAD, reading, "energy_weighted", wavenumber=EXCITED)
    over_peak, over_quiet = [], []
    for row in found:
        place = evidence.place(SPREAD, reading, wavenumber=EXCITED, sites=row.sites)
        error = evidence.curve(SPREAD, "entropy/error", place)
        loud = error.value[error.amplitude >= HIGH]
        if not loud.size:
            raise MissingEvidence(f"{SPREAD} has no amplitude of {HIGH:g} N or more")
        peak = row.curve.amplitude[row.curve.peak]
        # Where the peak is no lower than that, nothing lies behind it to compare with.
        at_peak = error.value[(error.amplitude == peak) & (peak < HIGH)]
        over_peak.append(float(loud.mean() / at_peak[0]) if at_peak.size else np.nan)
        if error.untouched.any():
            over_quiet.append(float(loud.mean() / error.value[error.untouched].mean()))
    finding.value[OVER_PEAK] = _share([ratio > 1 for ratio in over_peak])
    if over_quiet:
        finding.value[OVER_QUIET] = _share([ratio > 1 for ratio in over_quiet])
        finding.value["mean ratio to the error bars without contact"] = float(np.mean(over_quiet))
    known = [ratio for ratio in over_peak if np.isfinite(ratio)]
    if known:
        finding.value["mean ratio to the error bars at the peak"] = float(np.mean(known))
        finding.uncertainty["smallest ratio to the error bars at the peak"] = min(known)
        finding.uncertainty["largest ratio to the error bars at the peak"] = max(known)
    finding.uncertainty["configurations"] = len(found)
    late = [r for r in found if r.curve.amplitude[r.curve.peak] >= HIGH]
    if late:
        finding.reasons.append(
            f"{len(late)} of {len(found)} configurations have their peak at {HIGH:g} N or above: nothing is behind it"
        )


ENTROPY = (
    ClaimSpec(
        "C7",
        "Entropy against amplitude has a floor, an abrupt rise, a peak and a power-law decay.",
        "entropy-{reading}-5pi-9-energy_weighted",
        (
            Criterion(FLOOR, high=QUIET),
            Criterion(RISES, low=MOST, of=CONFIGURATIONS),
            Criterion(PEAKS, low=MOST, of=CONFIGURATIONS),
            Criterion(AT_HIGH, high=FALLEN),
            Criterion(SPREAD_LAW, low=MOST, of=CONFIGURATIONS),
            Criterion(NEIGHBOURS_LAW, low=MOST, of=CONFIGURATIONS),
        ),
        power_law,
    ),
    ClaimSpec(
        "C8",
        "Rise, peak and power-law decay are the same for wavenumbers from 2π/9 to 7π/9.",
        "entropy_all-{reading}-energy_weighted",
        (
            Criterion(TREND, low=NEARLY_ALL, of=CONFIGURATIONS * WAVENUMBERS),
            Criterion(LAW, low=NEARLY_ALL, of=CONFIGURATIONS * WAVENUMBERS),
        ),
        everywhere,
    ),
    ClaimSpec(
        "C9",
        "The spread of the entropy over the lattice grows at high amplitude.",
        "entropy-{reading}-5pi-9-energy_weighted",
        (
            Criterion(
                OVER_PEAK,
                low=MOST,
                of=CONFIGURATIONS,
            ),
            Criterion(
                OVER_QUIET,
                low=MOST,
                of=CONFIGURATIONS,
            ),
        ),
        error_bars,
    ),
)
