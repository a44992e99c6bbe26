"""The content of the frames of a movie of one run: its wave, the Bloch waves in it, impacts, energies of bands."""

from typing import NamedTuple

import numpy as np
import xarray as xr

from vipetsc import spectra
from vipetsc.case import Case
from vipetsc.figures import panels
from vipetsc.io.read import field_time
from vipetsc.lattice import Chain, UnitCell

# Defaults of a movie's options.
LENGTH = 10.0  # s
RATE = 15.0  # frames a second; fewer are seen one by one
WIDTH = 960  # pixels

MOST_FRAMES = 5000  # of a movie: five and a half minutes at the default rate
# Cells of a movie. It has fewer pixels, and every frame takes a Fourier transform over all of them.
MOST_CELLS = 20_000
# Factor of an impact's light from frame to frame: after six, 0.4 s at the default rate, it is too faint to be drawn.
FADE = 0.6


class Shot(NamedTuple):
    """A request for a movie of ``quantity`` ("energy" or "velocity"), from ``start`` to ``stop`` in s of the run.

    ``speed`` is in s of the run a second of the movie, ``rate`` in frames a second, ``width`` in pixels; ``cells`` are
    the first and the last one, from 1. What is None is chosen: the whole record, all cells, a movie of ``LENGTH``.
    """

    quantity: str = "energy"
    start: float | None = None
    stop: float | None = None
    speed: float | None = None
    rate: float = RATE
    cells: tuple[int, int] | None = None
    width: int = WIDTH


class CheckedShot(NamedTuple):
    """What a run has for a shot: the ``window`` of the recorded cells that it shows, and the ``time`` (frame,) in s.

    ``has_waves`` is whether the motion can be separated into Bloch waves, which needs displacement and velocity of
    cells side by side.
    """

    window: slice
    time: np.ndarray
    has_waves: bool


class BandEnergies(NamedTuple):
    """``energy`` (part, instant) in J of the ``parts`` of the spectrum at ``instants`` (instant,) in s."""

    parts: tuple[str, ...]
    instants: np.ndarray
    energy: np.ndarray


class MovieFrames(NamedTuple):
    """The content of the frames of a movie.

    Attributes
    ----------
    quantity
        "energy" or "velocity", the quantity that ``wave`` is.
    cell
        The unit cell whose Bloch waves are shown. Where cells differ it has the means of those shown; in kinetic
        energies each cell has its own masses.
    time, cells
        Times (frame,) in s, and cells (cell,) from 1.
    wave
        Energy in J of each pass band in each cell (frame, band, cell), or velocity in m/s of the host (frame, 1, cell).
    wavenumber, waves
        Wavenumbers (wavenumber,) in rad/cell and energies (frame, wavenumber, band) in J of the Bloch waves; empty if
        waves cannot be separated.
    sites, flash
        Cells (site,) from 1 of the contact sites, and the light (frame, site) of their impacts: 1 in the first frame
        after an impact, then fading.
    energies
        Energies of the whole lattice over time.
    """

    quantity: str
    cell: UnitCell
    time: np.ndarray
    cells: np.ndarray
    wave: np.ndarray
    wavenumber: np.ndarray
    waves: np.ndarray
    sites: np.ndarray
    flash: np.ndarray
    energies: BandEnergies


def check(run: xr.Dataset, shot: Shot) -> CheckedShot:
    """Return what ``run`` has for a ``shot``; raise ValueError, which names the option, if it cannot be made."""
    if "velocity" not in run:
        raise ValueError("--movie: the run recorded no velocity")
    window = _check_cells(run, shot)

    cells = run["cell"].values[window]
    are_side_by_side = len(cells) > 1 and bool(np.all(np.diff(cells) == 1))
    has_waves = "displacement" in run and are_side_by_side
    if shot.quantity == "energy" and not has_waves:
        raise ValueError("--movie energy: needs displacements and velocities of contiguous cells; use --movie velocity")
    return CheckedShot(window=window, time=_check_times(run, shot), has_waves=has_waves)


def _check_cells(run: xr.Dataset, shot: Shot) -> slice:
    """Return the part of the recorded cells that the shot shows, by default all."""
    recorded = run["cell"].values
    first, last = shot.cells or (recorded[0], recorded[-1])
    if shot.cells and not recorded[0] <= first < last <= recorded[-1]:
        inside = f"{recorded[0]} to {recorded[-1]}"
        raise ValueError(f"--cells {first}:{last}: needs two of the recorded cells or more, A < B from {inside}")

    # The places of these numbers, since a run may have recorded every n-th cell.
    begin, end = np.searchsorted(recorded, (first, last + 1)).tolist()
    if end - begin > MOST_CELLS:
        raise ValueError(f"--movie: {end - begin} cells are more than {MOST_CELLS}; select some with --cells A:B")
    return slice(begin, end)


