"""Sources of the pictures of sweeps: ensembles, members with their fields, and the names of both."""

import re
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial, wraps
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar, cast

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from vipetsc.case import Case, Model, Sweep
from vipetsc.case.amplitude import drive_unit
from vipetsc.figures.page import Page
from vipetsc.figures.panels import recorded_sites
from vipetsc.figures.style import Drawing, Shown
from vipetsc.figures.swept_axes import SweptAxis, in_pi
from vipetsc.io.netcdf import naming_spoilt, open_netcdf
from vipetsc.io.read import axes, curves, field_time, open_run, over_samples, whole_members
from vipetsc.lattice import waves_at
from vipetsc.wording import counted

AMPLITUDE = "amplitude"
SITES = "contacts.sites"
# Keys whose values are in the names of every case (`Labels`).
NAMED = {"contacts.law", "lattice.reading", SITES, "drive.cycles", "drive.amplitude"}
LEVELS = ("Low", "Medium", "High")
T = TypeVar("T")


class Files(ExitStack):
    """Results, each opened once, when it is asked for, until the block ends; xarray keeps few of the files open."""

    def __init__(self) -> None:
        super().__init__()
        self._opened: dict[Path, Any] = {}

    def get(self, path: Path, opener: Callable[[Path], AbstractContextManager[T]]) -> T:
        """Return what ``opener`` gives for ``path``, now or in an earlier call; raise as ``opener``."""
        if path not in self._opened:
            self._opened[path] = self.enter_context(opener(path))
        return cast(T, self._opened[path])

    def naming_spoilt(self) -> AbstractContextManager[None]:
        """Name results that are not finite, or empty, where an error in the block may come from them."""
        return naming_spoilt(lambda: [data for opened in self._opened.values() for data in datasets_of(opened)])


def datasets_of(opened: Any) -> list[xr.Dataset]:
    """Return the datasets of what a file was ``opened`` as: a dataset, or a member with its run and its analysis."""
    if isinstance(opened, MemberRun):
        return [opened.run, opened.analysis]
    return [opened]


class Sweeps(list[xr.Dataset]):
    """Finished sweeps, each an ensemble of `vipetsc.io.read.open_ensemble`; ``files`` are those of their members.

    Of a sweep over samples of disorder the measures are means over the samples, and the runs those of the first sample.
    """

    def __init__(self, ensembles: Iterable[xr.Dataset], files: Files) -> None:
        super().__init__(map(over_samples, ensembles))
        self.files = files


class MemberRun(NamedTuple):
    """A member of a sweep with its fields: its ``case``, resolved to a ``model`` (which counts from 0), and its files.

    ``varied`` is a text with the keys that the sweep varies and their values, without the keys ``NAMED``.
    """

    folder: Path
    case: Case
    model: Model
    run: xr.Dataset
    analysis: xr.Dataset
    varied: str = ""

    @property
    def labels(self) -> "Labels":
        """The names of the member on pages and in their files' names."""
        return Labels.of(self.case, self.varied)

    def shown(self, name: str = "") -> Shown:
        """Return run and its analysis, from which pictures of the member are drawn, under a ``name`` on the page."""
        return Shown(name or self.labels.member, [self.run, self.analysis])

    @classmethod
    @contextmanager
    def open(cls, folder: Path) -> Iterator[Self]:
        """Yield the member in ``folder``, its files open for the time of the block; raise OSError or ValueError."""
        with open_run(folder / "run.h5") as run, open_netcdf(folder / "analysis.h5", "analysis") as analysis:
            case = Case.of(run)
            yield cls(folder=folder, case=case, model=case.model(), run=run, analysis=analysis)


def transfer_members(sweeps: Sweeps) -> Iterator[MemberRun]:
    """Yield the whole members with sites and a band above the driven one."""
    for ensemble in sweeps:
        for row, folder in whole_members(ensemble):
            member = sweeps.files.get(folder, MemberRun.open)._replace(varied=varied_at(row["number"].item(), ensemble))
            # Without a band above the driven one the transfer is NaN, which is not >= 0.
            if member.analysis.get("ibtet", -1) >= 0 and member.run.sizes["site"]:
                yield member


