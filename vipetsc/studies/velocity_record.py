"""The velocity that a run kept, in memory or in its file, with the numbers of its case that measures need."""

from copy import copy
from typing import Any, Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vipetsc import spectra
from vipetsc.case import Case
from vipetsc.case.schema import AnalysisTable
from vipetsc.io.read import field_interval, field_time
from vipetsc.lattice import wave_bands
from vipetsc.lattice.topology import Topology


class VelocityRecord:
    """Velocity, axes and masses of a ``run`` of ``case``, measured with ``options``.

    ``velocity`` (t, cell, dof) is in m/s and ``masses`` (dof,) of the reference cell in kg. ``weighted`` is the
    velocity times sqrt(m/m_reference) of each mass: with the reference cell's masses it has the energies of the actual
    masses. ``time`` (t,) and ``interval`` are in s; ``cells`` (cell,) and ``site``, the cell of the site that the wave
    meets first (None without sites), are numbers from 1.

    Maps hold means over blocks of ``sizes`` (samples, cells), at ``mean_time`` and ``mean_cells``. Fields larger than
    ``memory`` in bytes stay in their file. Measures enter the ``attributes`` of their variables, by name (those of the
    analysis under ""), and sentences about what is ``left_out``, and ``warnings``.
    """

    def __init__(self, run: xr.Dataset, case: Case, options: AnalysisTable) -> None:
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
        first = Topology(case.lattice.cells, case.lattice.ends).nearest_index(sites, case.drive.cell)
        self.site = None if first is None else int(sites[first])

        # Rounded up: a map has at most so many pixels on either side.
        self.sizes = (-(-len(self.time) // options.pixels), -(-len(self.cells) // options.pixels))
        self.mean_time = spectra.block_means(self.time, self.sizes[0], 0)
        self.mean_cells = self.cells
        if self.sizes[1] > 1:
            self.mean_cells = spectra.block_means(self.cells, self.sizes[1], 0)

        self.attributes: dict[str, dict[str, Any]] = {}
        self.left_out: list[str] = []
        self.warnings: list[str] = []

    def blank(self) -> Self:
        """Return a copy of the record without measures: no attributes, nothing left out, no warnings."""
        record = copy(self)
        record.attributes = {}
        record.left_out = []
        record.warnings = []
        return record

    def field(self, field: xr.DataArray, factor: ArrayLike = 1.0) -> Any:
        """Return a recorded ``field`` (t, cell, dof) times a ``factor``, a number 1 or (cell, dof).

        It is an array if it fits into the memory, else an object that reads slices from the file.
        """
        if field.nbytes > self.memory:
            return _StoredField(field, factor)
        return field.values * factor if np.ndim(factor) else field.values

    def unresolved(self) -> set[str]:
        """Return names of the groups of measures that what was kept does not resolve, with a warning for each.

        Fields that are stored at too few samples, or of too few cells, show waves as slower or longer ones (aliasing).
        """
        bands = wave_bands(self.model.chain.cell)
        every = int(np.diff(self.cells).max(initial=1))
        names: set[str] = set()
        if not bands:
            self.left_out.append("dispersion, bands, ibtet: without springs from cell to cell a lattice has no bands")
            names |= {"dispersion", "bands"}
        # The Nyquist limit: the top band would appear at lower frequencies.
        elif self.interval * bands[-1].high >= np.pi:
            top = bands[-1].high
            text = f"fields stored every {self.interval:.4g} s resolve {np.pi / self.interval:.5g} of {top:.5g} rad/s"
            self.warnings.append(f"{text}: dispersion, bands and ibtet are not measured")
            names |= {"dispersion", "bands"}
        if every > 1:
            text = f"fields of one cell in {every} do not resolve waves shorter than {2 * every} cells"
            self.warnings.append(f"{text}: wavenumber_content, dispersion, partition and entropy are not measured")
            names |= {"wavenumber", "dispersion", "partition", "entropy"}
        return names

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
