"""One configuration of a sweep with full fields at three amplitudes, and the linear wave that it drives."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import xarray as xr

from vipetsc.case import Case
from vipetsc.figures.panels import recorded_sites
from vipetsc.figures.study import AMPLITUDE, MeasuredRun, Study, counted, grouped, in_pi, sites_of, suffix
from vipetsc.io.read import axes, field_time, whole_members
from vipetsc.lattice.bloch import waves_at

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
        waves = waves_at(model.chain.cell, model.drive.frequency)
        return cls(waves[0][0], float(waves[0][1]), abs(float(waves[0][2]))) if waves else None


@dataclass(frozen=True)
class AmplitudeSeries:
    """One configuration at a low, a medium and a high amplitude.

    ``suffix`` tells it from the others of a study; ``varied`` are the values of what else the sweep varies.
    """

    suffix: str
    runs: tuple[MeasuredRun, ...]
    varied: tuple[str, ...] = ()

    @property
    def case(self) -> Case:
        """The case at the low amplitude; the others differ from it in the amplitude alone."""
        return self.runs[0].case

    @cached_property
    def drives_a_wave(self) -> bool:
        """Whether the drive's frequency lies in a pass band."""
        return Wave.of(self.case) is not None

    @cached_property
    def wave(self) -> Wave:
        """The linear wave at the drive's frequency; raises ValueError in a gap."""
        wave = Wave.of(self.case)
        if wave is None:
            raise ValueError("the drive's frequency lies in a gap")
        return wave

    @property
    def title(self) -> str:
        """Reading, sites and wavenumber, and what else the sweep varies."""
        parts = [f"{self.case.lattice.reading.capitalize()} reading", *self.varied]
        parts.append(counted(len(sites_of(self.case)), "site"))
        return ", ".join(parts + ([f"κ* = {in_pi(self.wave.wavenumber)}"] if self.drives_a_wave else []))

    def headings(self) -> Iterator[tuple[int, MeasuredRun, str]]:
        """Column, run and the column's title."""
        for column, (level, member) in enumerate(zip(LEVELS, self.runs, strict=True)):
            yield column, member, f"{level} amplitude, {member.amplitude:g} N"

    def snapshot_times(self) -> np.ndarray:
        """Four times in s, from the linear wave: half way to the first site, at it, past the last, near the end.

        The packet's middle leaves the driven cell when half the burst is over.
        """
        member, speed = self.runs[0], self.wave.speed
        distance = np.abs(recorded_sites(member.run) - 1 - member.model.drive_cell)
        burst, end = member.model.drive.duration, field_time(member.run)[-1]
        near, far = distance.min() / speed, distance.max() / speed
        return np.minimum(np.array([0.5 * burst + 0.5 * near, 0.5 * burst + near, burst + far, 0.95 * end]), end)


def series_of(study: Study, *needs: str) -> Iterator[AmplitudeSeries]:
    """Every configuration of the sweeps with full fields at its lowest, middle and highest amplitude.

    ``needs`` names what their analyses must hold. Files are open until the next one is asked for.
    """
    triples = [(ensemble, found) for ensemble in study.ensembles if (found := _triples(ensemble))]
    for ensemble, configurations in triples:
        for triple in configurations:
            with ExitStack() as stack:
                runs = tuple(stack.enter_context(MeasuredRun.open(folder)) for _, folder in triple)
                if all("velocity" in r.run and all(name in r.analysis for name in needs) for r in runs):
                    first = triple[0][0]
                    yield AmplitudeSeries(suffix(first, ensemble, len(triples) > 1), runs, _varied(first, ensemble))


def _triples(ensemble: xr.Dataset) -> list[list[tuple[xr.Dataset, Path]]]:
    """Members and folders at the lowest, middle and highest amplitude of every configuration that has three."""
    if AMPLITUDE not in axes(ensemble):
        return []
    others = [name for name in axes(ensemble) if name != AMPLITUDE]
    rows = grouped(whole_members(ensemble), lambda pair: repr([pair[0][name].item() for name in others]))
    triples = []
    for row in rows.values():
        row.sort(key=lambda pair: pair[0][AMPLITUDE].item())
        if len(row) >= len(LEVELS):
            triples.append([row[0], row[len(row) // 2], row[-1]])
    return triples


def _varied(member: xr.Dataset, ensemble: xr.Dataset) -> tuple[str, ...]:
    """Values of the axes that a title does not name otherwise."""
    names = [name for name in axes(ensemble) if name not in (AMPLITUDE, "reading", "wavenumber", "sites")]
    values = [(name, member[name].item()) for name in names]
    return tuple(value if isinstance(value, str) else f"{name} {value:g}" for name, value in values)
