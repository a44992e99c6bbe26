"""What the pictures of a sweep with full fields are drawn from: one configuration at three amplitudes."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vipetsc.case import Case
from vipetsc.case.schema import LatticeTable
from vipetsc.figures.study import Study
from vipetsc.io.ensemble_file import EnsembleFile
from vipetsc.io.run_file import RunFile
from vipetsc.lattice.bloch import waves_at

AMPLITUDE = "amplitude"
LEVELS = ("Low", "Medium", "High")


@dataclass(frozen=True)
class Wave:
    """The linear wave at the drive's frequency: its ``band`` (1-based), wavenumber (rad/cell) and speed (cells/s)."""

    band: int
    wavenumber: float
    speed: float

    @classmethod
    def of(cls, case: Case) -> Wave | None:
        """The wave that ``case`` drives; None in a gap."""
        model = case.model()
        there = waves_at(model.chain.cell, model.drive.frequency)
        return cls(there[0][0], float(there[0][1]), abs(float(there[0][2]))) if there else None


@dataclass(frozen=True)
class WholeRun:
    """A member of a sweep with its fields: the drive's ``amplitude`` in N, ``run.h5`` and ``analysis.h5``."""

    amplitude: float
    run: RunFile
    analysis: h5py.File

    @property
    def sites(self) -> np.ndarray:
        """Recorded cells (site) that carry contacts."""
        cells = self.run.site_cells
        return cells[(cells >= self.run.cells[0]) & (cells <= self.run.cells[-1])]


@dataclass(frozen=True)
class Series:
    """One configuration at a low, a medium and a high amplitude.

    ``suffix`` tells it from the others of a study; ``words`` are the values of what else the sweep varies.
    """

    suffix: str
    runs: tuple[WholeRun, WholeRun, WholeRun]
    words: tuple[str, ...] = ()

    @property
    def case(self) -> Case:
        """The case at the low amplitude; the others differ from it in the amplitude alone."""
        return self.runs[0].run.case

    @cached_property
    def wave(self) -> Wave | None:
        """The linear wave at the drive's frequency."""
        return Wave.of(self.case)

    @property
    def title(self) -> str:
        """Reading, sites and wavenumber in words, and what else the sweep varies."""
        sites = len(self.case.contacts.sites)
        parts = [f"{self.case.lattice.reading.capitalize()} reading", *self.words, counted(sites, "site")]
        return ", ".join(parts + ([f"κ* = {in_pi(self.wave.wavenumber)}"] if self.wave else []))

    def headings(self) -> Iterator[tuple[int, WholeRun, str]]:
        """Column, run and the column's title."""
        for column, (level, member) in enumerate(zip(LEVELS, self.runs, strict=True)):
            yield column, member, f"{level} amplitude, {member.amplitude:g} N"


def series_of(study: Study, *needed: str) -> Iterator[Series]:
    """Every configuration of the sweeps with full fields at its lowest, middle and highest amplitude.

    ``needed`` names what their analyses must hold. Files are open until the next one is asked for.
    """
    found = [(e, trios) for e in study.ensembles if (trios := _trios(e))]
    for ensemble, trios in found:
        for places in trios:
            with ExitStack() as stack:
                runs = tuple(_opened(stack, *pair) for pair in places)
                if all("velocity" in r.run.file and all(name in r.analysis for name in needed) for r in runs):
                    place = places[0][0]
                    yield Series(suffix(ensemble, place, len(found) > 1), runs, _words(ensemble, place))


def _trios(ensemble: EnsembleFile) -> list[tuple[tuple[tuple[int, ...], Path], ...]]:
    """Places and folders of the lowest, middle and highest amplitude of every configuration that has three."""
    if AMPLITUDE not in ensemble.dimensions:
        return []
    along = ensemble.dimensions.index(AMPLITUDE)
    amplitude = ensemble.values(AMPLITUDE)
    rows: dict[tuple[int, ...], list[tuple[tuple[int, ...], Path]]] = {}
    for place, folder in ensemble.whole_members():
        rows.setdefault(place[:along] + place[along + 1 :], []).append((place, folder))
    trios = []
    for row in rows.values():
        row.sort(key=lambda pair: amplitude[pair[0][along]])
        if len(row) >= len(LEVELS):
            trios.append((row[0], row[len(row) // 2], row[-1]))
    return trios


def _opened(stack: ExitStack, _: tuple[int, ...], folder: Path) -> WholeRun:
    run = stack.enter_context(RunFile(folder / "run.h5"))
    return WholeRun(run.case.drive.amplitude, run, stack.enter_context(h5py.File(folder / "analysis.h5", "r")))


def suffix(
    ensemble: EnsembleFile, place: tuple[int, ...], named: bool = False, kept: Collection[str] | None = None
) -> str:
    """What tells the member at ``place`` from others, for a file's name; the amplitude aside.

    The sweep's name if it is to be ``named``, the reading, and whatever else has several values; of the dimensions
    only those ``kept``, by default all.
    """
    parts = [ensemble.sweep.name] if named else []
    parts += [] if "reading" in ensemble.dimensions else [reading_of(ensemble)]
    for name, index in zip(ensemble.dimensions, place, strict=True):
        values = ensemble.values(name)
        told = name in ("reading", "wavenumber") or len(values) > 1
        if name != AMPLITUDE and told and (kept is None or name in kept):
            parts.append(_word(name, values[index]))
    return "-".join(parts)


def _words(ensemble: EnsembleFile, place: tuple[int, ...]) -> tuple[str, ...]:
    """Values at ``place`` of the dimensions that a title does not name otherwise."""
    named = (AMPLITUDE, "reading", "wavenumber", "sites")
    varied = [(n, ensemble.values(n)[i]) for n, i in zip(ensemble.dimensions, place, strict=True) if n not in named]
    return tuple(value if isinstance(value, str) else f"{name} {value:g}" for name, value in varied)


def _word(name: str, value: Any) -> str:
    if name == "wavenumber":
        return in_pi(value).replace("π", "pi").replace("/", "-")
    text = value if isinstance(value, str) else f"{name}-{value:g}"
    return "".join(c if c.isalnum() or c in "-." else "-" for c in text)


def reading_of(ensemble: EnsembleFile) -> str:
    """The reading that all members of a sweep share which does not vary it."""
    given = ensemble.sweep.table.get("lattice", {})
    return str(given.get("reading", LatticeTable.model_fields["reading"].default))


def in_pi(wavenumber: float) -> str:
    """A wavenumber in rad/cell as 5π/9, or as a decimal where no such fraction is near."""
    share = float(wavenumber) / np.pi
    near = Fraction(share).limit_denominator(36)
    if abs(float(near) - share) > 1e-6:
        return f"{share:.3f}π"
    over = f"/{near.denominator}" if near.denominator > 1 else ""
    return f"{'' if near.numerator == 1 else near.numerator}π{over}"


def counted(number: int, noun: str) -> str:
    """``1 site``, ``5 sites``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
