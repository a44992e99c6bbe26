"""The diatomic lattice at low, medium and high amplitude, with full fields (sec. II.B)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vipetsc.lattice.bloch import waves_at
from vipetsc.paper.claims.claim import Measurement, MissingEvidence
from vipetsc.paper.claims.evidence import Evidence, MeasuredRun
from vipetsc.studies.backbone import initiation_of

STEP = "scattering-amplitudes"
OPTICAL = 2  # the band that the paper drives


@dataclass(frozen=True)
class AmplitudeTriple:
    """The runs at low, medium and high amplitude, and the wave they drive.

    ``wavenumber`` in rad/cell, ``speed`` in cells/s; ``lobe`` (rad/cell) is the half-width of the burst's main
    lobe, 2 Om/(Nc v_g); ``duration`` of the burst in s; ``distance`` in cells to the first site.
    """

    low: MeasuredRun
    medium: MeasuredRun
    high: MeasuredRun
    wavenumber: float
    speed: float
    lobe: float
    duration: float
    distance: int

    @classmethod
    def of(cls, evidence: Evidence, reading: str, *needs: str) -> AmplitudeTriple:
        """The lowest, the middle and the highest amplitude; raises MissingEvidence."""
        runs = evidence.runs(STEP, reading, *needs)
        if len(runs) < 3:
            raise MissingEvidence(f"{STEP} has {len(runs)} amplitudes; low, medium and high are needed")
        model = runs[0].case.model()
        drive, sites = model.drive, np.asarray(model.chain.sites)
        waves = [wave for wave in waves_at(model.chain.cell, drive.frequency) if wave[0] == OPTICAL]
        if not waves or not sites.size:
            raise MissingEvidence(f"{STEP}: the drive excites no wave of band {OPTICAL}, or the lattice has no sites")
        _, wavenumber, speed = waves[0]
        lobe = 2 * drive.frequency / (drive.cycles * speed)
        distance = int(np.min(np.abs(sites - model.drive_cell)))
        triple = runs[0], runs[len(runs) // 2], runs[-1]
        return cls(*triple, wavenumber, speed, lobe, drive.duration, distance)

    @property
    def runs(self) -> dict[str, MeasuredRun]:
        """The three runs by name."""
        return {"low": self.low, "medium": self.medium, "high": self.high}

    def new_share(self, run: MeasuredRun) -> tuple[float, float]:
        """Share of the kinetic energy outside the main lobe, and its deviation over time.

        From when the middle of the burst passes the first site.
        """
        time, wavenumber, content = run.arrays("time", "wavenumber", "wavenumber_content")
        content = content[time >= self.duration / 2 + self.distance / self.speed]
        new = np.abs(wavenumber - self.wavenumber) > self.lobe
        outside, whole = content[:, new].sum(axis=1), content.sum(axis=1)
        return float(outside.sum() / whole.sum()), float(np.std(outside / whole))

    def explain_medium(self, result: Measurement) -> None:
        """Add a reason if the medium amplitude makes no contact: from where on there is one."""
        if self.medium.episodes:
            return
        text = f"{self.medium.amplitude:g} N makes no contact"
        try:
            onset = initiation_of(self.medium.folder.parent, self.medium.case).onset
        except (OSError, ValueError):
            onset = np.nan
        if np.isfinite(onset):
            result.value["first contact (N)"] = onset
            text = f"{self.medium.amplitude:g} N is below first contact at {onset:.3g} N"
        result.reasons.append(f"{text}: the lattice is linear there")

    def explain_high(self, result: Measurement) -> None:
        """Add a reason if the high amplitude is but a few times that of first contact."""
        onset = result.value.get("first contact (N)")
        if onset:
            result.reasons.append(f"{self.high.amplitude:g} N is {self.high.amplitude / onset:.3g} times first contact")
