"""Energies of the pass bands and gaps of one run, by frequency filters, and the inter-band transfer."""

from collections.abc import Collection
from typing import Any

import numpy as np

from vipetsc import spectra
from vipetsc.lattice import pass_bands
from vipetsc.studies.velocity_record import VelocityRecord

ENDS = 0.02  # share of a record at either end where band energies are too inaccurate for a mean (manual, files.md)

# As ``studies.analysis.LAYOUT``.
BANDS = {
    "ibtet": ("", "1", "inter-band energy transfer"),
    "ibtet_whole": ("", "1", "inter-band energy transfer as the paper's: the record's last samples are in the mean"),
    "bands/edge": ("bands/edge", "1", "edge of a part"),
    "bands/part": ("bands/part", "1", "part of the frequency axis"),
    "bands/edges": ("bands/edge", "rad/s", "edges of the pass bands and gaps"),
    "bands/sample": ("bands/sample", "s", "time of a sample"),
    "bands/energy": ("bands/part bands/sample", "J", "kinetic energy of a part"),
    "bands/band": ("bands/band", "1", "part that holds pass bands"),
    "bands/kinetic_energy": ("bands/band time cell", "J", "kinetic energy of a part in a cell"),
    "bands/above": ("bands/part", "1", "1 for a pass band above the driven one"),
    "bands/total": ("bands/sample", "J", "kinetic energy"),
    "bands/share": ("bands/part", "1", "mean share of a part after the wave's arrival"),
}


def band_energies(record: VelocityRecord, measures: Collection[str]) -> dict[str, Any]:
    """Energies of the pass bands and gaps, and the inter-band transfer from the wave's arrival on."""
    parts, stride = spectra.Parts.of(pass_bands(record.model.chain.cell)), record.options.band_stride
    measured = record.weighted, record.masses, record.interval, parts.edges
    energy = spectra.part_energies(*measured, stride, record.memory)
    above = parts.above(record.model.drive.frequency)
    if record.site is None:
        after = int(np.searchsorted(record.time, record.model.drive.duration))
        first, reason = min(after, len(record.time) - 1), "the drive ends (the lattice has no sites)"
    else:
        at = int(np.argmin(np.abs(record.cells - record.site)))
        first = spectra.front_arrival(spectra.kinetic_energy(record.weighted[:, at], record.masses))
        reason = f"the kinetic energy of cell {record.cells[at]} first exceeds 1 % of its largest value"
    # The filters see less than the waves' length at the record's ends.
    nt, ends = len(record.time), int(np.ceil(ENDS * len(record.time)))
    first = min(max(first, ends), nt - 1)
    last = max(nt - ends, first + 1)
    total = energy[:, first:last].sum(axis=0)
    moving = total > 0
    about = {"start": record.time[first], "starts_when": f"{reason}, or after the first {ENDS:.0%} of the record"}
    about |= {"end": record.time[last - 1], "ends_when": f"before the last {ENDS:.0%} of the record"}
    names = {"parts": list(parts.names)}
    record.attributes |= {"bands/energy": names, "bands/share": about | names}
    coarse, some = energy.copy(), np.arange(0, nt, 2 * stride)
    coarse[-1] = np.interp(np.arange(nt), some, energy[-1, some])
    values: dict[str, Any] = {}
    whole = {"start": about["start"], "end": record.time[-1]}
    for name, stop, times in (("ibtet", last, about), ("ibtet_whole", nt, whole)):
        values[name], doubled = (spectra.ibtet(e[:, :stop], above, first) for e in (energy, coarse))
        error = abs(doubled - values[name]) if stride > 1 else 0.0
        record.attributes[name] = times | {"band_stride": stride, "sampling_error": error}
    if "maps" in measures:
        bands = np.flatnonzero([bool(inside) for inside in parts.bands])
        values["bands/band"] = bands + 1
        ranges = np.column_stack([parts.edges[bands], parts.edges[bands + 1]])
        values["bands/kinetic_energy"] = spectra.part_maps(*measured[:3], ranges, record.sizes, record.memory)
    return values | {
        "bands/edge": np.arange(len(parts.edges)),
        "bands/part": np.arange(1, len(parts.names) + 1),
        "bands/edges": parts.edges,
        "bands/energy": energy,
        "bands/above": above.astype(np.int8),
        "bands/share": (energy[:, first:last][:, moving] / total[moving]).mean(axis=1),
    }