def varied_at(number: int, ensemble: xr.Dataset) -> str:
    """Return the keys that vary in an ``ensemble`` and are not ``NAMED``, with their values in member ``number``."""
    texts = []
    for axis in SweptAxis.all_of(ensemble):
        # Names have the number of the sites: lists of their cells are told apart by the key.
        keys = [key for key in axis.keys if key.path not in NAMED or (key.values.dtype == object and key.path == SITES)]
        texts += [key.texts[_place(number, ensemble)[axis.dimension]] for key in keys]
    return ", ".join(texts)


def _place(number: int, ensemble: xr.Dataset) -> dict[str, int]:
    """Return the index of member ``number`` along every dimension of its ``ensemble``."""
    numbers = ensemble["number"]
    index = np.argwhere(numbers.values == number)[0]
    return {str(dimension): int(i) for dimension, i in zip(numbers.dims, index, strict=True)}


class DrivenWave(NamedTuple):
    """The linear wave at the drive's frequency: its ``band`` (1-based), wavenumber (rad/cell) and speed (cells/s).

    In a gap, which has no wave, the band is 0 and the others are NaN.
    """

    band: int
    wavenumber: float
    speed: float

    @classmethod
    def of(cls, case: Case) -> Self:
        """Return the wave that ``case`` drives."""
        model = case.model()
        waves = waves_at(model.chain.cell, model.drive.frequency)
        if not waves:
            return cls(band=0, wavenumber=np.nan, speed=np.nan)
        band, wavenumber, speed = waves[0]
        return cls(band=band, wavenumber=wavenumber, speed=speed)


class AmplitudeSeries(NamedTuple):
    """One configuration of a sweep at a low, a medium and a high amplitude, in ``runs``.

    ``suffix`` is its part of file names, ``title`` the heading of its pages, ``wave`` the linear wave at the drive's
    frequency.
    """

    suffix: str
    title: str
    runs: tuple[MemberRun, ...]
    wave: DrivenWave

    @property
    def medium(self) -> MemberRun:
        """The run at the medium amplitude."""
        return self.runs[1]

    @property
    def headings(self) -> list[str]:
        """The texts above each amplitude's panels."""
        drives = zip(LEVELS, (run.case.drive for run in self.runs), strict=True)
        return [f"{level} amplitude, {drive.amplitude:g} {drive_unit(drive)}" for level, drive in drives]

    def page(self, rows: int, height: float, **shared: Any) -> Page:
        """Return a page with a column of panels for each amplitude, headed."""
        page = Page.of(rows, len(self.runs), height=height, heading=self.title, **shared)
        for panel, heading in zip(page.grid[0], self.headings, strict=True):
            panel.set_title(heading)
        return page

    def snapshot_times(self) -> np.ndarray:
        """Return times (4,) in s of the linear wave: midway to the first site, at it, past the last one, near the end.

        The middle of the packet leaves the driven cell when half the burst is over.
        """
        member = self.runs[0]
        chain = member.model.chain
        sites = recorded_sites(member.run)
        delay = chain.topology.distance(sites - 1, member.model.drive_cell) / self.wave.speed
        first = delay.min()
        last = delay.max()
        burst = member.model.drive.duration
        end = field_time(member.run)[-1]
        times = np.array([0.5 * burst + 0.5 * first, 0.5 * burst + first, burst + last, 0.95 * end])
        return np.minimum(times, end)


