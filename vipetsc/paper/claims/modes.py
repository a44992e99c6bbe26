"""C15-C17: the reduced model's frequency-energy branches beside the lattice (the paper's section IV and supplement)."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from vipetsc.case import Case, NnmCase
from vipetsc.io.run_file import RunFile
from vipetsc.lattice import pass_bands
from vipetsc.lattice.bloch import waves_at
from vipetsc.modes.branch import KINDS
from vipetsc.modes.system import System
from vipetsc.paper.claims.claim import ClaimSpec, Criterion, Measurement
from vipetsc.paper.claims.evidence import Evidence, Member, MissingEvidence
from vipetsc.paper.claims.interband import LAWS, of_laws
from vipetsc.studies.backbone import BRANCH, initiation_of

INTERBAND, ONE_SITE = "interband", "interband-one-site"
FLAT = 1e-6  # |d ln f / d ln E| of a linear branch
FOLDS = 2  # back in energy and forth again
UNSTABLE = 1.001  # |multiplier| beyond rounding
STRAIGHT = 0.95  # adjusted R^2 "near 1"
LIMIT = 0.01  # relative distance of the last point from the bilinear limit
HERTZ = 0.1  # d ln f / d ln E of a resonator on a spring of force w^(3/2): (n - 1)/(2 (n + 1))
TOWARDS = 0.01  # distance from it
EXPONENTS, FACTOR = 0.2, 2.0  # how far the transfer's decay may be from the slope's: in exponent, in value
OPPOSED, SAME, OVERLAID = -0.9, 0.9, 0.99  # correlations of two velocities
ROUGH, SMOOTH = 0.1, 0.01  # shares of kinetic energy above the driven band: non-smooth, smooth again


def branches(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C15."""
    for law in LAWS:
        step = f"nnm-{law}" + ("" if reading == "printed" else f"-{reading}")
        file = evidence.hdf5(step, BRANCH)
        case = NnmCase.from_toml(file.attrs["case"])
        if case.lattice.reading != reading or case.contacts.law != law:
            raise MissingEvidence(f"{step} holds a branch of the law {case.contacts.law}, {case.lattice.reading}")
        names = ("energy", "frequency", "slope", "region", "multiplier_max", "kind")
        energy, frequency, slope, region, multiplier, kind = (file[n][...] for n in names)
        regular = kind == 0
        steepness = np.abs(slope * energy / frequency)
        folds = int(np.sum((kind == KINDS.index("fold-energy")) & (region == 2)))
        finding.value[f"regions, {law}"] = len(set(region[region > 0].tolist()))
        finding.value[f"largest |d ln f / d ln E| in region I, {law}"] = _largest(steepness[(region == 1) & regular])
        finding.value[f"energy folds in region II, {law}"] = folds
        finding.value[f"largest |multiplier| in region II, {law}"] = _largest(multiplier[region == 2])
        third = json.loads(file.attrs["fits"]).get("III", {})
        finding.value[f"adjusted R^2 of the slope in region III, {law}"] = third.get("adjusted_r2")
        finding.value[f"exponent of the slope in region III, {law}"] = third.get("exponent")
        finding.uncertainty[f"points in region III, {law}"] = third.get("points", 0)
        last = np.nonzero(regular)[0][-1]
        finding.value[f"last frequency (Hz), {law}"] = frequency[last]
        finding.uncertainty[f"energy of the last point (J), {law}"] = energy[last]
        grazing = np.nonzero((region == 1) & regular)[0]
        finding.value[f"energy at the end of region I (J), {law}"] = energy[grazing[-1]] if grazing.size else None
        if law == "bilinear":
            limit = System.from_case(case).closed_frequencies()[-1] / (2 * np.pi)
            finding.value["high-energy limit (Hz), bilinear"] = limit
            finding.value["last frequency's relative distance from the limit, bilinear"] = abs(
                frequency[last] / limit - 1
            )
        else:
            distance = abs(steepness[last] - HERTZ)
            finding.value["last d ln f / d ln E's distance from the 3/2 law's .1, hertz"] = distance
        if folds < FOLDS:
            megapascal = case.contacts.modulus
            at = f" at {megapascal / 1e6:g} MPa" if megapascal else ""
            finding.reasons.append(f"the {law} branch{at} has {folds} energy folds at grazing")


