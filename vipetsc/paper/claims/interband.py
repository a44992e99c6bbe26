"""C10-C14: energy that passes to higher bands of the four-band lattice (the paper's section III and supplement)."""

from __future__ import annotations

import numpy as np

from vipetsc.paper.claims.claim import ClaimSpec, Criterion, Measurement
from vipetsc.paper.claims.evidence import Curve, Evidence, MissingEvidence

STEP, AMPLITUDES, DESIGN = "interband", "interband-amplitudes", "design"
LAWS = "hertz", "bilinear"
PAPER = 0.1, 0.5  # the paper's (lambda, eta)
GRID = 0.1  # the spacing of the grid that it searched; an optimum off it lies within half of that
FLOOR = 10**-4.5, 10**-3.5  # "on the order of .01 %"
LOW = 10  # times the floor: up to there the transfer has not set in
SUDDEN = 10**0.5  # ratio of amplitudes, half a decade, in which a sudden onset leads to half the maximum
MAXIMUM = 0.28, 0.36  # "roughly .3-.35"
ONE_SITE = 0.05, 0.15  # "approximately 10 per cent"
ALIKE, NEAR = 0.9, 2.0  # correlation of two curves' logarithms, ratio of their peaks' amplitudes
SUM = 0.01  # of the total energy

# Numbers that decide, by name.
LAMBDA, ETA = (f"{name} at the optimum of a grid of {GRID:g}" for name in ("lambda", "eta"))


