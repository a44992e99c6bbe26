"""Warnings about settings of a run that are probably unintended: one sentence each, with numbers and a remedy.

Waves are those of the first drive, at its group velocity; what contacts send into other bands may be faster.
"""

from collections.abc import Iterator, Mapping
from math import pi

import numpy as np

from vipetsc.case.drive import DriveTable
from vipetsc.case.model import Model
from vipetsc.case.schema import LatticeTable, OutputTable
from vipetsc.case.wave_at_sites import sends_one_wave, wave_over_clearance
from vipetsc.io.tables import is_number
from vipetsc.lattice import Chain, ToneBurst, bloch, max_group_velocity, pass_bands, waves_at
from vipetsc.lattice.damped import KAPPAS, damped_bloch
from vipetsc.lattice.drive import main_frequency, spectrum
from vipetsc.wording import counted

# Bounds beyond which a setting is probably unintended. They change no result, and a warning too many or too few costs a
# reader little, so that they are round numbers.
SLOW = 0.1  # fraction of the band's fastest group velocity
WAVELENGTHS = 4.0  # in a lattice: its spectra over the wavenumber then have eight bins up to twice the driven one
MISSED = 0.1  # relative deviation of a loss from the request, in the mean over the wavenumbers of a band
TINY = 1e-6  # a loss ratio, or ratio of frequencies, that stands for 0
BRIEF = 0.1  # duration of a contact over the sample interval
MOST_ENERGY = 0.95  # fraction of the energy of samples
FAR = 3.0  # ratio to the lattice's highest frequency, or of its lowest one
MOST_CLOSING = 100.0  # times a clearance that a wave moves a site
STEPS = 10.0  # of fixed length in a contact: a half sine of ten points has its peak to 1 %
DEFAULT_STEP = 0.05  # of 1/frequency: the first step of ``ts`` where -ts_dt does not give one


def warnings_of(model: Model, output: OutputTable, petsc: Mapping[str, str], is_measured: bool = False) -> list[str]:
    """Return the warnings about a run of ``model`` of which ``output`` is kept, with the options ``petsc`` of PETSc.

    ``is_measured``: a drive is one of measured samples.
    """
    return [
        *wave_warnings(model),
        *length_warnings(model, is_measured),
        *end_warnings(model, output),
        *field_warnings(model, output),
        *closing_warnings(model),
        *contact_warnings(model, petsc),
        *rigid_warnings(model),
    ]


def losses(lattice: LatticeTable) -> np.ndarray:
    """Return loss ratios (band, 4): that of ``[lattice.damping]``, NaN without one; least, mean and largest.

    The last three are those of the complex dispersion of the resolved cell over the wavenumbers ``KAPPAS``. If the
    lattice requests no loss, the array is (0, 4).
    """
    if not (lattice.damping and lattice.damping.loss):
        return np.zeros((0, 4))
    # A loss ratio is twice the damping ratio.
    loss = 2 * damped_bloch(lattice.unit_cell(), KAPPAS).ratio
    asked = [lattice.damping.loss.get(str(band + 1), np.nan) for band in range(loss.shape[1])]
    return np.column_stack([asked, loss.min(axis=0), loss.mean(axis=0), loss.max(axis=0)])


def loss_warnings(lattice: LatticeTable) -> Iterator[str]:
    """Yield the warning of bands whose loss deviates from the request.

    It does if the mean deviates by more than ``MISSED``, or the loss at some wavenumber by a factor of 2.
    """
    off: list[str] = []
    for band, (asked, least, mean, most) in enumerate(losses(lattice), 1):
        is_off_in_mean = abs(mean - asked) > MISSED * asked + TINY
        is_off_somewhere = most > 2 * asked + TINY or least < asked / 2
        if is_off_in_mean or is_off_somewhere:
            off.append(f"band {band} {least:.3g} to {most:.3g} (mean {mean:.3g}, requested {asked:.3g})")
    if off:
        yield (
            f"lattice.damping.loss: the closest fit with dashpots at the cell's masses and springs is"
            f" {', '.join(off)}; prescribe only the important bands for a closer fit"
        )


def wave_warnings(model: Model) -> Iterator[str]:
    """Yield warnings of evanescent and slow waves."""
    cell = model.chain.cell
    drive = model.drive
    # A single cell has no waves.
    if not model.first_drive_acts or not cell.joins_cells or model.chain.cells == 1:
        return

    waves = waves_at(cell, drive.frequency)
    frequency = f"drive.frequency = {drive.frequency:.6g} rad/s"
    if not waves:
        yield f"{frequency} lies in no pass band, so that the wave is evanescent; see the verb `bands`"
        return
    band, _, speed = max(waves, key=lambda wave: wave[2])
    _, best, fastest = max_group_velocity(cell, band)
    if speed < SLOW * fastest:
        yield (
            f"{frequency} lies near an edge of band {band}: its waves have a group velocity of {speed:.3g} cells/s"
            f" and spread;"
            f" the largest one is {fastest:.3g} cells/s, at {best:.6g} rad/s"
        )


