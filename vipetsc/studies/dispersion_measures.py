"""Dispersions of a run: of all its cells, and of those before and after the first site.

A dispersion is the kinetic energy of the velocity's transform over time and cells, in bins of wavenumber and frequency
(``spectra.dispersions``): waves of a linear lattice lie on its Bloch bands. The part before the site has the wave that
comes and what is sent back, the part after it what passes.
"""

from collections.abc import Collection

import numpy as np
import xarray as xr
from scipy import fft

from vipetsc import spectra
from vipetsc.lattice import pass_bands
from vipetsc.studies.velocity_record import VelocityRecord

# Dispersion is kept up to this many times the top band's edge, to show what lies above it: in the built-in run 2e-4 of
# the energy beyond 1.1 times the edge, and 5e-5 beyond 1.4 times.
HEADROOM = 1.5

# Dimensions, units and description of each variable.
DISPERSIONS = {
    "wavenumber": ("wavenumber", "rad/cell", "wavenumber"),
    "frequency": ("frequency", "rad/s", "angular frequency"),
    "dispersion": ("wavenumber frequency", "J", "mean kinetic energy per bin"),
    "dispersion_before": ("wavenumber frequency", "J", "mean kinetic energy per bin, cells before the first site"),
    "dispersion_after": ("wavenumber frequency", "J", "mean kinetic energy per bin, cells after the first site"),
}


def dispersions_by_side(record: VelocityRecord, asked: Collection[str]) -> xr.Dataset:
    """Return dispersion of all cells, of those before and of those after the first site."""
    nt, cells = record.velocity.shape[:2]
    # Time is padded to a length that transforms fast; a padded row of cells would have other wavenumbers.
    length = fft.next_fast_len(nt, real=True)
    highest = HEADROOM * pass_bands(record.model.chain.cell)[-1].high
    frequencies = np.count_nonzero(2 * np.pi * fft.rfftfreq(length, record.interval) <= highest)
    # Wavenumbers and frequencies in a bin of the map. Wavenumbers of both signs are folded to half as many as cells, so
    # that the map has at most ``pixels`` of them, and twice as many frequencies.
    sizes = [-(-n // (2 * record.options.pixels)) for n in (cells, frequencies)]
    windows = _windows(record)
    left_out = []
    if len(windows) == 1:
        reason = "on a ring the wave travels in both directions"
        if record.site is None:
            reason = "the lattice has no sites"
        left_out.append(f"dispersion_before, dispersion_after: {reason}")
    for name in [name for name, window in windows.items() if len(range(cells)[window.cells]) < 2]:
        left_out.append(f"{name}: fewer than two of its cells were recorded")
        del windows[name]

    pieces: dict[str, list[spectra.Dispersion]] = {name: [] for name in windows}
    for block in spectra.blocks(-(-frequencies // sizes[1]), 16 * cells * sizes[1], record.memory):
        spectra_of_block = spectra.dispersions(
            record.weighted,
            record.masses,
            record.interval,
            [*windows.values()],
            lengths=(length, cells),
            highest=highest,
            memory=record.memory,
            rows=slice(block.start * sizes[1], block.stop * sizes[1]),
        )
        for window_pieces, spectrum in zip(pieces.values(), spectra_of_block, strict=True):
            window_pieces.append(spectrum.folded().pooled(*sizes))

    whole = pieces["dispersion"]
    values = {"wavenumber": whole[0].wavenumber, "frequency": np.concatenate([piece.frequency for piece in whole])}
    for name, window_pieces in pieces.items():
        values[name] = np.concatenate([piece.energy for piece in window_pieces], axis=1).astype(np.float32)
    return record.measures(DISPERSIONS, values, left_out=left_out)


def _windows(record: VelocityRecord) -> dict[str, spectra.CellWindow]:
    """Return the recorded cells of which a dispersion is taken, by its name: on a ring and without sites of all."""
    windows = {"dispersion": spectra.CellWindow()}
    if record.site is not None and record.model.chain.ends != "periodic":
        low, high = map(int, np.searchsorted(record.cells, [record.site, record.site + 1]))
        # A window with sharp borders would smear a wave that crosses one over all wavenumbers: wide flanks taper it
        # off.
        lower = spectra.CellWindow(slice(0, low), taper=0.5)
        upper = spectra.CellWindow(slice(high, len(record.cells)), taper=0.5)
        # The wave may travel to lower cells: before and after refer to its direction.
        drive_below = record.model.drive_cell < record.site
        windows["dispersion_before"] = lower if drive_below else upper
        windows["dispersion_after"] = upper if drive_below else lower
    return windows
