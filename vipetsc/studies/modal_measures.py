"""Energies of the linear modes of one run by band, gap and wavenumber, and what the contacts moved between them.

Contacts of sites that touch between the same two samples are one cluster, whose transfer is the change of the energies
between these samples, less what the drive would have changed in the lattice without contacts.
"""

from collections.abc import Collection
from typing import Any

import numpy as np
import xarray as xr

from vipetsc.spectra.modal_energies import ModalParts, cluster_samples
from vipetsc.studies.velocity_record import VelocityRecord

MOST_BRACKETS = 1000  # samples around contacts; where there were more, clusters begin and end at every n-th alone

# As ``studies.analysis.LAYOUT``.
MODAL = {
    "upper_share_at_end": ("", "1", "energy of the bands above the driven one at the end, over the drive's work"),
    "bands/instant": ("bands/instant", "s", "time of an energy of the linear modes"),
    "bands/modal_energy": ("bands/part bands/instant", "J", "energy of the linear modes in a part"),
    "bands/bin": ("bands/bin", "1", "wavenumber bin, of twelve from 0 to pi"),
    "bands/bin_energy": ("bands/bin bands/instant", "J", "energy of the linear modes in a wavenumber bin"),
    "bands/drive_work": ("bands/part", "J", "what the drive gave to a part beside the contacts' transfers"),
    "bands/cluster": ("bands/cluster", "1", "cluster of contact episodes, by onset"),
    "bands/transfer": ("bands/cluster bands/part", "J", "energy that a cluster gave to a part"),
    "bands/cluster_begin": ("bands/cluster", "s", "last sample before a cluster"),
    "bands/cluster_end": ("bands/cluster", "s", "first sample after a cluster"),
    "bands/episode": ("bands/episode", "1", "contact episode, as in the log of impacts"),
    "bands/cluster_of_episode": ("bands/episode", "1", "cluster that an episode belongs to"),
}


def modal_energies(run: xr.Dataset, record: VelocityRecord, measures: Collection[str]) -> dict[str, Any]:
    """The variables of ``MODAL``: at the last sample alone, or with "transfers" among the ``measures`` over time."""
    chain, time = record.model.chain, record.time
    recorded = [name for name in ("displacement", "end/displacement") if name in run]
    if len(record.cells) < chain.cells or not recorded:
        missing = f"{chain.cells - len(record.cells)} cells were" if recorded else "the displacement was"
        record.left_out.append(f"upper_share_at_end, bands/modal_energy: {missing} not recorded")
        return {}
    try:
        if not chain.cell.springs:
            raise ValueError("a lattice without springs has no modes")
        parts = ModalParts.of(chain)
    except ValueError as error:
        record.left_out.append(f"upper_share_at_end, bands/modal_energy: {error}")
        return {}
    names = parts.parts.names
    kind = "of the lattice" if parts.modes.exact else f"of a ring of {parts.modes.cells} cells"
    record.attributes["bands/modal_energy"] = {"parts": list(names), "modes": kind}
    values: dict[str, Any] = {"bands/part": np.arange(1, len(names) + 1)}
    if recorded[0] == "displacement" and "transfers" in measures:
        values |= _history(run, record, parts)
    else:
        last = run[recorded[0]][-1:] if recorded[0] == "displacement" else run[recorded[0]].expand_dims("time")
        energy = parts.energies(last.values, np.asarray(record.velocity[-1:]), np.zeros(1, int))
        values |= {"bands/instant": time[-1:], "bands/modal_energy": energy.sum(axis=1)}
    work = float(run["energy/work"].values[np.searchsorted(run["time"].values, time[-1])])
    above = parts.parts.above(record.model.drive.frequency)
    upper = values["bands/modal_energy"][above, -1].sum() / work if above.any() and work else np.nan
    return values | {"upper_share_at_end": upper}


def _history(run: xr.Dataset, record: VelocityRecord, parts: ModalParts) -> dict[str, Any]:
    """Energies at every ``modal_stride``-th sample and around contacts, and the transfers of these."""
    time, model, fields = record.time, record.model, (record.field(run["displacement"]), record.velocity)
    last, stride, onset, separation = len(time) - 1, 0, run["impacts/onset"].values, run["impacts/separation"].values
    brackets = np.zeros(MOST_BRACKETS + 1)
    while len(brackets) > MOST_BRACKETS:
        stride += 1
        bounds, cluster = cluster_samples(onset, separation, time, stride)
        brackets = np.unique(bounds)
    rows = np.unique([*range(0, last, record.options.modal_stride), *brackets, last])
    energy = parts.energies(*fields, rows, record.memory)
    by_part = energy.sum(axis=1)
    transfer = np.diff(by_part.T[np.searchsorted(rows, bounds)], axis=1)[:, 0]
    for c in np.flatnonzero(time[bounds[:, 0]] < max(drive.waveform.duration for drive in model.drives)):
        u, v = (np.asarray(field[bounds[c, :1]]) for field in fields)
        state = parts.modes.amplitudes(u, v)[0]
        transfer[c] -= parts.driven_change(state, model.drives, time[bounds[c]])
    expected = (run["energy/kinetic"] + run["energy/spring"]).values[np.searchsorted(run["time"].values, time[rows])]
    error = np.abs(by_part.sum(axis=0) - expected).max() / max(expected.max(), 1e-300)
    record.attributes["bands/modal_energy"] |= {"modal_stride": record.options.modal_stride, "error": error}
    names = list(parts.parts.names)
    record.attributes["bands/transfer"] = {"parts": names, "cluster_stride": stride}
    return {
        "bands/instant": time[rows],
        "bands/modal_energy": by_part,
        "bands/bin": np.arange(1, energy.shape[1] + 1),
        "bands/bin_energy": energy.sum(axis=0),
        "bands/drive_work": by_part[:, -1] - by_part[:, 0] - transfer.sum(axis=0),
        "bands/cluster": np.arange(1, len(bounds) + 1),
        "bands/transfer": transfer,
        "bands/cluster_begin": time[bounds[:, 0]],
        "bands/cluster_end": time[bounds[:, 1]],
        "bands/episode": np.arange(1, len(cluster) + 1),
        "bands/cluster_of_episode": cluster + 1,
    }
