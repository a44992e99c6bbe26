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

MOST_FRAMES = 5000  # five minutes at the default rate
# Every frame transforms the motion of all shown cells, which are more than there are pixels.
MOST_CELLS = 20_000
FADE = 0.6  # factor of an impact's light from frame to frame: 0.4 s until it is too faint to be drawn


class Shot(NamedTuple):
    """A request for a movie of ``quantity`` ("energy" or "velocity"), from ``start`` to ``stop`` in s.

    ``speed`` in s of the run a second; ``rate`` in frames a second; ``cells``: the first and the last one, from 1;
    ``width`` in pixels.
    """

    quantity: str = "energy"
    start: float | None = None
    stop: float | None = None
    speed: float | None = None
    rate: float = RATE
    cells: tuple[int, int] | None = None
    width: int = WIDTH


class CheckedShot(NamedTuple):
    """A shot that a run allows: a ``window`` of its recorded cells and the ``time`` (frame) in s.

    ``has_waves``: whether waves can be separated, which takes displacement and velocity of cells side by side.
    """

    window: slice
    time: np.ndarray
    has_waves: bool


class BandEnergies(NamedTuple):
    """Energies (part, instant) in J of ``parts`` at ``instants`` in s."""

    parts: tuple[str, ...]
    instants: np.ndarray
    energy: np.ndarray


class MovieFrames(NamedTuple):
    """The content of frames: ``wave`` (frame, curve, cell), ``waves`` (frame, wavenumber, band) in J.

    ``time`` (frame) in s; ``cells`` (cell) from 1; ``wave`` is the energy in J of the bands by cell or the velocity in
    m/s of the host; ``wavenumber`` in rad/cell, empty if waves cannot be separated; ``flash`` (frame, site), the light
    of impacts at the cells ``sites``: 1 for one since the frame before, fading then. Where cells differ ``cell`` has
    the means of those shown, and masses are their own.
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
    """Return what ``run`` has of a ``shot``; raise ValueError that names the option that cannot be."""
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
        raise ValueError(f"--cells {first}:{last}: the run recorded cells {recorded[0]} to {recorded[-1]}")

    # By number, since a run may have recorded every n-th cell.
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
        raise ValueError(f"--from {start:g} --to {stop:g}: the run recorded {time[0]:g} to {time[-1]:g} s")

    # A frame at the end as well, although rounding may put it a little behind.
    step = (shot.speed or (stop - start) / LENGTH) / shot.rate
    count = (stop - start) / step * (1 + 1e-9) + 1
    if not 2 <= count < MOST_FRAMES + 1:
        how = "slow" if count > 2 else "fast"
        raise ValueError(f"--speed {step * shot.rate:g}: is too {how}: {count:.4g} frames, not 2 to {MOST_FRAMES}")
    return start + step * np.arange(int(count))


def movie_frames(run: xr.Dataset, analysis: xr.Dataset | None, shot: Shot) -> MovieFrames:
    """Return the content of the frames, from the samples nearest to them; others are not read. Raise as ``check``."""
    checked = check(run, shot)
    time = field_time(run)
    cells = run["cell"].values[checked.window]
    chain = Case.of(run).model().chain
    shown = int(cells[0]) - 1, int(cells[-1])
    cell = chain.mean_cell(*shown)

    # A cell with its own masses moves as one with the mean masses and the same kinetic energy.
    weight = np.ones(1)
    if checked.has_waves and cell is not chain.cell:
        weight = np.sqrt(chain.coefficients(*shown).masses / cell.masses)
    taper = _taper(run, chain, len(cells))
    at_rest = np.zeros((len(taper) - len(cells), cell.dofs))

    wave = []
    waves = []
    for row in np.rint((checked.time - time[0]) / (time[1] - time[0])).astype(int):  # samples are even in time
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
    wavenumber = 2 * np.pi * np.fft.fftfreq(len(taper), 1.0)
    return MovieFrames(
        quantity=shot.quantity,
        cell=cell,
        time=checked.time,
        cells=cells,
        wave=np.array(wave),
        wavenumber=wavenumber if checked.has_waves else np.zeros(0),
        waves=np.array(waves),
        sites=sites,
        flash=_flash(run, sites, checked.time),
        energies=_energies(run, analysis),
    )


def _taper(run: xr.Dataset, chain: Chain, cells: int) -> np.ndarray:
    """Return the weights (cell, 1) of the shown cells, and of those at rest behind them, in a transform."""
    # A part of the recorded cells is cut out of a wave, the whole is not.
    weights = np.ones(cells) if cells == run.sizes["cell"] else spectra.taper(cells, spectra.TAPER)

    # A transform joins the ends, which only a ring has joined: cells at rest between them.
    is_ring = chain.ends == "periodic" and cells == chain.cells
    beyond = 0 if is_ring else cells // 8 + 1
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
        # An impact lasts less than a frame: without the afterglow most would be seen by nobody.
        light = np.where(struck, 1.0, FADE * light)
        flash[k] = light
    return flash


def _energies(run: xr.Dataset, analysis: xr.Dataset | None) -> BandEnergies:
    """Return energies of bands without gaps, of linear modes or else kinetic ones; or else that of the lattice."""
    for name, axis in (("bands/modal_energy", "bands/instant"), ("bands/energy", "bands/sample")):
        if analysis is not None and name in analysis:
            names = np.array(analysis[name].attrs["parts"])
            # Gaps hold no waves, and their lines would lie on the axis.
            is_band = np.char.startswith(names, "band")
            return BandEnergies(tuple(names[is_band]), analysis[axis].values, analysis[name].values[is_band])

    total = run["energy/kinetic"] + run["energy/spring"]
    return BandEnergies(("kinetic and springs",), run["time"].values, total.values[None])
