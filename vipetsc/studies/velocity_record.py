"""What is measured: the velocity that a run kept, in memory or in its file, with what its case says of it."""

import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vipetsc import spectra
from vipetsc.case import Case
from vipetsc.case.case_file import read_toml
from vipetsc.case.schema import AnalysisTable
from vipetsc.io.read import field_interval, field_time, leading_site
from vipetsc.lattice import pass_bands


def options_of(run: xr.Dataset, folder: Path | None = None, overrides: Iterable[str] = ()) -> AnalysisTable:
    """``[analysis]`` of a ``run``, as the case in its ``folder`` has it now if it has one, with ``overrides``."""
    marker = folder / "case.toml" if folder else None
    table = read_toml(marker) if marker and marker.exists() else tomllib.loads(run.attrs["case"])
    return Case.from_table(table, overrides).analysis or AnalysisTable.model_validate({})


class VelocityRecord:
    """What the measures need of a run, and what they tell besides their values: attributes, and what is left out.

    ``masses`` (dof) of the reference cell in kg, ``velocity`` (t, cell, dof) in m/s and ``weighted`` the same times
    sqrt(m/m_reference) of each mass, so that its energies by the reference cell's masses are those of the masses there
    are; ``time`` (t) and ``interval`` in s, ``cells`` (cell) and ``site``, the leading one's cell, as numbers from 1.
    ``sizes`` are the blocks (samples, cells) of which maps hold the means, at ``mean_time`` and ``mean_cells``;
    ``memory`` in bytes. ``attributes`` are those of variables, of groups under "".
    """

    def __init__(self, run: xr.Dataset, options: AnalysisTable) -> None:
        field, leading = run["velocity"], leading_site(run)
        self.options, self.memory = options, options.memory * 2**30
        self.model = Case.of(run).model()
        self.masses = np.asarray(self.model.chain.cell.masses)
        self.velocity: Any = self.field(field)
        self.weighted = self.velocity
        if "lattice/masses" in run:
            self.weighted = self.field(field, np.sqrt(run["lattice/masses"].values / self.masses))
        self.time, self.interval, self.cells = field_time(run), field_interval(run), run["cell"].values
        self.site = None if leading is None else int(run["sites/cell"].values[leading])
        self.sizes = -(-len(self.time) // options.pixels), -(-len(self.cells) // options.pixels)
        self.mean_time = spectra.block_means(self.time, self.sizes[0], 0)
        self.mean_cells = spectra.block_means(self.cells, self.sizes[1], 0) if self.sizes[1] > 1 else self.cells
        self.attributes: dict[str, dict[str, Any]] = {}
        self.left_out: list[str] = []
        self.warnings: list[str] = []

    def field(self, field: xr.DataArray, factor: ArrayLike = 1.0) -> Any:
        """A recorded ``field``, read as a whole if it fits into the memory; times a ``factor`` (cell, dof)."""
        if field.nbytes > self.memory:
            return _StoredField(field, factor)
        return field.values * factor if np.ndim(factor) else field.values

    def unresolved(self) -> set[str]:
        """Measures that would take waves for longer or slower ones in what was kept; warns of them."""
        top, every = pass_bands(self.model.chain.cell)[-1].high, int(np.diff(self.cells).max(initial=1))
        names: set[str] = set()
        if top == 0:
            self.left_out.append("dispersion, bands, ibtet: a lattice without springs has no bands")
            names |= {"dispersion", "bands"}
        if self.interval * top >= np.pi:
            text = f"fields kept every {self.interval:.4g} s resolve {np.pi / self.interval:.5g} of {top:.5g} rad/s"
            self.warnings.append(f"{text}: dispersion, bands and ibtet are not measured")
            names |= {"dispersion", "bands"}
        if every > 1:
            text = f"fields of one cell in {every} do not resolve waves shorter than {2 * every} cells"
            self.warnings.append(f"{text}: wavenumber_content, dispersion, partition and entropy are not measured")
            names |= {"wavenumber", "dispersion", "partition", "entropy"}
        return names

    def mean(self, energy: np.ndarray) -> np.ndarray:
        """Means of ``energy`` (t, cell) over the blocks of a map."""
        return spectra.block_means(spectra.block_means(energy, self.sizes[0], 0), self.sizes[1], 1).astype(np.float32)


class _StoredField:
    """A field (t, cell, dof) that stays in its file; what is sliced is read, and multiplied by the ``factor``."""

    def __init__(self, field: xr.DataArray, factor: ArrayLike) -> None:
        self._field, self.shape, self._factor = field, field.shape, np.asarray(factor)

    def __getitem__(self, index: Any) -> np.ndarray:
        values = np.asarray(self._field[index].values)
        return values * np.broadcast_to(self._factor, self.shape)[index] if self._factor.ndim else values
