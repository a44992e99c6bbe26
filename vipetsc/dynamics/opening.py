"""The opening of a run: its samples before the first contact, taken from a linear run of the same lattice.

Until the first contact, a lattice of linear springs under a single drive moves in proportion to the drive's amplitude,
and its energies in proportion to the square. A run that differs from a linear one in its amplitude and its contacts can
therefore take the samples of that one, scaled, and go on from the scaled state after them. An engine of exact steps
comes to the same state itself, but for rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vipetsc.io.atomic import Arrays

if TYPE_CHECKING:
    import xarray as xr


class Opening(NamedTuple):
    """The samples of a linear ``run`` up to a checkpoint, and the ``state`` there, all times a ``factor``.

    ``run`` is a dataset of all samples and cells, with the fields that are to be recorded; on all ranks but the first
    it is not used. ``state`` are the parts of all ranks that wrote the checkpoint, in order.
    """

    run: xr.Dataset
    state: Sequence[Arrays]
    factor: float

    @property
    def samples(self) -> int:
        """Number of the samples."""
        return int(self.state[0]["samples"])

    def values(self, name: str) -> np.ndarray:
        """The samples of the variable ``name`` of the run, scaled."""
        scale = self.factor
        if name.startswith("energy/"):
            scale = self.factor**2
        return np.asarray(self.run[name].values[: self.samples] * scale)

    def put_field(self, name: str, cells: slice, stride: int, out: np.ndarray) -> None:
        """Write every ``stride``-th sample of the field ``name`` at ``cells``, scaled, to ``out`` (t, dof, cell)."""
        field = self.run[name].values[: self.samples : stride, cells]
        np.multiply(field.swapaxes(1, 2), self.factor, out=out)

    def checkpoint(self) -> list[Arrays]:
        """The checkpoint, scaled: the motion of the cells, and energies."""
        parts: list[Arrays] = []
        for part in self.state:
            scaled: dict[str, np.ndarray] = {}
            for name, values in part.items():
                fields = values.dtype.names or ()
                if name == "cells":
                    scaled[name] = values * self.factor
                elif "energy" in fields:
                    scaled[name] = values.copy()
                    scaled[name]["energy"] *= self.factor**2
                elif values.dtype.kind == "f":
                    # Energies: what dashpots dissipated, and what observers keep. The one length among these, the
                    # deepest indentation, is zero before the first contact.
                    scaled[name] = values * self.factor**2
                else:
                    scaled[name] = values
            parts.append(scaled)
        return parts
