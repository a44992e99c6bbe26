"""Energies of the linear modes of a run by band, gap and wavenumber, and the energy that contacts transferred.

Without contacts and drive the energy |z|^2/2 of a linear mode is constant (``lattice.modes``). E_p is the sum over the
modes of a part p of the frequency axis. Contacts that occur between the same two samples, at t_b and t_e, form a
cluster. Its transfer to part p is E_p(t_e) - E_p(t_b), minus the change that the drive would have caused in the lattice
without contacts.
"""

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from vipetsc.spectra.measures import MEASURES
from vipetsc.spectra.modal_energies import ModalParts, cluster_samples
from vipetsc.studies.velocity_record import VelocityRecord

# Samples at bounds of clusters; where there would be more, these lie at every n-th sample alone. The energies of all
# modes are computed at each: in the built-in lattice a thousand take 0.2 s of CPU, a quarter of the analysis.
MOST_BRACKETS = 1000

# Dimensions, unit and description of each variable.
MODAL = {
    "upper_share_at_end": MEASURES["upper_share_at_end"].row,
    "bands/part": ("bands/part", "1", "part of the frequency axis"),
    "bands/instant": ("bands/instant", "s", "time of an energy of the linear modes"),
    "bands/modal_energy": ("bands/part bands/instant", "J", "energy of the linear modes in a part"),
    "bands/bin": ("bands/bin", "1", "wavenumber bin, of twelve from 0 to pi"),
    "bands/bin_energy": ("bands/bin bands/instant", "J", "energy of the linear modes in a wavenumber bin"),
    "bands/drive_work": ("bands/part", "J", "change of a part's energy over the run minus the transfers"),
    "bands/cluster": ("bands/cluster", "1", "cluster of contact episodes, by onset"),
    "bands/transfer": ("bands/cluster bands/part", "J", "energy that a cluster transferred to a part"),
    "bands/cluster_begin": ("bands/cluster", "s", "last sample before a cluster"),
    "bands/cluster_end": ("bands/cluster", "s", "first sample after a cluster"),
    "bands/episode": ("bands/episode", "1", "contact episode, as in the log of impacts"),
    "bands/cluster_of_episode": ("bands/episode", "1", "cluster that an episode belongs to"),
}


def modal_energies(record: VelocityRecord, asked: Collection[str]) -> xr.Dataset:
    """Return variables of ``MODAL``: at the last sample alone, or over time where transfers are ``asked`` for."""
    run = record.run
    time = record.time
    try:
        parts = ModalParts.of(record.model.chain)
    except ValueError as error:
        return record.measures(MODAL, {}, left_out=[f"upper_share_at_end, bands/modal_energy: {error}"])

    names = parts.parts.names
    kind = f"of a ring of {parts.modes.cells} cells"
    if parts.modes.exact:
        kind = "of the lattice"
    attributes: dict[str, dict[str, Any]] = {"bands/modal_energy": {"parts": list(names), "modes": kind}}
    values: dict[str, Any] = {"bands/part": np.arange(1, len(names) + 1)}
    if "displacement" in run and "bands/transfer" in asked:
        history = _history(record, parts)
        values |= history.values
        attributes["bands/modal_energy"] |= {"modal_stride": record.options.modal_stride, "error": history.error}
        attributes["bands/transfer"] = {"parts": list(names), "cluster_stride": history.stride}
    else:
        if "displacement" in run:
            last = run["displacement"][-1:].values
        else:
            # Runs that keep no displacement keep the last one, without a dimension for time.
            last = run["end/displacement"].values[None]
        energy = parts.energies(last, np.asarray(record.velocity[-1:]), np.zeros(1, int))
        values["bands/instant"] = time[-1:]
        values["bands/modal_energy"] = energy.sum(axis=1)

    work = float(run["energy/work"].values[np.searchsorted(run["time"].values, time[-1])])
    above = parts.parts.above(record.model.drive.frequency)
    upper = np.nan
    if above.any() and work:
        upper = values["bands/modal_energy"][above, -1].sum() / work
    return record.measures(MODAL, values | {"upper_share_at_end": upper}, attributes)


class ModalHistory(NamedTuple):
    """Variables of ``MODAL`` over time by name, the largest ``error`` of their sum, and the ``stride`` of clusters."""

    values: dict[str, Any]
    error: float
    stride: int


def _history(record: VelocityRecord, parts: ModalParts) -> ModalHistory:
    """Return energies at every ``modal_stride``-th sample and at the bounds of clusters, and the transfers of these."""
    run = record.run
    time = record.time
    displacement = record.field(run["displacement"])
    clusters = _clusters(run, time)
    last = len(time) - 1
    # The bounds of clusters are among the instants, so that transfers are differences of energies that are kept.
    rows = np.unique([*range(0, last, record.options.modal_stride), *np.unique(clusters.bounds), last])
    energy = parts.energies(displacement, record.velocity, rows, record.memory)
    by_part = energy.sum(axis=1)

    at_bounds = by_part.T[np.searchsorted(rows, clusters.bounds)]
    transfer = np.diff(at_bounds, axis=1)[:, 0]
    # While a drive acts, the energy that it gives between the bounds is not transferred by contacts.
    drives_end = max(drive.waveform.duration for drive in record.model.drives)
    for c in np.flatnonzero(time[clusters.bounds[:, 0]] < drives_end):
        begin = clusters.bounds[c, :1]
        state = parts.modes.amplitudes(np.asarray(displacement[begin]), np.asarray(record.velocity[begin]))[0]
        transfer[c] -= parts.driven_change(state, record.model.drives, time[clusters.bounds[c]])

    stored = (run["energy/kinetic"] + run["energy/spring"]).values[np.searchsorted(run["time"].values, time[rows])]
    # 1e-300, since a lattice that never moved has no energy to divide by.
    error = np.abs(by_part.sum(axis=0) - stored).max() / max(stored.max(), 1e-300)
    values = {
        "bands/instant": time[rows],
        "bands/modal_energy": by_part,
        "bands/bin": np.arange(1, energy.shape[1] + 1),
        "bands/bin_energy": energy.sum(axis=0),
        "bands/drive_work": by_part[:, -1] - by_part[:, 0] - transfer.sum(axis=0),
        "bands/cluster": np.arange(1, len(clusters.bounds) + 1),
        "bands/transfer": transfer,
        "bands/cluster_begin": time[clusters.bounds[:, 0]],
        "bands/cluster_end": time[clusters.bounds[:, 1]],
        "bands/episode": np.arange(1, len(clusters.by_episode) + 1),
        "bands/cluster_of_episode": clusters.by_episode + 1,
    }
    return ModalHistory(values, error, clusters.stride)


class Clusters(NamedTuple):
    """Samples (cluster, begin and end) that bound the contacts, which lie at multiples of ``stride``.

    ``by_episode`` is the cluster of every contact episode.
    """

    bounds: np.ndarray
    by_episode: np.ndarray
    stride: int


def _clusters(run: xr.Dataset, time: np.ndarray) -> Clusters:
    """Return the clusters of contacts of a ``run``, strided so that at most ``MOST_BRACKETS`` samples bound them."""
    onset = run["impacts/onset"].values
    separation = run["impacts/separation"].values
    stride = 1
    while True:
        clusters = Clusters(*cluster_samples(onset, separation, time, stride), stride=stride)
        if len(np.unique(clusters.bounds)) <= MOST_BRACKETS:
            return clusters
        # The next stride, not twice the stride: how many bounds fall together does not grow evenly with it.
        stride += 1
