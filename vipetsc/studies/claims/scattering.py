"""C1-C6: what the diatomic lattice does at low, medium and high amplitude (the paper's section II.B)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vipetsc.lattice import bloch, max_group_velocity, pass_bands
from vipetsc.lattice.bloch import waves_at
from vipetsc.spectra import Dispersion, ridge
from vipetsc.studies.backbone import initiation_of
from vipetsc.studies.claims.claim import Criterion, Finding, Statement
from vipetsc.studies.claims.evidence import Evidence, Member, MissingEvidence

STEP = "scattering-amplitudes"
EXCITED = 5 * np.pi / 9  # rad/cell, of the paper's section II
OPTICAL = 2  # its band
BINS = 1  # how far, in bins of the transform, a ridge may lie from the branch
STILL = 0.01  # share of the energy that may change its wavenumber before a spectrum is not constant
NEW, MORE = 0.10, 10  # share at new wavenumbers that counts as scattering, and how many times that of the low amplitude
BESIDE = 0.02  # half-width of the band around a branch over the top edge of the pass bands
BOUND = 0.95  # share of the energy that has to lie in there
MOST = 0.5  # "a majority of the incident energy"
NATIVE = 7, 8  # wavenumber bins that the packet starts in
BY_FOURIER, BY_WAVELET = 0.99, 0.85
RECONSTRUCTED = 0.01  # the paper's one per cent


@dataclass(frozen=True)
class Trio:
    """The runs at low, medium and high amplitude, and the wave they drive.

    ``wavenumber`` in rad/cell, ``speed`` in cells/s; ``lobe`` (rad/cell) is the half-width of the burst's main
    lobe, 2 Om/(Nc v_g); ``duration`` of the burst in s; ``distance`` in cells to the first site.
    """

    low: Member
    medium: Member
    high: Member
    wavenumber: float
    speed: float
    lobe: float
    duration: float
    distance: int

    @classmethod
    def of(cls, evidence: Evidence, reading: str, *needed: str) -> Trio:
        """The lowest, the middle and the highest amplitude; raises MissingEvidence."""
        members = evidence.members(STEP, evidence.place(STEP, reading), *needed)
        if len(members) < 3:
            raise MissingEvidence(f"{STEP} has {len(members)} amplitudes; low, medium and high are needed")
        model = members[0].case.model()
        cell, drive, sites = model.chain.cell, model.drive, np.asarray(model.chain.sites)
        waves = [wave for wave in waves_at(cell, drive.frequency) if wave[0] == OPTICAL]
        if not waves or not sites.size:
            raise MissingEvidence(f"{STEP}: the drive excites no wave of band {OPTICAL}, or the lattice has no sites")
        _, wavenumber, speed = waves[0]
        lobe = 2 * drive.frequency / (drive.cycles * speed)
        distance = int(np.min(np.abs(sites - model.drive_cell)))
        picked = members[0], members[len(members) // 2], members[-1]
        return cls(*picked, wavenumber, speed, lobe, drive.duration, distance)

    @property
    def passing(self) -> float:
        """When the middle of the burst passes the first site, s."""
        return self.duration / 2 + self.distance / self.speed

    def generated(self, member: Member) -> float:
        """Share of the kinetic energy outside the burst's main lobe, from ``passing`` on."""
        content = member.analysis["wavenumber_content"][member.analysis["time"][...] >= self.passing].sum(axis=0)
        new = np.abs(member.analysis["wavenumber"][...] - self.wavenumber) > self.lobe
        return float(content[new].sum() / content.sum())

    def silent(self, evidence: Evidence, finding: Finding, member: Member) -> None:
        """Say so if ``member`` has no contact, and from where on there is one."""
        if member.episodes:
            return
        text = f"{member.amplitude:g} N makes no contact"
        try:
            onset = initiation_of(evidence.ensemble(STEP), member.case).onset
        except OSError:
            onset = np.nan
        if np.isfinite(onset):
            finding.value["first contact (N)"] = onset
            text = f"{member.amplitude:g} N is below first contact at {onset:.3g} N"
        finding.reasons.append(f"{text}: the lattice is linear there")

    def hardly(self, finding: Finding) -> None:
        """Say so if the high amplitude is but a few times that of first contact."""
        onset = finding.value.get("first contact (N)")
        if onset:
            finding.reasons.append(
                f"{self.high.amplitude:g} N is {self.high.amplitude / onset:.3g} times first contact"
            )


def on_the_branch(evidence: Evidence, reading: str, finding: Finding) -> None:
    """C1."""
    trio = Trio.of(evidence, reading, "dispersion")
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


def unchanged(evidence: Evidence, reading: str, finding: Finding) -> None:
    """C2."""
    trio = Trio.of(evidence, reading, "wavenumber_content")
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


def scattered(evidence: Evidence, reading: str, finding: Finding) -> None:
    """C3."""
    trio = Trio.of(evidence, reading, "wavenumber_content", "dispersion")
    low, medium = trio.generated(trio.low), trio.generated(trio.medium)
    finding.value["share at new wavenumbers, medium amplitude"] = medium
    finding.value["share at new wavenumbers, medium over low amplitude"] = medium / low
    finding.value["share within 2 % of the Bloch branches"] = _beside_branches(trio.medium)
    finding.value["share at new wavenumbers, low amplitude"] = low
    finding.value["share within 2 % of the Bloch branches, low amplitude"] = _beside_branches(trio.low)
    finding.value["main lobe's half-width (rad/cell)"] = trio.lobe
    trio.silent(evidence, finding, trio.medium)


