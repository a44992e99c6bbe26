"""A read-only view of a finished sweep: its ``ensemble.h5`` and its members' folders; needs no MPI and no PETSc."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vipetsc.case import Case, Sweep


class EnsembleFile:
    """What a sweep left in ``folder``. Use it as a context manager.

    Raises
    ------
    OSError
        If ``ensemble.h5`` cannot be opened.
    ValueError
        If it is not one of ours.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.file = h5py.File(self.folder / "ensemble.h5", "r")
        if "status" not in self.file or "case" not in self.file.attrs:
            self.file.close()
            raise ValueError(f"{self.folder / 'ensemble.h5'} is not an ensemble of vipetsc: it has no status")

    def __enter__(self) -> EnsembleFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()

    @cached_property
    def sweep(self) -> Sweep:
        """The sweep with every range written out."""
        return Sweep.from_toml(self.file.attrs["case"])

    @cached_property
    def dimensions(self) -> tuple[str, ...]:
        """Names of the axes."""
        names = self.sweep.names()
        return tuple(names[axis.keys[0]] for axis in self.sweep.axes)

    def __contains__(self, name: str) -> bool:
        return name in self.file

    def values(self, name: str) -> np.ndarray:
        """Dataset ``name``: a measure over ``dimensions`` (and its own), or a coordinate; texts as str."""
        data = self.file[name]
        return data.asstr()[...] if h5py.check_string_dtype(data.dtype) else data[...]

    def curve(self, name: str, along: str, **fixed: Any) -> np.ndarray:
        """``name`` over the axis ``along``, the other axes held at the values ``fixed`` (first value if not named).

        ``curve("ibtet", "amplitude", law="hertz", sites=5)``; raises KeyError for a value that is not there.
        """
        place = self.place(**fixed)
        data = self.file[name]
        return data[tuple(slice(None) if d == along else place[i] for i, d in enumerate(self.dimensions))]

    def place(self, **fixed: Any) -> tuple[int, ...]:
        """Index on every axis of the first member with these coordinates; 0 on axes that are not named.

        Coordinates of the same axis (``sites=1, cycles=30`` of a zipped one) have to meet in one member.
        """
        place = {}
        for name, value in fixed.items():
            dimension = name if name in self.dimensions else self._dimension_of(name)
            there = self.values(name)
            match = np.isclose(there, value) if np.issubdtype(there.dtype, np.number) else there == value
            match &= place.get(dimension, True)
            if not np.any(match):
                raise KeyError(f"{name} = {value!r} is not in {self.folder}; there are {list(there)}")
            place[dimension] = match
        return tuple(int(np.argmax(place[name])) if name in place else 0 for name in self.dimensions)

    def _dimension_of(self, name: str) -> str:
        names = self.sweep.names()
        for axis in self.sweep.axes:
            if name in (names[key] for key in axis.keys):
                return names[axis.keys[0]]
        raise KeyError(f"{name} is no coordinate of {self.folder}; there are {', '.join(names.values())}")

    @cached_property
    def index(self) -> dict[str, Any]:
        """``index.json``."""
        return json.loads((self.folder / "index.json").read_text(encoding="utf-8"))

    def member(self, place: tuple[int, ...]) -> Path:
        """Folder of the member at ``place``: ``run.h5``, ``analysis.h5``, ``summary.json``; else ``folder``."""
        row = self.index["members"][int(np.ravel_multi_index(place, self.sweep.shape))]
        return self.folder / row["id"]

    def case(self, place: tuple[int, ...]) -> Case:
        """The resolved case of the member at ``place``."""
        return Case.load(self.member(place) / "case.toml")

    def curves(self, along: str = "amplitude") -> Iterator[tuple[Case, tuple[int | slice, ...]]]:
        """Every curve over the axis ``along``: the case of its first sound member, and the index of its values.

        ``values(name)[index]`` is the curve. Nothing if no axis has that name.
        """
        if along not in self.dimensions:
            return
        axis = self.dimensions.index(along)
        for place in np.ndindex(*(1 if i == axis else n for i, n in enumerate(self.sweep.shape))):
            members = [(*place[:axis], i, *place[axis + 1 :]) for i in range(self.sweep.shape[axis])]
            sound = [m for m in members if self.member(m) != self.folder]
            if sound:
                yield self.case(sound[0]), (*place[:axis], slice(None), *place[axis + 1 :])

    def whole_members(self) -> Iterator[tuple[tuple[int, ...], Path]]:
        """Places and folders of the members whose fields were kept."""
        if not self.sweep.options.fields:
            return
        for place in np.ndindex(*self.sweep.shape):
            folder = self.member(place)
            if (folder / "run.h5").exists() and (folder / "analysis.h5").exists():
                yield place, folder