def optimum(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C10."""
    file = evidence.hdf5(DESIGN, "design.h5")
    readings, costs = (list(file[n].asstr()[...]) for n in ("reading", "cost"))
    if reading not in readings:
        raise MissingEvidence(f"design has no reading {reading}")
    row = readings.index(reading)
    lam, eta = file["lambda"][...], file["eta"][...]
    for name in costs:
        at = row, costs.index(name)
        finding.value[f"lambda at the optimum, {name}"] = float(file["optimum_lambda"][at])
        finding.value[f"eta at the optimum, {name}"] = float(file["optimum_eta"][at])
    weighted = row, costs.index("weighted")
    # The paper searched a coarse grid; a finer one has its optimum beside.
    rows, columns = _multiples(lam), _multiples(eta)
    cost = np.where(file["out_of_phase"][row], file["weighted"][row], -np.inf)[np.ix_(rows, columns)]
    i, j = np.unravel_index(np.argmax(cost), cost.shape)
    finding.value[LAMBDA] = float(lam[rows][i])
    finding.value[ETA] = float(eta[columns][j])
    near = int(np.argmin(abs(lam - PAPER[0]))), int(np.argmin(abs(eta - PAPER[1])))
    finding.value["u2 and u3 out of phase on band 2 at the paper's cell (1 = yes)"] = int(
        file["out_of_phase"][row][near]
    )
    best = float(file["optimum_value"][weighted])
    finding.value["weighted cost of the paper's cell over the optimum's"] = float(file["paper_value"][weighted]) / best
    for name, values in (("lambda", lam), ("eta", eta)):
        finding.uncertainty[f"spacing of {name}"] = float(np.diff(values).max(initial=0.0))


def _multiples(values: np.ndarray) -> np.ndarray:
    """Indices of the multiples of ``GRID`` among ``values``; of all of them if there are fewer than two."""
    found = np.nonzero(np.abs(values / GRID - np.round(values / GRID)) < 1e-6)[0]
    return found if found.size > 1 else np.arange(len(values))


def _curve(evidence: Evidence, reading: str, law: str, sites: int, cycles: int) -> Curve:
    place = evidence.place(STEP, reading, law=law, sites=sites, cycles=cycles)
    return evidence.curve(STEP, "ibtet", place)


def _floor(curve: Curve) -> float:
    return float(curve.value[curve.untouched].mean()) if curve.untouched.any() else np.nan


def onset(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C11."""
    maxima = []
    for law in LAWS:
        curve = _curve(evidence, reading, law, 5, 30)
        floor, top = _floor(curve), float(curve.value[curve.peak])
        finding.value[f"floor, {law}"] = floor
        finding.value[f"ratio of amplitudes from the floor to half the maximum, {law}"] = curve.rise(
            LOW * floor, top / 2
        )
        finding.value[f"maximum, {law}"] = top
        finding.value[f"amplitude of the maximum (N), {law}"] = float(curve.amplitude[curve.peak])
        finding.value[f"transfer at the largest amplitude, {law}"] = float(curve.value[-1])
        # The larger of its two neighbours shows how well the grid of amplitudes resolves the maximum.
        beside = curve.value[max(curve.peak - 1, 0) : curve.peak + 2]
        finding.uncertainty[f"fall to the better neighbour of the maximum, {law}"] = top - float(
            np.sort(beside)[-2:][0]
        )
        finding.uncertainty[f"amplitudes, {law}"] = len(curve.amplitude)
        maxima.append(top)
    finding.uncertainty["spread of the maxima between the laws"] = float(np.ptp(maxima))
    if max(maxima) < MAXIMUM[0] and reading == "printed":
        finding.reasons.append("the resonator's spring lambda k of the printed equations gives less transfer")


def medium_most(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C12."""
    for law in LAWS:
        curve = evidence.curve(AMPLITUDES, "ibtet", evidence.place(AMPLITUDES, reading, law=law))
        if len(curve.amplitude) < 3:
            raise MissingEvidence(
                f"{AMPLITUDES} has {len(curve.amplitude)} amplitudes; low, medium and high are needed"
            )
        low, medium, high = (float(curve.value[i]) for i in (0, len(curve.value) // 2, -1))
        finding.value[f"medium over low amplitude, {law}"] = medium / low
        finding.value[f"medium over high amplitude, {law}"] = medium / high
        for name, share in (("low", low), ("medium", medium), ("high", high)):
            finding.value[f"share of the upper bands, {name}, {law}"] = share
    for name, i in (("low", 0), ("medium", len(curve.value) // 2), ("high", -1)):
        finding.uncertainty[f"{name} amplitude (N)"] = float(curve.amplitude[i])


def bands_sum(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C13."""
    worst, instants, middle = [], [], 0.0
    for law in LAWS:
        members = evidence.members(AMPLITUDES, evidence.place(AMPLITUDES, reading, law=law), "bands")
        for member in members:
            total, parts = member.analysis["bands/total"][...], member.analysis["bands/energy"][...].sum(axis=0)
            after = member.analysis["time"][...] >= member.case.model().drive.duration
            worst.append(abs(parts.mean() / total.mean() - 1))
            instants.append(float(np.mean(np.abs(parts[after] - total[after]) / total[after])))
        middle = members[len(members) // 2].amplitude
    finding.value["largest error of the mean over the record"] = max(worst)
    finding.value["mean error at an instant after the drive, largest of the runs"] = max(instants)
    finding.uncertainty["runs"] = len(worst)
    finding.figure = f"band_energies-hertz-{reading}-5-sites-30-cycles-{middle:.4g}N"
    finding.reasons.append(
        "the parts are orthogonal over time, not at an instant: their sum beats about the total"
        f" by {100 * max(instants):.2g} % on the average in the worst run"
    )


def one_site(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C14."""
    for law in LAWS:
        many, short, single = (_curve(evidence, reading, law, *kind) for kind in ((5, 30), (5, 15), (1, 30)))
        finding.value[f"maximum with one site, {law}"] = float(single.value.max())
        finding.value[f"maximum with one site over that with five, {law}"] = float(
            single.value.max() / many.value.max()
        )
        shared, i, j = np.intersect1d(many.amplitude, short.amplitude, return_indices=True)
        finding.value[f"correlation of 15 and 30 cycles, {law}"] = (
            float(np.corrcoef(np.log(many.value[i]), np.log(short.value[j]))[0, 1]) if len(shared) > 2 else np.nan
        )
        peaks = [float(c.amplitude[c.peak]) for c in (many, short)]
        finding.value[f"ratio of the peaks' amplitudes, 15 and 30 cycles, {law}"] = max(peaks) / min(peaks)
        finding.value[f"maximum with 15 cycles, {law}"] = float(short.value.max())
        finding.uncertainty[f"amplitudes, {law}"] = len(shared)


def of_laws(*criteria: tuple[str, dict]) -> tuple[Criterion, ...]:
    """Each criterion (name, bounds) once for each law."""
    return tuple(Criterion(f"{name}, {law}", **bounds) for law in LAWS for name, bounds in criteria)


INTERBAND = (
    ClaimSpec(
        "C10",
        "The four-band cell is best at (λ, η) = (.1, .5), where host and resonator move out of phase on band 2.",
        "cost_maps",
        (
            Criterion(LAMBDA, low=PAPER[0] - GRID / 2, high=PAPER[0] + GRID / 2),
            Criterion(ETA, low=PAPER[1] - GRID / 2, high=PAPER[1] + GRID / 2),
            Criterion("u2 and u3 out of phase on band 2 at the paper's cell (1 = yes)", low=1),
        ),
        optimum,
    ),
    ClaimSpec(
        "C11",
        "The transfer has a floor of about 1e-4, sets in suddenly, and reaches .30-.35 with five sites for both laws.",
        "ibtet-{reading}",
        of_laws(
            ("floor", {"low": FLOOR[0], "high": FLOOR[1]}),
            ("ratio of amplitudes from the floor to half the maximum", {"high": SUDDEN}),
            ("maximum", {"low": MAXIMUM[0], "high": MAXIMUM[1]}),
        ),
        onset,
    ),
    ClaimSpec(
        "C12",
        "Medium amplitude fills the upper bands most.",
        "transfer_dispersions-{reading}-5-sites-30-cycles",
        of_laws(("medium over low amplitude", {"low": 1}), ("medium over high amplitude", {"low": 1})),
        medium_most,
    ),
    ClaimSpec(
        "C13",
        "The energies of all bands and gaps sum to the total kinetic energy.",
        "band_energies-hertz-{reading}-5-sites-30-cycles",
        (Criterion("largest error of the mean over the record", high=SUM),),
        bands_sum,
    ),
    ClaimSpec(
        "C14",
        "One site transfers at most about a tenth; a burst of 15 cycles shows the same trend as one of 30.",
        "ibtet-{reading}",
        of_laws(
            ("maximum with one site", {"low": ONE_SITE[0], "high": ONE_SITE[1]}),
            ("maximum with one site over that with five", {"high": 1}),
            ("correlation of 15 and 30 cycles", {"low": ALIKE}),
            ("ratio of the peaks' amplitudes, 15 and 30 cycles", {"high": NEAR}),
        ),
        one_site,
    ),
)
