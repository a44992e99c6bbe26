"""C1-C6: what the diatomic lattice does at low, medium and high amplitude (the paper's section II.B)."""

from __future__ import annotations

import numpy as np

from vipetsc.lattice import bloch, max_group_velocity, pass_bands
from vipetsc.paper.claims.claim import ClaimSpec, Criterion, Measurement
from vipetsc.paper.claims.evidence import Evidence, Member, MissingEvidence
from vipetsc.paper.claims.triple import OPTICAL, AmplitudeTriple
from vipetsc.spectra import Dispersion, ridge

EXCITED = 5 * np.pi / 9  # rad/cell, of the paper's section II
BINS = 1  # how far, in bins of the transform, a ridge may lie from the branch
STILL = 0.01  # share of the energy that may change its wavenumber before a spectrum is not constant
NEW, MORE = 0.10, 10  # share at new wavenumbers that counts as scattering, and how many times that of the low amplitude
BESIDE = 0.02  # half-width of the band around a branch over the top edge of the pass bands
BOUND = 0.95  # share of the energy that has to lie in there
MOST = 0.5  # "a majority of the incident energy"
NATIVE = 7, 8  # wavenumber bins that the packet starts in
BY_FOURIER, BY_WAVELET = 0.99, 0.85
RECONSTRUCTED = 0.01  # the paper's one per cent

# Numbers that decide, by name, where the name holds a number.
BRANCHES = f"share within {100 * BESIDE:g} % of the top edge from the Bloch branches"
IN_FOURIER, IN_WAVELET = (f"smallest share in bins {NATIVE[0]} and {NATIVE[1]}, {w}" for w in ("Fourier", "wavelet"))


