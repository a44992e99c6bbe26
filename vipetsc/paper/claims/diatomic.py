"""C1-C6: the diatomic lattice at low, medium and high amplitude (the paper's section II.B)."""

from typing import NamedTuple

import numpy as np

from vipetsc.lattice import bloch, max_group_velocity, pass_bands, waves_at
from vipetsc.paper.claims.criteria import HALF_WIDTH, NATIVE
from vipetsc.paper.claims.evidence import EXCITED, AnalysedMember, Evidence, Measurement, MissingEvidence
from vipetsc.spectra import Dispersion, ridge

BRANCHES = f"fraction within {100 * HALF_WIDTH:g} % of the top edge from the Bloch branches"
STEP = "scattering-amplitudes"
OPTICAL = 2  # the band that the paper drives


class Fraction(NamedTuple):
    """A part of the energy, and its standard deviation over time."""

    value: float
    deviation: float


class AmplitudeTriple:
    """The ``runs`` at ``low``, ``medium`` and ``high`` amplitude, and the wave that they drive.

    The wave has the ``wavenumber`` in rad/cell and the group velocity ``speed`` in cells/s. The burst lasts
    ``duration`` in s; ``lobe`` in rad/cell is the half-width of its main lobe, 2 Om/(Nc v_g) with its frequency Om and
    its Nc cycles under a Hann window. ``distance`` in cells is that from the drive to the first site. Raises
    MissingEvidence if there are fewer than three runs, or no such wave or site.
    """

    def __init__(self, evidence: Evidence, reading: str, *needs: str) -> None:
        runs = evidence.runs(STEP, reading, *needs)
        if len(runs) < 3:
            raise MissingEvidence(f"{STEP} has {len(runs)} amplitudes; low, medium and high are needed")
        self.low = runs[0]
        self.medium = runs[len(runs) // 2]
        self.high = runs[-1]
        self.runs = {"low": self.low, "medium": self.medium, "high": self.high}

        model = self.low.case.model()
        drive = model.drive
        sites = model.chain.sites.cells
        waves = [wave for wave in waves_at(model.chain.cell, drive.frequency) if wave[0] == OPTICAL]
        if not waves or not sites.size:
            raise MissingEvidence(f"{STEP}: the drive excites no wave of band {OPTICAL}, or the lattice has no sites")
        _, self.wavenumber, self.speed = waves[0]
        self.lobe = 2 * drive.frequency / (drive.cycles * self.speed)
        self.duration = drive.duration
        self.distance = int(np.min(np.abs(sites - model.drive_cell)))

    def new_fraction(self, run: AnalysedMember) -> Fraction:
        """Return the fraction of the kinetic energy of a ``run`` at new wavenumbers, outside of the burst's main lobe.

        It is over the time from the passage of the burst's middle at the first site to the end.
        """
        time, wavenumber, content = run.arrays("time", "wavenumber", "wavenumber_content")
        content = content[time >= self.duration / 2 + self.distance / self.speed]
        # The burst itself spreads over its main lobe about the driven wavenumber.
        new = np.abs(wavenumber - self.wavenumber) > self.lobe
        outside = content[:, new].sum(axis=1)
        whole = content.sum(axis=1)
        return Fraction(outside.sum() / whole.sum(), np.std(outside / whole))

    def explain_medium(self, result: Measurement) -> None:
        """Add a reason if the medium amplitude makes no contact, with the amplitude at which contact begins."""
        if self.medium.episodes:
            return
        onset = self.medium.onset
        because = "makes no contact"
        if np.isfinite(onset):
            result.value["first contact (N)"] = onset
            because = f"is below first contact at {onset:.3g} N"
        result.reasons.append(f"{self.medium.amplitude:g} N {because}: the lattice is linear there")


def optical_ridge(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C1: distance of the linear run's spectral ridge from the optical branch, in bins (Fig. 2).

    Raises MissingEvidence if results are missing, or if the run at low amplitude has contacts.
    """
    triple = AmplitudeTriple(evidence, reading, "dispersion")
    if triple.low.episodes:
        raise MissingEvidence(f"the run at {triple.low.amplitude:g} N is not linear: {triple.low.episodes} contacts")
    spectrum = Dispersion(*triple.low.arrays("wavenumber", "frequency", "dispersion"))
    wavenumber, frequency = ridge(spectrum)

    branch = bloch(triple.low.case.lattice.unit_cell(), wavenumber).frequency[:, OPTICAL - 1]
    frequency_bin = spectrum.frequency[1] - spectrum.frequency[0]
    wavenumber_bin = spectrum.wavenumber[1] - spectrum.wavenumber[0]
    distance = np.abs(frequency - branch) / frequency_bin
    strongest = spectrum.wavenumber[np.argmax(spectrum.energy.sum(axis=1))]
    result.value |= {
        "ridge's largest distance from the optical branch": distance.max(),
        "loudest wavenumber's distance from 5 pi/9": abs(strongest - EXCITED) / wavenumber_bin,
        "wavenumber of the drive on the optical branch (rad/cell)": triple.wavenumber,
        "ridge's mean distance (bins)": distance.mean(),
    }
    result.uncertainty |= {"frequency bin (rad/s)": frequency_bin, "wavenumber bin (rad/cell)": wavenumber_bin}
    result.uncertainty["points of the ridge"] = len(wavenumber)


def linear_content(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C2: fraction of the energy that changes its wavenumber on the way to the far end, at low amplitude (Fig. 2).

    Raises MissingEvidence if results are missing, or if the record has no time between drive and far end.
    """
    triple = AmplitudeTriple(evidence, reading, "wavenumber_content")
    model = triple.low.case.model()
    time, content = triple.low.arrays("time", "wavenumber_content")
    fastest = max_group_velocity(model.chain.cell, OPTICAL)[2]
    # The whole packet is in the lattice, and nothing of it has met the far end.
    free = (time >= triple.duration) & (time <= model.chain.cells / fastest)
    if free.sum() < 2:
        raise MissingEvidence("the packet reaches the far end before the drive ends, or the record is too short")

    distribution = content[free] / content[free].sum(axis=1, keepdims=True)
    # Half, since energy that leaves one bin is counted again where it arrives.
    moved = 0.5 * np.abs(distribution - distribution[0]).sum(axis=1)
    result.value["contact episodes at low amplitude"] = triple.low.episodes
    result.value["largest fraction of the energy that changes its wavenumber"] = moved.max()
    result.uncertainty |= {"mean over time of that fraction": moved.mean(), "samples": free.sum()}


def new_wavenumbers(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C3: energy at new wavenumbers, and energy near the Bloch branches, at medium amplitude (Figs. 2, 3)."""
    triple = AmplitudeTriple(evidence, reading, "wavenumber_content", "dispersion")
    low = triple.new_fraction(triple.low)
    medium = triple.new_fraction(triple.medium)
    result.value |= {
        "fraction at new wavenumbers, medium amplitude": medium.value,
        "fraction at new wavenumbers, medium over low amplitude": medium.value / low.value,
        BRANCHES: _on_branches(triple.medium),
        "fraction at new wavenumbers, low amplitude": low.value,
        f"{BRANCHES}, low amplitude": _on_branches(triple.low),
        "main lobe's half-width (rad/cell)": triple.lobe,
    }
    result.uncertainty["deviation over time of the fraction at new wavenumbers"] = medium.deviation
    triple.explain_medium(result)


def _on_branches(run: AnalysedMember) -> float:
    """Return the fraction of the energy in the space-time spectrum of a ``run`` that lies near a Bloch branch.

    A frequency is near a branch if it is at most ``HALF_WIDTH`` times the top edge of the bands away from it.
    """
    wavenumber, frequency, energy = run.arrays("wavenumber", "frequency", "dispersion")
    cell = run.case.lattice.unit_cell()
    branches = bloch(cell, wavenumber).frequency
    # The distance from the nearest branch counts: a new wave may belong to any of them.
    distance = np.abs(frequency[None, :, None] - branches[:, None, :]).min(axis=2)
    return energy[distance <= HALF_WIDTH * pass_bands(cell)[-1].high].sum() / energy.sum()


def reflected(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C4: new wavenumbers at high over medium amplitude, and the fraction that is reflected (Figs. 2, 3)."""
    triple = AmplitudeTriple(evidence, reading, "wavenumber_content", "kinetic_energy")
    new: dict[str, float] = {}
    for name, run in triple.runs.items():
        fraction = triple.new_fraction(run)
        back = _reflected_fraction(triple, run)
        new[name] = fraction.value
        result.value[f"fraction at new wavenumbers, {name} amplitude"] = fraction.value
        result.value[f"fraction of the incident energy reflected, {name} amplitude"] = back.value
        deviations = "deviation over time of the fraction"
        result.uncertainty[f"{deviations} at new wavenumbers, {name} amplitude"] = fraction.deviation
        result.uncertainty[f"{deviations} reflected, {name} amplitude"] = back.deviation
    result.value["new wavenumbers, high over medium amplitude"] = new["high"] / new["medium"]

    triple.explain_medium(result)
    if "first contact (N)" in result.value:
        ratio = triple.high.amplitude / triple.medium.onset
        result.reasons.append(f"{triple.high.amplitude:g} N is {ratio:.3g} times first contact")


def _reflected_fraction(triple: AmplitudeTriple, run: AnalysedMember) -> Fraction:
    """Return kinetic energy before the first site over the incident one, as the reflected packet is halfway back.

    Mean and deviation are over half a burst's duration about that time, when the incident packet has passed the site
    and the reflected one has not reached the end of the lattice. The incident energy is that of the whole run at low
    amplitude, times the square of the ratio of the amplitudes.
    """
    time, cell, energy = run.arrays("time", "cell", "kinetic_energy")
    returning = np.abs(time - triple.duration / 2 - 1.5 * triple.distance / triple.speed) <= triple.duration / 4
    before = np.abs(cell - 1 - run.case.model().drive_cell) < triple.distance
    incident = triple.low.analysis["kinetic_energy"].values[returning].sum(axis=1).mean()
    incident *= (run.amplitude / triple.low.amplitude) ** 2
    reflected_energy = energy[returning][:, before].sum(axis=1) / incident
    return Fraction(reflected_energy.mean(), reflected_energy.std())


def native_bins(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C5: fraction of the packet's energy in its own wavenumber bins before it meets a site (Fig. 4).

    Raises MissingEvidence if results are missing, or if no sample lies before that.
    """
    triple = AmplitudeTriple(evidence, reading, "wavenumber_content", "partition")
    # At the largest speed in the band, so that no part of the packet has met the site.
    arrival = triple.distance / max_group_velocity(triple.low.case.lattice.unit_cell(), OPTICAL)[2]
    first = NATIVE[0] - 1
    last = NATIVE[-1]
    by_method: dict[str, list[float]] = {"Fourier": [], "wavelet": []}
    for run in triple.runs.values():
        time, wavenumber, content = run.arrays("time", "wavenumber", "wavenumber_content")
        snapshot, bounds, energy = run.arrays("partition/snapshot", "partition/bounds", "partition/energy")
        sampled = (time >= triple.duration) & (time <= arrival)
        transformed = (snapshot >= triple.duration) & (snapshot <= arrival)
        if not (sampled.any() and transformed.any()):
            raise MissingEvidence("no sample lies between the drive's end and the arrival at the first site")

        content = content[sampled].sum(axis=0)
        inside = (wavenumber >= bounds[first]) & (wavenumber <= bounds[last])
        by_method["Fourier"].append(content[inside].sum() / content.sum())
        energy = energy.compress(transformed, axis=1).sum(axis=1)
        by_method["wavelet"].append(energy[first:last].sum() / energy.sum())

    for method, fractions in by_method.items():
        quantity = f"smallest fraction in bins {NATIVE[0]} and {NATIVE[1]}, {method}"
        result.value[quantity] = min(fractions)
        result.uncertainty[f"spread over the amplitudes: {quantity}"] = np.ptp(fractions)


def reconstruction(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C6: error of the kinetic energy of the sum of the bins' velocities (App. A, Fig. A1)."""
    triple = AmplitudeTriple(evidence, reading, "partition")
    largest = []
    cross = []
    for name, run in triple.runs.items():
        snapshot, error, between_bins = run.arrays("partition/snapshot", "partition/error", "partition/cross_share")
        # While the drive acts the packet ends at the first cell, beyond which wavelets meet nothing.
        after = snapshot >= triple.duration
        largest.append(error[after].max())
        cross.append(between_bins[after].mean())
        result.value[f"largest error, {name} amplitude"] = largest[-1]
        result.value[f"mean fraction between the bins, {name} amplitude"] = cross[-1]

    result.value["largest error of the reconstructed kinetic energy after the drive"] = max(largest)
    result.uncertainty["snapshots"] = after.sum()
    result.reasons.append(
        "the bins' velocities are added before they are squared; the plain sum of the bins' energies would miss"
        f" {100 * np.mean(cross):.0f} %"
    )