def _beside_branches(member: Member) -> float:
    """Share of the 2-D spectrum's energy within ``BESIDE`` times the top edge of a branch."""
    wavenumber, frequency, energy = (member.analysis[n][...] for n in ("wavenumber", "frequency", "dispersion"))
    cell = member.case.unit_cell()
    away = np.abs(frequency[None, :, None] - bloch(cell, wavenumber).frequency[:, None, :]).min(axis=2)
    return float(energy[away <= BESIDE * pass_bands(cell)[-1].high].sum() / energy.sum())


def reflected(evidence: Evidence, reading: str, finding: Finding) -> None:
    """C4."""
    trio = Trio.of(evidence, reading, "wavenumber_content", "kinetic_energy")
    shares = {}
    for name, member in (("low", trio.low), ("medium", trio.medium), ("high", trio.high)):
        shares[name] = trio.generated(member)
        finding.value[f"share at new wavenumbers, {name} amplitude"] = shares[name]
        finding.value[f"share of the incident energy reflected, {name} amplitude"] = _returned(trio, member)
    finding.value["new wavenumbers, high over medium amplitude"] = shares["high"] / shares["medium"]
    trio.silent(evidence, finding, trio.medium)
    trio.hardly(finding)


def _returned(trio: Trio, member: Member) -> float:
    """Kinetic energy before the first site over the incident, when the reflected packet is back at the drive.

    The mean over one burst's length about that time, when what came from the first site has not met it again. What
    is incident is the energy of the linear run, scaled by the amplitudes' squares.
    """
    centre = trio.duration / 2 + 2 * trio.distance / trio.speed
    time = member.analysis["time"][...]
    there = np.abs(time - centre) <= trio.duration / 2
    model = member.case.model()
    cell, first = member.analysis["cell"][...] - 1, model.drive_cell
    before = np.abs(cell - first) < trio.distance
    incident = trio.low.analysis["kinetic_energy"][there].sum(axis=1).mean()
    incident *= (member.amplitude / trio.low.amplitude) ** 2
    return float(member.analysis["kinetic_energy"][there][:, before].sum(axis=1).mean() / incident)


def native_bins(evidence: Evidence, reading: str, finding: Finding) -> None:
    """C5."""
    trio = Trio.of(evidence, reading, "wavenumber_content", "partition")
    arrival = trio.distance / max_group_velocity(trio.low.case.unit_cell(), OPTICAL)[2]
    members = {"low": trio.low, "medium": trio.medium, "high": trio.high}
    shares = {name: _native(member, trio.duration, arrival) for name, member in members.items()}
    for kind, index in (("Fourier", 0), ("wavelet", 1)):
        finding.value[f"smallest share in bins 7 and 8, {kind}"] = min(share[index] for share in shares.values())
        finding.uncertainty[f"spread over the amplitudes, {kind}"] = np.ptp([share[index] for share in shares.values()])


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


def reconstruction(evidence: Evidence, reading: str, finding: Finding) -> None:
    """C6."""
    trio = Trio.of(evidence, reading, "partition")
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
    Statement(
        "C1",
        "A burst at 5π/9 excites the optical branch, and the linear lattice's spectrum lies on the Bloch dispersion.",
        "amplitudes-{reading}",
        (
            Criterion("ridge's largest distance from the optical branch", high=BINS, unit="frequency bin"),
            Criterion("loudest wavenumber's distance from 5 pi/9", high=BINS, unit="wavenumber bin"),
        ),
        on_the_branch,
    ),
    Statement(
        "C2",
        "At low amplitude nothing touches, and the wavenumber content stays as it is once the drive has ended.",
        "amplitudes-{reading}",
        (
            Criterion("contact episodes at low amplitude", high=0, decisive=True),
            Criterion("largest share of the energy that changes its wavenumber", high=STILL),
        ),
        unchanged,
    ),
    Statement(
        "C3",
        "At medium amplitude new wavenumbers appear, and the spectrum stays on the linear dispersion.",
        "amplitudes-{reading}",
        (
            Criterion("share at new wavenumbers, medium amplitude", low=NEW, decisive=True),
            Criterion("share at new wavenumbers, medium over low amplitude", low=MORE, decisive=True),
            Criterion("share within 2 % of the Bloch branches", low=BOUND),
        ),
        scattered,
    ),
    Statement(
        "C4",
        "At high amplitude fewer new wavenumbers appear than at medium, and most of the energy is reflected.",
        "amplitudes-{reading}",
        (
            Criterion("new wavenumbers, high over medium amplitude", high=1),
            Criterion("share of the incident energy reflected, high amplitude", low=MOST),
        ),
        reflected,
    ),
    Statement(
        "C5",
        "The packet starts in the wavenumber bins 7 and 8.",
        "partition-{reading}",
        (
            Criterion("smallest share in bins 7 and 8, Fourier", low=BY_FOURIER),
            Criterion("smallest share in bins 7 and 8, wavelet", low=BY_WAVELET),
        ),
        native_bins,
    ),
    Statement(
        "C6",
        "The wavenumber partitions reconstruct the kinetic energy within one per cent.",
        "reconstruction-{reading}",
        (Criterion("largest error of the reconstructed kinetic energy after the drive", high=RECONSTRUCTED),),
        reconstruction,
    ),
)
