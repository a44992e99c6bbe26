"""The diatomic lattice at low, medium and high amplitude, with full fields."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vipetsc.lattice.bloch import waves_at
from vipetsc.paper.claims.claim import Measurement
from vipetsc.paper.claims.evidence import Evidence, Member, MissingEvidence
from vipetsc.studies.backbone import initiation_of

STEP = "scattering-amplitudes"
OPTICAL = 2  # the band that the paper drives


@dataclass(frozen=True)
class AmplitudeTriple:
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
    def of(cls, evidence: Evidence, reading: str, *needed: str) -> AmplitudeTriple:
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

    def generated(self, member: Member) -> tuple[float, float]:
        """Share of the kinetic energy outside the main lobe from ``passing`` on, and its deviation over time."""
        content = member.analysis["wavenumber_content"][member.analysis["time"][...] >= self.passing]
        new = np.abs(member.analysis["wavenumber"][...] - self.wavenumber) > self.lobe
        outside, whole = content[:, new].sum(axis=1), content.sum(axis=1)
        return float(outside.sum() / whole.sum()), float(np.std(outside / whole))

    def silent(self, evidence: Evidence, finding: Measurement, member: Member) -> None:
        """Say so if ``member`` has no contact, and from where on there is one."""
        if member.episodes:
            return
        text = f"{member.amplitude:g} N makes no contact"
        try:
            onset = initiation_of(evidence.ensemble(STEP).folder, member.case).onset
        except OSError:
            onset = np.nan
        if np.isfinite(onset):
            finding.value["first contact (N)"] = onset
            text = f"{member.amplitude:g} N is below first contact at {onset:.3g} N"
        finding.reasons.append(f"{text}: the lattice is linear there")

    def hardly(self, finding: Measurement) -> None:
        """Say so if the high amplitude is but a few times that of first contact."""
        onset = finding.value.get("first contact (N)")
        if onset:
            finding.reasons.append(
                f"{self.high.amplitude:g} N is {self.high.amplitude / onset:.3g} times first contact"
            )