def from_series(
    *needs: str, needs_wave: bool = False, needs_sites: bool = False, medium_alone: bool = False
) -> Callable[..., Any]:
    """Return a decorator of a function that draws an `AmplitudeSeries`: the result offers a picture for each series.

    A series has no picture, which is no error, if its analyses lack a variable of ``needs``; if the picture
    ``needs_wave`` and the series drives no pass band; or if it ``needs_sites`` and the series has not recorded contact
    sites and other cells. A picture of the medium amplitude alone (``medium_alone``) has no warnings of the others.
    """

    def decorate(page: Callable[[AmplitudeSeries], Figure]) -> Callable[[Sweeps], Iterator[Drawing]]:
        @wraps(page)
        def offer(sweeps: Sweeps) -> Iterator[Drawing]:
            for series in series_of(sweeps, *needs):
                run = series.runs[0].run
                has_wave = series.wave.band > 0
                has_sites = len(recorded_sites(run)) > 0 and run.sizes["cell"] > 1
                if (has_wave or not needs_wave) and (has_sites or not needs_sites):
                    runs = [series.medium] if medium_alone else series.runs
                    shown = [run.shown(run.labels.amplitude) for run in runs]
                    yield Drawing(series.suffix, partial(page, series), shown)

        return offer

    return decorate


class _MemberFolder(NamedTuple):
    """A member of an ensemble as its row, and the folder of its files."""

    row: xr.Dataset
    folder: Path


def series_of(sweeps: Sweeps, *needs: str) -> Iterator[AmplitudeSeries]:
    """Yield every configuration of the sweeps that has fields at three amplitudes: the lowest, a middle, the highest.

    ``needs`` are variables that the analyses of all three must have.
    """
    measured = [(ensemble, _triples(ensemble)) for ensemble in sweeps]
    several_sweeps = sum(bool(triples) for _, triples in measured) > 1
    for ensemble, triples in measured:
        for triple in triples:
            runs = tuple(sweeps.files.get(member.folder, MemberRun.open) for member in triple)
            if all("velocity" in run.run and all(name in run.analysis for name in needs) for run in runs):
                wave = DrivenWave.of(runs[0].case)
                yield AmplitudeSeries(
                    suffix=suffix(triple[0].row, ensemble, named=several_sweeps),
                    title=_series_title(triple[0].row, ensemble, runs[0].case, wave),
                    runs=runs,
                    wave=wave,
                )


def _series_title(member: xr.Dataset, ensemble: xr.Dataset, case: Case, wave: DrivenWave) -> str:
    """Return the reading, whatever else varies, the number of sites and the driven wavenumber of a series."""
    parts = []
    if case.lattice.preset:
        parts.append(f"{case.lattice.reading.capitalize()} reading")
    for axis in SweptAxis.all_of(ensemble):
        if axis.dimension not in (AMPLITUDE, "reading", "wavenumber", "sites"):
            parts.append(axis.texts[_place(member["number"].item(), ensemble)[axis.dimension]])
    parts.append(counted(len(sites_of(case)), "site"))
    if wave.band:
        parts.append(f"κ* = {in_pi(wave.wavenumber)}")
    return ", ".join(parts)


