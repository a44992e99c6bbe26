"""Energies of the pass bands and gaps of one run, by frequency filters, and the inter-band transfer.

The frequency axis is cut at the edges of the pass bands. E_p(t) in J is the kinetic energy of all cells in the velocity
that is filtered to part p. The inter-band targeted energy transfer (ibtet) is the mean over time of the sum of E_p over
the bands above the driven one, over the sum of E_p of all parts (``spectra.ibtet``). The mean begins when the front of
the wave reaches the first site (``spectra.arrivals``).
"""

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from vipetsc import spectra
from vipetsc.lattice import pass_bands
from vipetsc.spectra.measures import MEASURES
from vipetsc.studies.velocity_record import VelocityRecord

ENDS = 0.02  # fraction of a record at either end where band energies are too inaccurate for a mean (manual, files.md)

# Dimension, unit and description of each variable.
BANDS = {
    "ibtet": MEASURES["ibtet"].row,
    "ibtet_whole": MEASURES["ibtet_whole"].row,
    "bands/edge": ("bands/edge", "1", "edge of a part"),
    "bands/part": ("bands/part", "1", "part of the frequency axis"),
    "bands/edges": ("bands/edge", "rad/s", "edges of the pass bands and gaps"),
    "bands/energy": ("bands/part bands/sample", "J", "kinetic energy of a part"),
    "bands/band": ("bands/band", "1", "part that contains pass bands"),
    "bands/kinetic_energy": ("bands/band time cell", "J", "kinetic energy of a part in a cell"),
    "bands/above": ("bands/part", "1", "1 for a pass band above the driven one"),
    "bands/total": ("bands/sample", "J", "kinetic energy"),
    "bands/share": ("bands/part", "1", "mean fraction of the energy in a part after the front's arrival"),
}


class AveragingSpan(NamedTuple):
    """The samples over which means of the energies are taken, from ``first`` to before ``last``.

    ``starts_when`` says in words what happens at the first one.
    """

    first: int
    last: int
    starts_when: str


def band_energies(record: VelocityRecord, asked: Collection[str]) -> xr.Dataset:
    """Return the energies of the pass bands and gaps, and the inter-band transfer from the front's arrival on.

    Energies of each cell are among them where they are ``asked`` for.
    """
    parts = spectra.Parts.of(pass_bands(record.model.chain.cell))
    above = parts.above(record.model.drive.frequency)
    stride = record.options.band_stride
    bands = np.flatnonzero([bool(inside) for inside in parts.bands])
    with_maps = "bands/kinetic_energy" in asked
    energies = spectra.part_energies(
        record.weighted,
        record.masses,
        record.interval,
        parts.edges,
        stride=stride,
        memory=record.memory,
        mapped=bands.tolist() if with_maps else (),
        sizes=record.sizes,
    )
    energy = energies.total
    span = _span(record)
    total = energy[:, span.first : span.last].sum(axis=0)
    # The energy at an instant without motion has no fractions.
    moving = total > 0
    fractions = np.full(len(energy), np.nan)
    if moving.any():
        fractions = (energy[:, span.first : span.last][:, moving] / total[moving]).mean(axis=1)

    times = {
        "start": record.time[span.first],
        "starts_when": span.starts_when,
        "end": record.time[span.last - 1],
        "ends_when": f"before the last {ENDS:.0%} of the record",
    }
    names = {"parts": list(parts.names)}
    attributes: dict[str, dict[str, Any]] = {"bands/energy": names, "bands/share": times | names}
    values: dict[str, Any] = {}
    for name, transfer in _transfers(record, energy, above, span).items():
        values[name] = transfer.value
        attributes[name] = {"band_stride": stride, "sampling_error": transfer.error}
    attributes["ibtet"] |= times
    attributes["ibtet_whole"] |= {"start": times["start"], "end": record.time[-1]}
    if with_maps:
        values["bands/band"] = bands + 1
        values["bands/kinetic_energy"] = energies.maps
    values |= {
        "bands/edge": np.arange(len(parts.edges)),
        "bands/part": np.arange(1, len(parts.names) + 1),
        "bands/edges": parts.edges,
        "bands/energy": energy,
        "bands/above": above.astype(np.int8),
        "bands/share": fractions,
    }
    left_out = [] if above.any() else ["ibtet: no pass band lies above the driven one"]
    return record.measures(BANDS, values, attributes, left_out)


def _span(record: VelocityRecord) -> AveragingSpan:
    """Return the samples from the front at the first site to the record's end, without the ends of the record."""
    samples = len(record.time)
    if record.site is None:
        after = int(np.searchsorted(record.time, record.model.drive.duration))
        first = min(after, samples - 1)
        reason = "the drive ends (the lattice has no sites)"
    else:
        # The nearest cell, since the one of the site may not have been kept.
        at = int(np.argmin(np.abs(record.cells - record.site)))
        first = spectra.front_arrival(spectra.kinetic_energy(record.weighted[:, at], record.masses))
        cell = record.cells[at]
        reason = f"the front is at the first site: the kinetic energy of cell {cell} first exceeds 1 % of its largest"

    # Near the record's ends, the filters miss the part of the wave beyond them.
    ends = int(np.ceil(ENDS * samples))
    first = min(max(first, ends), samples - 1)
    last = max(samples - ends, first + 1)
    return AveragingSpan(first, last, f"{reason}, or after the first {ENDS:.0%} of the record")


class Transfer(NamedTuple):
    """A transfer: its ``value``, and the ``error`` that the stride of samples makes."""

    value: float
    error: float


def _transfers(
    record: VelocityRecord, energy: np.ndarray, above: np.ndarray, span: AveragingSpan
) -> dict[str, Transfer]:
    """Return the transfer to the bands ``above`` over the ``span``, and as the paper's, to the record's end."""
    stride = record.options.band_stride
    samples = len(record.time)
    # Energies at twice the stride, interpolated, show the error that the stride makes.
    coarse = energy.copy()
    taken = np.arange(0, samples, 2 * stride)
    # Only the last part, above the bands, is sampled at a stride: all others are exact at every sample.
    coarse[-1] = np.interp(np.arange(samples), taken, energy[-1, taken])

    def transfer(end: int) -> Transfer:
        """Return the transfer up to before the sample ``end``."""
        value = spectra.ibtet(energy[:, :end], above, span.first)
        error = 0.0
        if stride > 1:
            error = abs(spectra.ibtet(coarse[:, :end], above, span.first) - value)
        return Transfer(value, error)

    return {"ibtet": transfer(span.last), "ibtet_whole": transfer(samples)}
