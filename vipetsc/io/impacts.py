"""The impacts of a run as a table: a row for each contact episode, with what it moved between bands where measured."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import open_run

if TYPE_CHECKING:
    import pandas as pd  # type: ignore[import-untyped]
    import xarray as xr

ANALYSIS = "analysis.h5"
TRANSFER = "bands/transfer"
CLUSTER = "bands/cluster_of_episode"
# The columns, in their order, and the names that they have in ``run.h5``.
COLUMNS = {
    "site": "impacts/site",
    "side": "impacts/side",
    "onset": "impacts/onset",
    "separation": "impacts/separation",
    "approach_velocity": "impacts/approach_velocity",
    "indentation": "impacts/indentation",
    "force": "impacts/force",
    "impulse": "impacts/impulse",
    "loss": "impacts/loss",
}


class RunResult(Protocol):
    """What ``simulate`` returns: a run in a ``folder``, or its ``dataset`` in memory."""

    @property
    def folder(self) -> Path | None:
        """The folder of the run; None of one in memory."""

    @property
    def dataset(self) -> xr.Dataset | None:
        """The run; None of one that was stopped, and in memory beyond rank 0."""


def impacts(run: str | Path | xr.Dataset | RunResult) -> pd.DataFrame:
    """Return a table of the impacts of a ``run``: what ``simulate`` returns, a folder, a ``run.h5``, or a dataset.

    The index ``episode`` counts impacts by their onsets, from 1. Columns are the ``cell``, of a strip also the ``row``,
    and those of ``COLUMNS``, in SI units, which ``attrs["units"]`` has by column. Where the folder has an analysis with
    the energies of the linear modes there are also ``cluster``, the number of the group of impacts that overlap in
    time, and for each part of the frequency axis ``transfer to PART`` in J: what the impact moved to it, NaN in a
    cluster of several impacts, which cannot be told apart. Raises OSError or ValueError as ``open_run``, and ValueError
    for a run without results here.
    """
    if not isinstance(run, str | Path | Mapping):
        held = run.folder or run.dataset
        if held is None:
            raise ValueError("the run was stopped, or is that of another rank")
        run = held
    if not isinstance(run, str | Path):
        return _table(run, None)
    path = Path(run)
    if path.is_dir():
        path = path / "run.h5"

    with open_run(path) as opened:
        measured = path.with_name(ANALYSIS)
        if not measured.exists():
            return _table(opened, None)
        with open_netcdf(measured, "analysis") as analysis:
            return _table(opened, analysis)


def _table(run: xr.Dataset, analysis: xr.Dataset | None) -> pd.DataFrame:
    """Return the table of ``impacts`` from an opened ``run``, and its ``analysis`` if there is one."""
    import pandas as pd

    columns: dict[str, Any] = {}
    units: dict[str, str] = {}
    for name, variable in COLUMNS.items():
        columns[name] = run[variable].values
        units[name] = run[variable].attrs["units"]
        if name == "site":
            columns["cell"] = run["sites/cell"].values[columns["site"].astype(int) - 1]
            units["cell"] = "1"
            # Of a strip of the plane.
            if "sites/row" in run:
                columns["row"] = run["sites/row"].values[columns["site"].astype(int) - 1]
                units["row"] = "1"

    # An analysis that is older than its run may have other impacts.
    if analysis is not None and CLUSTER in analysis and analysis.sizes["bands/episode"] == run.sizes["episode"]:
        cluster = analysis[CLUSTER].values.astype(int)
        columns["cluster"] = cluster
        units["cluster"] = "1"
        is_alone = np.bincount(cluster, minlength=cluster.max(initial=0) + 1)[cluster] == 1
        transfer = analysis[TRANSFER]
        for part, moved in zip(np.atleast_1d(transfer.attrs["parts"]), transfer.values.T, strict=True):
            columns[f"transfer to {part}"] = np.where(is_alone, moved[cluster - 1], np.nan)
            units[f"transfer to {part}"] = transfer.attrs["units"]

    table = pd.DataFrame(columns, index=pd.Index(run["episode"].values, name="episode"))
    table.attrs["units"] = units
    return table