def _largest(values: np.ndarray) -> float | None:
    there = values[np.isfinite(values)]
    return float(there.max()) if there.size else None


def follows_slope(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C16."""
    file = evidence.hdf5(INTERBAND, "backbone.h5")
    left_out = [str(text) for text in np.atleast_1d(file.attrs.get("left_out", []))]
    found = [name for name in file if name.startswith(f"{reading}-")]
    if not any(name.startswith(f"{reading}-{law}-5-sites-30-cycles") for name in found for law in LAWS):
        raise MissingEvidence("; ".join([f"backbone.h5 holds no curve of the reading {reading}", *left_out]))
    for name in found:
        group = file[name]
        about, fitted = group.attrs, group["fitted"][...].astype(bool)
        law, sites, cycles = (name.split("-")[i] for i in (1, 2, 4))
        main = (sites, cycles) == ("5", "30")
        words = law if main else f"{law}, {sites} site{'s' if sites != '1' else ''}, {cycles} cycles"
        energy, ibtet = group["energy"][...][fitted], group["ibtet"][...][fitted]
        ratio = np.log(ibtet / (_slope_at(group, energy) / about["divisor"] + about["floor"]))
        finding.value[f"adjusted R^2 in region III, {words}"] = float(about["r2_adjusted"])
        finding.value[f"exponent of the transfer, {words}"] = float(about["exponent"])
        finding.value[f"exponent of the slope, {words}"] = float(about["slope_exponent"])
        finding.value[f"mean factor between transfer and slope, {words}"] = float(np.exp(np.sqrt(np.mean(ratio**2))))
        difference = abs(float(about["exponent"] - about["slope_exponent"]))
        finding.value[f"difference of the exponents, {words}"] = difference
        half = (about["exponent_high"] - about["exponent_low"]) / 2
        finding.uncertainty[f"transfer exponent's 95 % interval (+/-), {words}"] = float(half)
        finding.uncertainty[f"points of the fit, {words}"] = int(fitted.sum())
        if main and difference > EXPONENTS:
            finding.reasons.append(
                f"{law}: the transfer falls as E^{about['exponent']:.2f}, the slope there as"
                f" E^{about['slope_exponent']:.2f}"
            )
        if about["branch_reading"] != reading:
            finding.reasons.append(f"{words}: the branch has the reading {about['branch_reading']}")
    finding.reasons += [text for text in left_out if text.startswith(reading)]


def _slope_at(group: object, energy: np.ndarray) -> np.ndarray:
    """The branch's slope (point) in Hz/J at energies (point) in J, within region III, in logarithms."""
    known, slope, region = (group[f"branch/{n}"][...] for n in ("energy", "slope", "region"))
    inside = (region == 3) & np.isfinite(slope) & (slope > 0)
    order = np.argsort(known[inside])
    return np.exp(np.interp(np.log(energy), np.log(known[inside][order]), np.log(slope[inside][order])))


@dataclass(frozen=True)
class Motion:
    """Host and resonator of the contact cell of one run: velocities (t, 2) in m/s, and what tells their regime.

    ``correlation`` of the two velocities; ``above``: share of the pair's kinetic energy at frequencies above the
    driven band, of the whole record under a Hann window.
    """

    case: Case
    episodes: int
    velocity: np.ndarray
    correlation: float
    above: float

    @classmethod
    def of(cls, member: Member, run: RunFile) -> Motion:
        """The motion in ``run``; raises MissingEvidence if the cell was not recorded."""
        cell, site = run.model.chain.cell, run.site_cells[0]
        at = run.nearest(site)
        if "velocity" not in run.file or run.cells[at] != site:
            raise MissingEvidence(f"the velocity of cell {site} was not recorded")
        pair = [cell.host, cell.resonator]
        velocity = run.velocity[:, at][:, pair]
        correlation = float(np.corrcoef(velocity.T)[0, 1])
        spectrum = np.abs(np.fft.rfft(velocity * np.hanning(len(velocity))[:, None], axis=0)) ** 2 @ run.masses[pair]
        frequency = 2 * np.pi * np.fft.rfftfreq(len(velocity), run.field_interval)
        waves = waves_at(cell, run.model.drive.frequency)
        edge = pass_bands(cell)[waves[0][0] - 1].high if waves else run.model.drive.frequency
        above = float(spectrum[frequency > edge].sum() / spectrum.sum())
        return cls(member.case, member.episodes, velocity, correlation, above)

    def alike(self, other: Motion) -> float:
        """Correlation of the resonator's velocity with that of ``other`` at the same times."""
        n = min(len(self.velocity), len(other.velocity))
        return float(np.corrcoef(self.velocity[:n, 1], other.velocity[:n, 1])[0, 1])


def portraits(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C17."""
    ensemble = evidence.ensemble(ONE_SITE)
    for law in LAWS:
        motions = []
        for member in evidence.members(ONE_SITE, evidence.place(ONE_SITE, reading, law=law)):
            with RunFile(evidence.path(ONE_SITE, member.folder.name, "run.h5")) as run:
                motions.append(Motion.of(member, run))
        touching = [m for m in motions if m.episodes]
        if len(touching) < 2 or motions[0].episodes:
            raise MissingEvidence(f"{ONE_SITE}, {law}: one amplitude without contact and two with are needed")
        first, last = touching[0], touching[-1]
        finding.value[f"I: correlation of host and resonator, {law}"] = motions[0].correlation
        finding.value[f"II: correlation with the motion without contact, {law}"] = first.alike(motions[0])
        finding.value[f"III: largest share of energy above the driven band, {law}"] = max(m.above for m in touching)
        finding.value[f"IV: correlation of host and resonator, {law}"] = last.correlation
        finding.value[f"IV: share of energy above the driven band, {law}"] = last.above
        for m in touching[:-1]:
            finding.value[f"correlation at {m.case.drive.amplitude:g} N, {law}"] = m.correlation
        finding.uncertainty[f"amplitudes, {law}"] = len(motions)
        grazing = finding.value[f"II: correlation with the motion without contact, {law}"]
        if grazing < SAME:
            try:
                over = first.case.drive.amplitude / initiation_of(ensemble.folder, first.case).onset - 1
            except OSError:
                over = np.nan
            beyond = f", {100 * over:.2g} % above first contact," if np.isfinite(over) else ""
            finding.reasons.append(
                f"{law}: at {first.case.drive.amplitude:g} N{beyond} the resonator's motion has already left the linear"
                " one"
            )


MODES = (
    ClaimSpec(
        "C15",
        "The branch is flat, folds at grazing with unstable orbits, then its slope falls as a power law to a limit.",
        "branch-out-of-phase",
        (
            *of_laws(
                ("regions", {"low": 4}),
                ("largest |d ln f / d ln E| in region I", {"high": FLAT}),
                ("energy folds in region II", {"low": FOLDS}),
                ("largest |multiplier| in region II", {"low": UNSTABLE}),
                ("adjusted R^2 of the slope in region III", {"low": STRAIGHT}),
            ),
            Criterion("last frequency's relative distance from the limit, bilinear", high=LIMIT),
            Criterion("last d ln f / d ln E's distance from the 3/2 law's .1, hertz", high=TOWARDS),
        ),
        branches,
    ),
    ClaimSpec(
        "C16",
        "Against energy the transfer follows the slope of the branch, with a power law in region III.",
        "ibtet_backbone-{reading}-5-sites-30-cycles",
        of_laws(
            ("adjusted R^2 in region III", {"low": STRAIGHT}),
            ("difference of the exponents", {"high": EXPONENTS}),
            ("mean factor between transfer and slope", {"high": FACTOR}),
        ),
        follows_slope,
    ),
    ClaimSpec(
        "C17",
        "Phase portraits in the lattice pass through the branch's regimes: linear, grazing, non-smooth, in phase.",
        "phase_regimes-hertz-{reading}-1-site-30-cycles",
        of_laws(
            ("I: correlation of host and resonator", {"high": OPPOSED}),
            ("II: correlation with the motion without contact", {"low": SAME}),
            ("III: largest share of energy above the driven band", {"low": ROUGH}),
            ("IV: correlation of host and resonator", {"low": OVERLAID}),
            ("IV: share of energy above the driven band", {"high": SMOOTH}),
        ),
        portraits,
    ),
)
