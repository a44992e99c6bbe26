"""What claims are measured from: the steps of the paper in one folder, and which of their files were read."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vipetsc.case import Case
from vipetsc.io.ensemble_file import EnsembleFile
from vipetsc.spectra import normalised

Place = tuple[int, ...]


class MissingEvidence(Exception):
    """What a claim is measured from is not there; the message says what."""


@dataclass(frozen=True)
class Member:
    """A member of a sweep whose fields were kept: its case, folder and ``analysis.h5``."""

    case: Case
    folder: Path
    analysis: h5py.File
    episodes: int

    @property
    def amplitude(self) -> float:
        """Amplitude of the drive in N."""
        return self.case.drive.amplitude


@dataclass(frozen=True)
class Curve:
    """A measure over rising ``amplitude`` (point) in N, without failed members, and the contact ``episodes``."""

    amplitude: np.ndarray
    value: np.ndarray
    episodes: np.ndarray

    @property
    def untouched(self) -> np.ndarray:
        """Which points (point) have no contact."""
        return self.episodes == 0

    @property
    def peak(self) -> int:
        """Index of the largest value."""
        return int(np.argmax(self.value))

    def normalised(self) -> np.ndarray:
        """The values on [.01, 1], as the paper's; NaN if they are all alike."""
        return normalised(self.value) if np.ptp(self.value) > 0 else np.full(len(self.value), np.nan)

    def rise(self, low: float, high: float) -> float:
        """Ratio of the amplitudes between which the values rise: from the last <= ``low`` to the first >= ``high``.

        Up to the peak; NaN if none is so low before it.
        """
        before = np.nonzero(self.value[: self.peak + 1] <= low)[0]
        above = np.nonzero(self.value[: self.peak + 1] >= high)[0]
        if not before.size or not above.size:
            return float("nan")
        first = above[above > before[-1]][0]
        return float(self.amplitude[first] / self.amplitude[before[-1]])

    def at(self, amplitude: float) -> float:
        """The value at ``amplitude`` in N, interpolated over its logarithm; NaN beyond the ends."""
        x = np.log(self.amplitude)
        return float(np.interp(np.log(amplitude), x, self.value, left=np.nan, right=np.nan))


class Evidence:
    """The steps in ``root``, opened as they are asked for. Use it as a context manager.

    ``files`` are those asked for so far, relative to ``root``, in order.
    """

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)
        self._stack = ExitStack()
        self._ensembles: dict[str, EnsembleFile] = {}
        self.files: list[str] = []

    def __enter__(self) -> Evidence:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def path(self, *parts: str) -> Path:
        """A file below ``root`` that is there, noted down; raises MissingEvidence."""
        path = self.root.joinpath(*parts)
        if not path.exists():
            raise MissingEvidence(f"{'/'.join(parts)} is missing")
        name = path.relative_to(self.root).as_posix()
        if name not in self.files:
            self.files.append(name)
        return path

    def hdf5(self, *parts: str) -> h5py.File:
        """An HDF5 file below ``root``; raises MissingEvidence."""
        path = self.path(*parts)
        try:
            return self._stack.enter_context(h5py.File(path, "r"))
        except OSError as error:
            raise MissingEvidence(f"{'/'.join(parts)} cannot be read: {error}") from None

    def ensemble(self, step: str) -> EnsembleFile:
        """The finished sweep of a step; raises MissingEvidence."""
        self.path(step, "ensemble.h5")
        if step not in self._ensembles:
            try:
                self._ensembles[step] = self._stack.enter_context(EnsembleFile(self.root / step))
            except (OSError, ValueError) as error:
                raise MissingEvidence(f"{step}: {error}") from None
        return self._ensembles[step]

    def place(self, step: str, reading: str, **fixed: Any) -> Place:
        """Where members of this ``reading`` with the coordinates ``fixed`` stand; raises MissingEvidence."""
        ensemble = self.ensemble(step)
        try:
            if "reading" in ensemble.dimensions:
                return ensemble.place(reading=reading, **fixed)
            place = ensemble.place(**fixed)
        except KeyError:
            wanted = ", ".join(f"{k} = {v:.6g}" if isinstance(v, float) else f"{k} = {v}" for k, v in fixed.items())
            wanted = f"reading = {reading}" + (f", {wanted}" if wanted else "")
            raise MissingEvidence(f"{step} has no members with {wanted}") from None
        own = ensemble.sweep.table.get("lattice", {}).get("reading", "calibrated")
        if own != reading:
            raise MissingEvidence(f"{step} has the reading {own!r} alone")
        return place

    def curve(self, step: str, name: str, place: Place) -> Curve:
        """The measure ``name`` over amplitude at ``place`` on the other axes; raises MissingEvidence."""
        ensemble = self.ensemble(step)
        if name not in ensemble or "amplitude" not in ensemble.dimensions:
            raise MissingEvidence(f"{step} holds no {name} over the amplitude")
        index = along_amplitude(ensemble, place)
        amplitude, value = ensemble.values("amplitude"), ensemble.values(name)[index]
        episodes = ensemble.values("contact_episodes")[index]
        order = np.argsort(amplitude, kind="stable")
        order = order[np.isfinite(value[order])]
        if not order.size:
            raise MissingEvidence(f"{step}: every member of a curve of {name} failed")
        return Curve(amplitude[order], value[order], episodes[order])

    def members(self, step: str, place: Place, *needed: str) -> list[Member]:
        """The members with fields at ``place``, one an amplitude, rising; raises MissingEvidence.

        ``needed`` names what their analyses must hold.
        """
        ensemble = self.ensemble(step)
        along = ensemble.dimensions.index("amplitude")
        amplitude = ensemble.values("amplitude")
        found = []
        for i in np.argsort(amplitude, kind="stable"):
            own = (*place[:along], int(i), *place[along + 1 :])
            folder = ensemble.member(own)
            if folder == ensemble.folder or not (folder / "analysis.h5").exists():
                raise MissingEvidence(f"{step}: the member at {amplitude[i]:g} N failed or is missing")
            analysis = self.hdf5(step, folder.name, "analysis.h5")
            for name in needed:
                if name not in analysis:
                    raise MissingEvidence(f"{step}/{folder.name}/analysis.h5 holds no {name}")
            episodes = int(ensemble.values("contact_episodes")[own])
            found.append(Member(ensemble.case(own), folder, analysis, episodes))
        return found


def along_amplitude(ensemble: EnsembleFile, place: Place) -> tuple[int | slice, ...]:
    """``place`` with the axis of amplitudes left open."""
    return tuple(slice(None) if d == "amplitude" else i for d, i in zip(ensemble.dimensions, place, strict=True))
