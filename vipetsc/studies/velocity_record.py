"""The velocity that a run kept, in memory or in its file, with the numbers of its case that measures need."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vipetsc import spectra
from vipetsc.case import Case
from vipetsc.case.schema import AnalysisTable
from vipetsc.io.netcdf import tabulated
from vipetsc.io.read import field_interval, field_time

# Axes that several measures have: dimension, unit and description.
AXES = {
    "time": ("time", "s", "time"),
    "cell": ("cell", "1", "cell"),
    "bands/sample": ("bands/sample", "s", "time of a sample"),
}


class VelocityRecord:
    """Velocity, axes and masses of a ``run`` of ``case``, measured with ``options``.

    ``velocity`` (t, cell, dof) is in m/s and ``masses`` (dof,) of the reference cell in kg. ``weighted`` is the
    velocity times sqrt(m/m_reference) of each mass: with the reference cell's masses it has the energies of the actual
    masses. ``time`` (t,) and ``interval`` are in s; ``cells`` (cell,) and ``site``, the cell of the site that the wave
    meets first (None without sites), are numbers from 1.

    Maps hold means over blocks of ``sizes`` (samples, cells), at ``mean_time`` and ``mean_cells``. Fields larger than
    ``memory`` in bytes stay in their file.
    """

    def __init__(self, run: xr.Dataset, case: Case, options: AnalysisTable) -> None:
        self.run = run
        self.options = options
        self.memory = options.memory * 2**30
        self.model = case.model()
        self.masses = np.asarray(self.model.chain.cell.masses)
        self.velocity: Any = self.field(run["velocity"])
        self.weighted = self.velocity
        if "lattice/masses" in run:
            self.weighted = self.field(run["velocity"], np.sqrt(run["lattice/masses"].values / self.masses))

        self.time = field_time(run)
        self.interval = field_interval(run)
        self.cells = run["cell"].values
        sites = run["sites/cell"].values
        first = case.nearest_site(sites)
        self.site = None if first is None else int(sites[first])

        # Rounded up: a map has at most so many pixels on either side.
        self.sizes = (-(-len(self.time) // options.pixels), -(-len(self.cells) // options.pixels))
        self.mean_time = spectra.block_means(self.time, self.sizes[0], 0)
        self.mean_cells = self.cells
        if self.sizes[1] > 1:
            self.mean_cells = spectra.block_means(self.cells, self.sizes[1], 0)

    def measures(
        self,
        layout: Mapping[str, tuple[str, str, str]],
        values: Mapping[str, Any],
        attributes: Mapping[str, Mapping[str, Any]] | None = None,
        left_out: Iterable[str] = (),
        **about: Any,
    ) -> xr.Dataset:
        """Return the ``values`` by name, with rows of the ``layout``, as a dataset with the axes that they need.

        ``attributes`` are those of variables by name; those of the dataset are sentences on what is ``left_out``, and
        what is said ``about`` all.
        """
        dims = {dim for name in values for dim in layout[name][0].split()}
        axes = {"time": self.mean_time, "cell": self.mean_cells, "bands/sample": self.time}
        values = {name: axis for name, axis in axes.items() if name in dims} | dict(values)
        data = xr.Dataset(tabulated(AXES | dict(layout), values), attrs={"left_out": [*left_out], **about})
        for name, texts in (attributes or {}).items():
            data[name].attrs.update(texts)
        return data

    def field(self, field: xr.DataArray, factor: ArrayLike = 1.0) -> Any:
        """Return a recorded ``field`` (t, cell, dof) times a ``factor``, a number 1 or (cell, dof).

        It is an array if it fits into the memory, else an object that reads slices from the file.
        """
        if field.nbytes > self.memory:
            return _StoredField(field, factor)
        return field.values * factor if np.ndim(factor) else field.values

    def mean(self, energy: np.ndarray) -> np.ndarray:
        """Return means of an ``energy`` (t, cell) over the blocks of a map, in single precision."""
        over_time = spectra.block_means(energy, self.sizes[0], 0)
        # Single precision halves the file, and is finer than any colour scale.
        return spectra.block_means(over_time, self.sizes[1], 1).astype(np.float32)


class _StoredField:
    """A field (t, cell, dof) that stays in its file: a slice of it is read, and multiplied by the ``factor``."""

    def __init__(self, field: xr.DataArray, factor: ArrayLike) -> None:
        self.shape = field.shape
        self._field = field
        self._factor = np.asarray(factor)

    def __getitem__(self, index: Any) -> np.ndarray:
        values = np.asarray(self._field[index].values)
        if not self._factor.ndim:
            return values
        return values * np.broadcast_to(self._factor, self.shape)[index]
