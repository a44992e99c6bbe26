"""What the frames of a movie of one run show: its wave, the waves that it consists of, impacts, energies of bands."""

from typing import NamedTuple

import numpy as np
import xarray as xr

from vipetsc import spectra
from vipetsc.case import Case
from vipetsc.figures import panels
from vipetsc.io.read import field_time
from vipetsc.lattice import UnitCell

LENGTH, RATE, WIDTH = 10.0, 15.0, 960  # in s, frames a second and pixels where none are asked for
MOST_FRAMES, MOST_CELLS = 5000, 20_000
FADE = 0.6  # of an impact's light from frame to frame


class Shot(NamedTuple):
    """What to show: "energy" or "velocity", from ``start`` to ``stop`` (s), ``speed`` s of the run in a second.

    ``rate`` in frames a second; ``cells`` are the first and the last one, from 1; ``width`` in pixels.
    """

    quantity: str = "energy"
    start: float | None = None
    stop: float | None = None
    speed: float | None = None
    rate: float = RATE
    cells: tuple[int, int] | None = None
    width: int = WIDTH


class Scenes(NamedTuple):
    """What frames show: ``wave`` (frame, curve, cell), ``waves`` (frame, wavenumber, band) in J.

    ``time`` (frame) in s; ``cells`` (cell) from 1; ``wave`` is the energy in J of the bands by cell or the velocity in
    m/s of the host; ``wavenumber`` in rad/cell, empty if waves cannot be told apart; ``flash`` (frame, site), the light
    of impacts: 1 for one since the frame before, fading then; ``energies`` (part, instant) in J of ``parts``. Where
    cells differ ``cell`` has the means of those shown, and masses are their own.
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
    parts: tuple[str, ...]
    instants: np.ndarray
    energies: np.ndarray


def check(run: xr.Dataset, shot: Shot) -> tuple[slice, np.ndarray, bool]:
    """The recorded cells and the times (frame) in s of a ``shot`` of ``run``; whether waves can be told apart.

    Raises ValueError that names the option that cannot be.
    """
    if "velocity" not in run:
        raise ValueError("--movie: the run recorded no velocity")
    every = run["cell"].values
    first, last = shot.cells or every[[0, -1]]
    if shot.cells and not every[0] <= first < last <= every[-1]:
        raise ValueError(f"--cells {first}:{last}: the run recorded cells {every[0]} to {every[-1]}")
    cells = every[window := slice(*np.searchsorted(every, (first, last + 1)).tolist())]
    if len(cells) > MOST_CELLS:
        raise ValueError(f"--movie: {len(cells)} cells are more than {MOST_CELLS}; name some with --cells A:B")
    whole = "displacement" in run and len(cells) > 1 and bool(np.all(np.diff(cells) == 1))
    if shot.quantity == "energy" and not whole:
        raise ValueError("--movie energy: needs displacement and velocity of cells side by side; --movie velocity")
    time = field_time(run)
    start, stop = (end if given is None else given for end, given in zip(time[[0, -1]], shot[1:3], strict=True))
    if not time[0] <= start < stop <= time[-1] * (1 + 1e-12):
        raise ValueError(f"--from {start:g} --to {stop:g}: the run recorded {time[0]:g} to {time[-1]:g} s")
    step = (shot.speed or (stop - start) / LENGTH) / shot.rate
    count = (stop - start) / step * (1 + 1e-9) + 1
    if not 2 <= count < MOST_FRAMES + 1:
        how = "slow" if count > 2 else "fast"
        raise ValueError(f"--speed {step * shot.rate:g}: is too {how}: {count:.4g} frames, not 2 to {MOST_FRAMES}")
    return window, start + step * np.arange(int(count)), whole


def scenes(run: xr.Dataset, analysis: xr.Dataset | None, shot: Shot) -> Scenes:
    """The content of the frames, from the samples nearest to them; others are not read. Raises as ``check``."""
    window, instants, whole = check(run, shot)
    time, cells, chain = field_time(run), run["cell"].values[window], Case.of(run).model().chain
    shown, count = (int(cells[0]) - 1, int(cells[-1])), len(cells)
    cell = chain.mean_cell(*shown)
    # A cell with its own masses moves as one with the mean masses and the same kinetic energy.
    weight = np.sqrt(chain.coefficients(*shown).masses / cell.masses) if whole and cell is not chain.cell else 1.0
    # Of a ring, which joins the ends: cells at rest between them.
    beyond = 0 if chain.ends == "periodic" and count == chain.cells else count // 8 + 1
    ends = np.ones(count) if count == run.sizes["cell"] else spectra.taper(count, spectra.TAPER)
    ends = np.pad(ends, (0, beyond))[:, None]
    wave, waves = [], []
    for row in np.rint((instants - time[0]) / (time[1] - time[0])).astype(int):  # samples are even in time
        fields = [run[name][row, window].values for name in ("velocity", "displacement")[: 1 + whole]]
        v, *u = (np.pad(field * weight, ((0, beyond), (0, 0))) for field in fields)
        by_band = shot.quantity == "energy"
        wave.append(spectra.band_envelopes(cell, u[0], v)[:, :count] if by_band else fields[0][None, :, cell.host])
        waves.append(spectra.wave_energies(cell, u[0] * ends, v * ends)[0] if whole else np.zeros((0, cell.dofs)))
    sites, site = panels.recorded_sites(run, cells), run["impacts/site"].values.astype(int) - 1
    at, onset = run["sites/cell"].values[site], run["impacts/onset"].values
    flash = np.zeros((len(instants), len(sites)))
    for k, now in enumerate(instants):
        struck = np.isin(sites, at[(onset > now - (instants[1] - instants[0])) & (onset <= now)])
        flash[k] = np.where(struck, 1.0, FADE * flash[k - 1] if k else 0.0)
    wavenumber = 2 * np.pi * np.fft.fftfreq(count + beyond, 1.0) if whole else np.zeros(0)
    energies = _energies(run, analysis)
    content = np.array(wave), wavenumber, np.array(waves)
    return Scenes(shot.quantity, cell, instants, cells, *content, sites, flash, *energies)


def _energies(run: xr.Dataset, analysis: xr.Dataset | None) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Parts, instants (s) and energies (part, instant) in J: of linear modes, or else kinetic; gaps are left out."""
    for name, axis in (("bands/modal_energy", "bands/instant"), ("bands/energy", "bands/sample")):
        if analysis is not None and name in analysis:
            names, energy = np.array(analysis[name].attrs["parts"]), analysis[name].values
            bands = np.char.startswith(names, "band")
            return tuple(names[bands]), analysis[axis].values, energy[bands]
    return ("kinetic and springs",), run["time"].values, (run["energy/kinetic"] + run["energy/spring"]).values[None]