def on_the_branch(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C1."""
    trio = AmplitudeTriple.of(evidence, reading, "dispersion")
    analysis, cell = trio.low.analysis, trio.low.case.unit_cell()
    if trio.low.episodes:
        raise MissingEvidence(f"the run at {trio.low.amplitude:g} N is not linear: {trio.low.episodes} contacts")
    spectrum = Dispersion(*(analysis[n][...] for n in ("wavenumber", "frequency", "dispersion")))
    wavenumber, frequency = ridge(spectrum)
    branch = bloch(cell, wavenumber).frequency[:, OPTICAL - 1]
    away = np.abs(frequency - branch) / (spectrum.frequency[1] - spectrum.frequency[0])
    loudest = spectrum.wavenumber[np.argmax(spectrum.energy.sum(axis=1))]
    step = spectrum.wavenumber[1] - spectrum.wavenumber[0]
    finding.value["ridge's largest distance from the optical branch"] = away.max()
    finding.value["loudest wavenumber's distance from 5 pi/9"] = abs(loudest - EXCITED) / step
    finding.value["wavenumber of the drive on the optical branch (rad/cell)"] = trio.wavenumber
    finding.value["ridge's mean distance (bins)"] = away.mean()
    finding.uncertainty["frequency bin (rad/s)"] = spectrum.frequency[1] - spectrum.frequency[0]
    finding.uncertainty["wavenumber bin (rad/cell)"] = step
    finding.uncertainty["points of the ridge"] = len(wavenumber)


def unchanged(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C2."""
    trio = AmplitudeTriple.of(evidence, reading, "wavenumber_content")
    model, time = trio.low.case.model(), trio.low.analysis["time"][...]
    fastest = max_group_velocity(model.chain.cell, OPTICAL)[2]
    there = (time >= trio.duration) & (time <= model.chain.cells / fastest)
    if there.sum() < 2:
        raise MissingEvidence("the packet reaches the far end before the drive ends, or the record is too short")
    content = trio.low.analysis["wavenumber_content"][there]
    share = content / content.sum(axis=1, keepdims=True)
    moved = 0.5 * np.abs(share - share[0]).sum(axis=1)
    finding.value["contact episodes at low amplitude"] = trio.low.episodes
    finding.value["largest share of the energy that changes its wavenumber"] = moved.max()
    finding.uncertainty["mean over time of that share"] = moved.mean()
    finding.uncertainty["samples"] = int(there.sum())


def scattered(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C3."""
    trio = AmplitudeTriple.of(evidence, reading, "wavenumber_content", "dispersion")
    (low, _), (medium, deviation) = trio.generated(trio.low), trio.generated(trio.medium)
    finding.value["share at new wavenumbers, medium amplitude"] = medium
    finding.value["share at new wavenumbers, medium over low amplitude"] = medium / low
    finding.value[BRANCHES] = _beside_branches(trio.medium)
    finding.value["share at new wavenumbers, low amplitude"] = low
    finding.value[f"{BRANCHES}, low amplitude"] = _beside_branches(trio.low)
    finding.value["main lobe's half-width (rad/cell)"] = trio.lobe
    finding.uncertainty["deviation over time of the share at new wavenumbers"] = deviation
    trio.silent(evidence, finding, trio.medium)


def _beside_branches(member: Member) -> float:
    """Share of the 2-D spectrum's energy within ``BESIDE`` times the top edge of a branch."""
    wavenumber, frequency, energy = (member.analysis[n][...] for n in ("wavenumber", "frequency", "dispersion"))
    cell = member.case.unit_cell()
    away = np.abs(frequency[None, :, None] - bloch(cell, wavenumber).frequency[:, None, :]).min(axis=2)
    return float(energy[away <= BESIDE * pass_bands(cell)[-1].high].sum() / energy.sum())


def reflected(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C4."""
    trio = AmplitudeTriple.of(evidence, reading, "wavenumber_content", "kinetic_energy")
    shares = {}
    for name, member in (("low", trio.low), ("medium", trio.medium), ("high", trio.high)):
        shares[name], deviation = trio.generated(member)
        finding.value[f"share at new wavenumbers, {name} amplitude"] = shares[name]
        finding.uncertainty[f"deviation over time of the share at new wavenumbers, {name} amplitude"] = deviation
        returned, deviation = _returned(trio, member)
        finding.value[f"share of the incident energy reflected, {name} amplitude"] = returned
        finding.uncertainty[f"deviation over time of the share reflected, {name} amplitude"] = deviation
    finding.value["new wavenumbers, high over medium amplitude"] = shares["high"] / shares["medium"]
    trio.silent(evidence, finding, trio.medium)
    trio.hardly(finding)


def _returned(trio: AmplitudeTriple, member: Member) -> tuple[float, float]:
    """Kinetic energy before the first site over the incident, when the reflected packet is half-way back to the drive.

    The mean and the deviation over half a burst's length about that time: the incident packet has passed then, and the
    reflected one does not stand against the end yet. What is incident is the energy of the linear run, scaled by the
    amplitudes' squares.
    """
    centre = trio.duration / 2 + 1.5 * trio.distance / trio.speed
    time = member.analysis["time"][...]
    there = np.abs(time - centre) <= trio.duration / 4
    model = member.case.model()
    cell, first = member.analysis["cell"][...] - 1, model.drive_cell
    before = np.abs(cell - first) < trio.distance
    incident = trio.low.analysis["kinetic_energy"][there].sum(axis=1).mean()
    incident *= (member.amplitude / trio.low.amplitude) ** 2
    share = member.analysis["kinetic_energy"][there][:, before].sum(axis=1) / incident
    return float(share.mean()), float(share.std())


def native_bins(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C5."""
    trio = AmplitudeTriple.of(evidence, reading, "wavenumber_content", "partition")
    arrival = trio.distance / max_group_velocity(trio.low.case.unit_cell(), OPTICAL)[2]
    members = {"low": trio.low, "medium": trio.medium, "high": trio.high}
    shares = {name: _native(member, trio.duration, arrival) for name, member in members.items()}
    for name, index in ((IN_FOURIER, 0), (IN_WAVELET, 1)):
        found = [share[index] for share in shares.values()]
        finding.value[name] = min(found)
        finding.uncertainty[f"spread over the amplitudes: {name}"] = np.ptp(found)


def _native(member: Member, start: float, end: float) -> tuple[float, float]:
    """Shares of the bins ``NATIVE`` between two times in s, by Fourier transform and by wavelets."""
    analysis, bounds = member.analysis, member.analysis["partition/bounds"][...]
    low, high = bounds[NATIVE[0] - 1], bounds[NATIVE[-1]]
    content = analysis["wavenumber_content"][_between(analysis["time"][...], start, end)].sum(axis=0)
    wavenumber = analysis["wavenumber"][...]
    fourier = content[(wavenumber >= low) & (wavenumber <= high)].sum() / content.sum()
    energy = analysis["partition/energy"][:, _between(analysis["partition/snapshot"][...], start, end)].sum(axis=1)
    return float(fourier), float(energy[NATIVE[0] - 1 : NATIVE[-1]].sum() / energy.sum())


def _between(time: np.ndarray, start: float, end: float) -> np.ndarray:
    there = (time >= start) & (time <= end)
    if not there.any():
        raise MissingEvidence("no sample lies between the drive's end and the arrival at the first site")
    return there


def reconstruction(evidence: Evidence, reading: str, finding: Measurement) -> None:
    """C6."""
    trio = AmplitudeTriple.of(evidence, reading, "partition")
    largest, cross = [], []
    for name, member in (("low", trio.low), ("medium", trio.medium), ("high", trio.high)):
        group = member.analysis["partition"]
        after = group["snapshot"][...] >= trio.duration
        error, share = group["error"][after], group["cross_share"][after]
        finding.value[f"largest error, {name} amplitude"] = error.max()
        finding.value[f"mean share between the bins, {name} amplitude"] = share.mean()
        largest.append(error.max())
        cross.append(share.mean())
    finding.value["largest error of the reconstructed kinetic energy after the drive"] = max(largest)
    finding.uncertainty["snapshots"] = int(after.sum())
    finding.reasons.append(
        "the bins' velocities are added before they are squared; the plain sum of the bins' energies would miss"
        f" {100 * np.mean(cross):.0f} %"
    )


SCATTERING = (
    ClaimSpec(
        "C1",
        "A burst at 5π/9 excites the optical branch, and the linear lattice's spectrum lies on the Bloch dispersion.",
        "amplitudes-{reading}",
        (
            Criterion("ridge's largest distance from the optical branch", high=BINS, unit="frequency bin"),
            Criterion("loudest wavenumber's distance from 5 pi/9", high=BINS, unit="wavenumber bin"),
        ),
        on_the_branch,
    ),
    ClaimSpec(
        "C2",
        "At low amplitude nothing touches, and the wavenumber content stays as it is once the drive has ended.",
        "amplitudes-{reading}",
        (
            Criterion("contact episodes at low amplitude", high=0, decisive=True),
            Criterion("largest share of the energy that changes its wavenumber", high=STILL),
        ),
        unchanged,
    ),
    ClaimSpec(
        "C3",
        "At medium amplitude new wavenumbers appear, and the spectrum stays on the linear dispersion.",
        "amplitudes-{reading}",
        (
            Criterion("share at new wavenumbers, medium amplitude", low=NEW, decisive=True),
            Criterion("share at new wavenumbers, medium over low amplitude", low=MORE, decisive=True),
            Criterion(BRANCHES, low=BOUND),
        ),
        scattered,
    ),
    ClaimSpec(
        "C4",
        "At high amplitude fewer new wavenumbers appear than at medium, and most of the energy is reflected.",
        "amplitudes-{reading}",
        (
            Criterion("new wavenumbers, high over medium amplitude", high=1),
            Criterion("share of the incident energy reflected, high amplitude", low=MOST),
        ),
        reflected,
    ),
    ClaimSpec(
        "C5",
        "The packet starts in the wavenumber bins 7 and 8.",
        "partition-{reading}",
        (
            Criterion(IN_FOURIER, low=BY_FOURIER),
            Criterion(IN_WAVELET, low=BY_WAVELET),
        ),
        native_bins,
    ),
    ClaimSpec(
        "C6",
        "The wavenumber partitions reconstruct the kinetic energy within one per cent.",
        "reconstruction-{reading}",
        (Criterion("largest error of the reconstructed kinetic energy after the drive", high=RECONSTRUCTED),),
        reconstruction,
    ),
)