def _triples(ensemble: xr.Dataset) -> list[list[_MemberFolder]]:
    """Return the members at the lowest, a middle and the highest amplitude of every configuration that has three.

    Members without a drive are left out, since figures show what is divided by the amplitude.
    """
    if AMPLITUDE not in axes(ensemble):
        return []
    others = [name for name in axes(ensemble) if name != AMPLITUDE]

    def configuration(member: _MemberFolder) -> str:
        return repr([member.row[name].item() for name in others])

    members = [_MemberFolder(row, folder) for row, folder in whole_members(ensemble) if row[AMPLITUDE].item() != 0]
    triples = []
    for group in grouped(members, configuration).values():
        if len(group) >= len(LEVELS):
            group.sort(key=lambda member: member.row[AMPLITUDE].item())
            # The middle one in their order, since amplitudes may be evenly spaced on any scale, or a list.
            triples.append([group[0], group[len(group) // 2], group[-1]])
    return triples


def _in_words(member: xr.Dataset, name: str, joint: str) -> str:
    """Return the value of a swept key as text: a word alone, a number joined to the key's name by ``joint``."""
    value = member[name].item()
    if isinstance(value, str):
        return value
    return f"{name}{joint}{value:g}"


def table(ensemble: xr.Dataset) -> dict[str, Any]:
    """Return the sweep's case file as a table; one that was made in code may have no name."""
    return {"name": "sweep"} | tomllib.loads(ensemble.attrs["case"])


def grouped(items: Iterable[T], key: Callable[[T], str]) -> dict[str, list[T]]:
    """Return the ``items`` by their ``key``, in the order in which they come."""
    groups: dict[str, list[T]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def reading_of(ensemble: xr.Dataset) -> str:
    """Return the reading of all members of a sweep that does not vary it; empty for a cell that has none."""
    for _, number in curves(ensemble):
        return reading_of_case(Sweep.of(ensemble).case(number))
    return ""


def reading_of_case(case: Case) -> str:
    """Return the reading of the preset of ``case``; empty for a cell that the case gives itself."""
    if not case.lattice.preset:
        return ""
    return case.lattice.reading


def suffix(member: xr.Dataset, ensemble: xr.Dataset, named: bool, dims: Collection[str] | None = None) -> str:
    """Return the text that tells a ``member`` of an ensemble, or a row of members, from others in a file's name.

    It has the sweep's name if that is to be ``named``, the reading, the wavenumber, and whatever else but the amplitude
    has several values; of the axes only those in ``dims``, by default all.
    """
    parts = []
    if named:
        parts.append(table(ensemble)["name"])
    if "reading" not in axes(ensemble):
        parts.append(reading_of(ensemble))
    parts = [part for part in parts if part]

    for name in axes(ensemble):
        # A sweep with one reading or wavenumber may be drawn next to one with another: these are always named.
        tells = name in ("reading", "wavenumber") or ensemble.sizes[name] > 1
        if name == AMPLITUDE or not tells or (dims is not None and name not in dims):
            continue
        parts.append(_in_file_name(member, name))
    return "-".join(parts)


def _in_file_name(member: xr.Dataset, name: str) -> str:
    """Return the value of a swept key in characters that every file system takes."""
    if name == "wavenumber":
        return in_pi(member[name].item()).replace("π", "pi").replace("/", "-")
    return in_file_name(_in_words(member, name, "-"))


def sites_of(case: Case) -> list[int]:
    """Return the cells of the contact sites, from 1."""
    sites = case.contacts.sites
    assert isinstance(sites, list)  # those of a resolved case are
    return sites


class Labels(NamedTuple):
    """The names of a case on pages, and as a ``stem`` in the names of files; empty where something does not apply."""

    law: str  # Hertz
    configuration: str  # 5 sites, 30 cycles
    page: str  # Calibrated, 5 sites, 30 cycles
    page_stem: str
    member: str  # Hertz, calibrated, 5 sites, 30 cycles, 24.33 N
    member_stem: str
    amplitude: str  # 24.33 N

    @classmethod
    def of(cls, case: Case, varied: str = "") -> Self:
        """Return the names of ``case``, with further keys that are ``varied`` and their values."""
        sites = len(sites_of(case))
        reading = reading_of_case(case)
        law = ""
        if sites:
            law = case.contacts.law
        # A lattice that begins in motion may have no drive.
        amplitude = cycles = ""
        if case.drive.amplitude:
            amplitude = f"{case.drive.amplitude:.4g} {drive_unit(case.drive)}"
            if "cycles" in case.drive.record.keys:
                cycles = counted(case.drive.cycles, "cycle")
        configuration = phrase(counted(sites, "site"), cycles, varied)
        page_stem = in_file_name(phrase(reading, configuration).replace(", ", "-").replace(" ", "-"))
        return cls(
            law=law.capitalize(),
            configuration=configuration,
            page=phrase(reading.capitalize(), configuration),
            page_stem=page_stem,
            member=phrase(law.capitalize(), reading, configuration, amplitude),
            member_stem="-".join(filter(None, [law, page_stem, in_file_name(amplitude.replace(" ", ""))])),
            amplitude=amplitude,
        )


def phrase(*parts: str) -> str:
    """Return those of ``parts`` that are not empty, between commas."""
    return ", ".join(filter(None, parts))


def in_file_name(text: str) -> str:
    """Return ``text`` in characters that every file system takes."""
    return re.sub(r"[^A-Za-z0-9._-]", "-", text.replace("π", "pi"))