def unit_warnings(drives: DriveTable, chain: Chain) -> Iterator[str]:
    """Yield questions about the units of samples whose spectrum lies far from all waves of the lattice."""
    cell = chain.cell
    if not cell.joins_cells:
        return
    bands = pass_bands(cell)
    highest = bands[-1].high
    lowest = bands[0].low
    if lowest < TINY * highest:
        # Where waves begin at 0, the slowest is one that is as long as the lattice.
        lowest = float(bloch(cell, 2 * pi / chain.cells).frequency[0])

    for path, drive in drives.every:
        samples = drive.samples
        if samples is None:
            continue
        # The band that holds most of the energy, not the largest line: one line of noise may be larger than a broad
        # spectrum.
        frequency, content = spectrum(samples.time, samples.value, samples.interpolation)
        energy = np.cumsum(content**2)
        least, most = np.interp([1 - MOST_ENERGY, MOST_ENERGY], energy / energy[-1], frequency)
        span = samples.time[-1] - samples.time[0]
        about = f"{path}.samples: {100 * MOST_ENERGY:.0f} % of their energy lies"
        waves = f"the waves of this lattice ({lowest:.4g} to {highest:.4g} rad/s)"
        if FAR * most < lowest:
            hint = _fitting_unit(
                main_frequency(samples.time, samples.value, samples.interpolation), span, lowest, highest
            )
            yield f"{about} below {most:.3g} rad/s, far below {waves}; are the times, up to {span:.4g} s, in s?{hint}"
        elif least > FAR * highest:
            yield (
                f"{about} above {least:.3g} rad/s, far above {waves}; are the times, up to {span:.4g} s, in s, and the"
                " lattice in kg and N/m?"
            )


def _fitting_unit(frequency: float, span: float, lowest: float, highest: float) -> str:
    """Return the unit of times in which samples that are largest at ``frequency`` would be waves; empty if none is."""
    for unit, factor in (("ms", 1e-3), ("us", 1e-6)):
        if lowest <= frequency / factor <= highest:
            largest = f"their spectrum would be largest at {frequency / factor:.4g} rad/s"
            return f" In {unit}, {largest} and they would last {span * factor:.4g} s"
    return ""


def length_warnings(model: Model, is_measured: bool = False) -> Iterator[str]:
    """Yield warnings of waves that are long for the lattice, and of a run that ends before its drive.

    ``is_measured``: a drive is one of measured samples.
    """
    drive = model.drive
    cells = model.chain.cells
    waves = waves_at(model.chain.cell, drive.frequency)
    # A rig of one cell, or one that moves as measured, is not about waves, and a steady motion not about the wave that
    # comes first.
    if model.first_drive_acts and waves and cells > 1 and not (drive.repeats or is_measured):
        _, kappa, _ = max(waves, key=lambda wave: wave[2])
        wavelength = 2 * pi / max(kappa, 1e-300)
        if wavelength * WAVELENGTHS > cells:
            yield (
                f"lattice.cells = {cells} contain only {cells / wavelength:.3g} wavelengths of {wavelength:.4g}"
                f" cells, and resolve wavenumbers to {2 * pi / cells:.3g} rad/cell;"
                f" {WAVELENGTHS * wavelength:.0f} cells or more resolve the wave"
            )
    if model.end < drive.settled:
        # A drive that goes on has no end but that of its ramp.
        part = "drive's ramp"
        if isinstance(drive, ToneBurst):
            part = "burst"
        elif np.isfinite(drive.duration):
            part = "drive"
        yield f"time.end = {model.end:.6g} s is before the end of the {part}, at {drive.settled:.6g} s"


def end_warnings(model: Model, output: OutputTable) -> Iterator[str]:
    """Yield warnings of a wave that returns from an end to the sites, or without sites to the window or the drive."""
    chain = model.chain
    drive = model.drive
    at = model.drive_cell
    if chain.ends == "periodic" or not (model.first_drive_acts and waves_at(chain.cell, drive.frequency)):
        return
    # Of a drive that goes on, reflections are a part of the motion.
    if drive.repeats or chain.cells == 1:
        return
    # The wave should not return to the sites; without sites, to the recorded window, or to the driven cell.
    name = "cell"
    measured = [cell - 1 for cell in output.window or (at + 1,)]
    if chain.sites:
        name = "site in cell"
        measured = chain.sites.cells.tolist()
    for end, cell in (("left", 0), ("right", chain.cells - 1)):
        # An absorbing end has dashpots besides those of the cell.
        if chain.coefficients(cell, cell + 1).grounding.sum() > sum(chain.cell.grounding):
            continue
        arrival = abs(cell - at) / model.speed
        # A wave that is back before the drive ends is part of what the drive sends out.
        if arrival <= drive.settled / 2:
            continue
        nearest = min(measured, key=lambda site: abs(site - cell))
        back = arrival + abs(nearest - cell) / model.speed
        if back < model.end:
            yield (
                f"the wave ({model.speed:.4g} cells/s) reaches the {end} end at {arrival:.4g} s and returns to the"
                f" {name} {nearest + 1} at {back:.4g} s, before time.end = {model.end:.4g} s: more lattice.cells or an"
                " earlier end exclude the reflection from the measures"
            )