def _check_times(run: xr.Dataset, shot: Shot) -> np.ndarray:
    """Return the times (frame) in s of the frames."""
    time = field_time(run)
    start = time[0] if shot.start is None else shot.start
    stop = time[-1] if shot.stop is None else shot.stop
    if not time[0] <= start < stop <= time[-1] * (1 + 1e-12):
        raise ValueError(f"--from {start:g} --to {stop:g}: needs an interval within {time[0]:g} to {time[-1]:g} s")

    # With a frame at the end as well, which rounding may put a little beyond it.
    step = (shot.speed or (stop - start) / LENGTH) / shot.rate
    count = (stop - start) / step * (1 + 1e-9) + 1
    if not 2 <= count < MOST_FRAMES + 1:
        how = "slow" if count > 2 else "fast"
        raise ValueError(f"--speed {step * shot.rate:g}: is too {how}: {count:.4g} frames, not 2 to {MOST_FRAMES}")
    return start + step * np.arange(int(count))


def movie_frames(run: xr.Dataset, analysis: xr.Dataset | None, shot: Shot) -> MovieFrames:
    """Return the content of the frames, from the samples nearest to their times; no others are read.

    Raises ValueError as ``check``.
    """
    checked = check(run, shot)
    time = field_time(run)
    cells = run["cell"].values[checked.window]
    chain = Case.of(run).model().chain
    shown = int(cells[0]) - 1, int(cells[-1])
    cell = chain.mean_cell(*shown)

    # A cell with masses of its own counts as one with the mean masses whose motion has the same kinetic energy.
    weight = np.ones(1)
    if checked.has_waves and cell is not chain.cell:
        weight = np.sqrt(chain.coefficients(*shown).masses / cell.masses)
    taper = _taper(run, chain, len(cells))
    at_rest = np.zeros((len(taper) - len(cells), cell.dofs))

    wave = []
    waves = []
    # Samples lie at equal intervals.
    rows = np.rint((checked.time - time[0]) / (time[1] - time[0])).astype(int)
    for row in rows:
        velocity = run["velocity"][row, checked.window].values
        if not checked.has_waves:
            wave.append(velocity[None, :, cell.host])
            waves.append(np.zeros((0, cell.dofs)))
            continue

        v = np.concatenate([velocity * weight, at_rest])
        u = np.concatenate([run["displacement"][row, checked.window].values * weight, at_rest])
        waves.append(spectra.wave_energies(cell, u * taper, v * taper)[0])
        if shot.quantity == "energy":
            wave.append(spectra.band_envelopes(cell, u, v)[:, : len(cells)])
        else:
            wave.append(velocity[None, :, cell.host])

    sites = panels.recorded_sites(run, cells)
    wavenumber = np.zeros(0)
    if checked.has_waves:
        wavenumber = 2 * np.pi * np.fft.fftfreq(len(taper), 1.0)
    return MovieFrames(
        quantity=shot.quantity,
        cell=cell,
        time=checked.time,
        cells=cells,
        wave=np.array(wave),
        wavenumber=wavenumber,
        waves=np.array(waves),
        sites=sites,
        flash=_flash(run, sites, checked.time),
        energies=_energies(run, analysis),
    )


def _taper(run: xr.Dataset, chain: Chain, cells: int) -> np.ndarray:
    """Return the weights (cell, 1) in a transform of the shown ``cells``, and 0 for cells at rest behind them."""
    # A window cuts off the waves at its ends, whose spectrum would then be wide; all recorded cells are not cut.
    weights = np.ones(cells)
    if cells < run.sizes["cell"]:
        weights = spectra.taper(cells, spectra.TAPER)

    # The transform takes the last cell for a neighbour of the first, which it is in a whole ring only. Elsewhere cells
    # at rest, an eighth more, separate them.
    beyond = cells // 8 + 1
    if chain.ends == "periodic" and cells == chain.cells:
        beyond = 0
    return np.pad(weights, (0, beyond))[:, None]


def _flash(run: xr.Dataset, sites: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return the light (frame, site) of impacts: 1 for one since the frame before, fading then."""
    onset = run["impacts/onset"].values
    struck_cell = run["sites/cell"].values[run["impacts/site"].values.astype(int) - 1]
    step = time[1] - time[0]
    flash = np.zeros((len(time), len(sites)))
    light = np.zeros(len(sites))
    for k, now in enumerate(time):
        struck = np.isin(sites, struck_cell[(onset > now - step) & (onset <= now)])
        # The light fades slowly, since one that lasts a single frame would hardly be seen.
        light = np.where(struck, 1.0, FADE * light)
        flash[k] = light
    return flash


def _energies(run: xr.Dataset, analysis: xr.Dataset | None) -> BandEnergies:
    """Return the energies of the pass bands over time: of linear modes, or if there are none kinetic energies.

    Of a run without an analysis of bands, return the energy of the whole lattice.
    """
    for name, axis in (("bands/modal_energy", "bands/instant"), ("bands/energy", "bands/sample")):
        if analysis is not None and name in analysis:
            names = np.array(analysis[name].attrs["parts"])
            # Gaps hold no waves, and their lines would lie on the axis.
            is_band = np.char.startswith(names, "band")
            return BandEnergies(tuple(names[is_band]), analysis[axis].values, analysis[name].values[is_band])

    total = run["energy/kinetic"] + run["energy/spring"]
    return BandEnergies(("kinetic and springs",), run["time"].values, total.values[None])