def field_warnings(model: Model, output: OutputTable) -> Iterator[str]:
    """Yield warnings of fields that do not resolve the waves.

    Sentences on measures that the fields do not allow are word for word those of the analysis, so that a command that
    prints both shows each of them once.
    """
    chain = model.chain
    top = pass_bands(chain.cell)[-1].high
    interval = output.stride * model.sample_interval
    if output.fields and chain.cell.joins_cells and interval * top >= np.pi:
        coarse = f"fields stored every {interval:.4g} s resolve {np.pi / interval:.5g} of {top:.5g} rad/s"
        yield f"{coarse}: dispersion, bands and ibtet are not measured"
    if output.fields and output.every > 1:
        sparse = f"fields of one cell in {output.every} do not resolve waves shorter than {2 * output.every} cells"
        yield f"{sparse}: wavenumber_content, dispersion, partition and entropy are not measured"

    first, last = output.window or (1, chain.cells)
    if output.fields and chain.sites and not any(first <= site.cell + 1 <= last for site in chain.sites):
        yield f"output.window = [{first}, {last}] contains none of the contact sites"

    highest = max(drive.waveform.highest for drive in model.drives)
    if model.is_driven and highest > np.pi / model.sample_interval:
        interval = np.pi / highest
        yield (
            f"the drive contains up to {highest:.5g} rad/s, beyond the {np.pi / model.sample_interval:.5g} rad/s of"
            f" samples every {model.sample_interval:.3g} s: fields and energies are aliased; use a time.sample_interval"
            f" below {interval:.3g} s"
        )


def closing_warnings(model: Model) -> Iterator[str]:
    """Yield warnings of waves that close no clearance, and of ones far larger than the clearances."""
    if not (model.chain.sites and sends_one_wave(model)):
        return
    ratios = wave_over_clearance(model).max(axis=1)
    # A wave that is evanescent has a warning of its own; stops that touch close by any wave.
    ratios = ratios[np.isfinite(ratios) & (ratios > 0)]
    if not ratios.size:
        return
    if ratios.max() < 1:
        yield (
            f"the drive's linear wave reaches {ratios.max():.3g} of the nearest clearance: no contact closes unless"
            " waves add up; a larger drive.amplitude or a smaller contacts.clearance closes one"
        )
    if ratios.max() > MOST_CLOSING:
        yield (
            f"the drive's linear wave is {ratios.max():.3g} times the clearance, so that the stops are shut nearly all"
            " the time; are drive.amplitude and contacts.clearance in N and m?"
        )


def rigid_warnings(model: Model) -> Iterator[str]:
    """Yield the warning of rigid stops that may be struck at one instant."""
    if not model.has_rigid_sites:
        return
    masses = model.shared_masses
    if len(masses):
        cell, mass = divmod(int(masses[0]), model.chain.cell.dofs)
        yield (
            f"{counted(len(masses), 'mass')} with more than one rigid stop, the first being mass {mass + 1} of cell"
            f" {cell + 1}: stops that are struck at one instant are so by their numbers, and the answer depends on that"
        )


def contact_warnings(model: Model, petsc: Mapping[str, str]) -> Iterator[str]:
    """Yield warnings of contacts that samples, or steps of fixed length, do not resolve."""
    speed = model.scale * model.drive.frequency
    if not model.chain.sites or not speed:
        return

    # The briefest contact decides, at the speed of the undisturbed wave.
    time = min(model.chain.impact_times(speed), default=np.inf)
    step = DEFAULT_STEP / model.drive.frequency
    # Options of PETSc are text in a case. PETSc reads some that are no numbers here, such as "0x10" and "default".
    if is_number(petsc.get("ts_dt", "")):
        step = float(petsc["ts_dt"])
    if petsc.get("ts_adapt_type") == "none" and step > time / STEPS:
        yield (
            f"ts takes fixed steps of {step:.3g} s, and a contact at {speed:.3g} m/s lasts {time:.3g} s: ts_dt ="
            f" {time / STEPS:.2g} or less, adaptive steps or the propagator resolve it"
        )
    elif time < BRIEF * model.sample_interval:
        yield (
            f"a contact at {speed:.3g} m/s lasts {time:.3g} s, {time / model.sample_interval:.2g} of a sample"
            " interval: both engines resolve it, but the samples show it as a jump; the log of impacts contains its"
            f" largest force, and a time.sample_interval of {time:.1g} s resolves it"
        )
