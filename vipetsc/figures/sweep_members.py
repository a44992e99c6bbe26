"""What the pictures of sweeps are drawn from: ensembles, members with their fields, and how they are named."""

import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from fractions import Fraction
from functools import partial, wraps
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar, cast

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from vipetsc.case import Case, Model, Sweep
from vipetsc.figures import style
from vipetsc.figures.panels import ROMAN, recorded_sites
from vipetsc.figures.style import Drawing
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import axes, curves, field_time, open_run, over_samples, whole_members
from vipetsc.lattice import waves_at
from vipetsc.lattice.chain import cells_between

AMPLITUDE = "amplitude"
LEVELS = ("Low", "Medium", "High")
T = TypeVar("T")


class Files(ExitStack):
    """Results opened as they are asked for, each once, until the block ends; xarray keeps few of the files open."""

    def __init__(self) -> None:
        super().__init__()
        self._opened: dict[Path, Any] = {}

    def get(self, path: Path, opener: Callable[[Path], AbstractContextManager[T]]) -> T:
        """What ``opener`` makes of ``path``; raises as it does."""
        if path not in self._opened:
            self._opened[path] = self.enter_context(opener(path))
        return cast(T, self._opened[path])


class Sweeps(list[xr.Dataset]):
    """Finished sweeps, each an ensemble of `vipetsc.io.read.open_ensemble`; ``files`` are those of their members.

    Of a sweep over samples means stand for what was measured of each, and the first sample for their runs.
    """

    def __init__(self, ensembles: Iterable[xr.Dataset], files: Files) -> None:
        super().__init__(map(over_samples, ensembles))
        self.files = files


class MeasuredRun(NamedTuple):
    """A member of a sweep with its fields: its case, in the lattice's own terms (0-based) too, and its files."""

    folder: Path
    case: Case
    model: Model
    run: xr.Dataset
    analysis: xr.Dataset

    @classmethod
    @contextmanager
    def open(cls, folder: Path) -> Iterator[Self]:
        """The member in ``folder``, its files open for the time of the block; raises OSError or ValueError."""
        with open_run(folder / "run.h5") as run, open_netcdf(folder / "analysis.h5", "analysis") as analysis:
            case = Case.of(run)
            yield cls(folder, case, case.model(), run, analysis)


def transfer_members(sweeps: Sweeps) -> Iterator[MeasuredRun]:
    """The whole members with sites and a band above the driven one."""
    for ensemble in sweeps:
        for _, folder in whole_members(ensemble):
            member = sweeps.files.get(folder, MeasuredRun.open)
            # The transfer of a lattice without a higher band is not a number.
            if member.analysis.get("ibtet", -1) >= 0 and member.run.sizes["site"]:
                yield member


class Wave(NamedTuple):
    """The linear wave at the drive's frequency: its ``band`` (1-based), wavenumber (rad/cell) and speed (cells/s)."""

    band: int
    wavenumber: float
    speed: float

    @classmethod
    def of(cls, case: Case) -> Self:
        """The wave that ``case`` drives, its wavenumber NaN in a gap."""
        model = case.model()
        waves = waves_at(model.chain.cell, model.drive.frequency)
        return cls(waves[0][0], float(waves[0][1]), abs(float(waves[0][2]))) if waves else cls(0, np.nan, np.nan)


class AmplitudeSeries(NamedTuple):
    """One configuration at a low, a medium and a high amplitude; ``wave`` is the linear one at the drive's frequency.

    ``suffix`` tells it from others of the sweeps; its ``title`` has reading, sites, wavenumber and what else varies.
    """

    suffix: str
    title: str
    runs: tuple[MeasuredRun, ...]
    wave: Wave

    @property
    def headings(self) -> list[str]:
        """What stands above each amplitude's panels."""
        return [
            f"{level} amplitude, {run.case.drive.amplitude:g} N" for level, run in zip(LEVELS, self.runs, strict=True)
        ]

    def page(self, rows: int, height: float, **shared: Any) -> tuple[Figure, np.ndarray]:
        """A figure with a column of panels (row, column) for each amplitude, lettered and headed."""
        figure = style.new_figure(style.PAGE, height, self.title)
        grid = figure.subplots(rows, len(self.runs), squeeze=False, **shared)
        for (row, column), panel in np.ndenumerate(grid):
            tag = "abc"[column] + f".{ROMAN[row]}" * (rows > 1)
            panel.set_title(f"({tag})" if row else f"({tag}) {self.headings[column]}")
        return figure, grid

    def snapshot_times(self) -> np.ndarray:
        """Four times in s, from the linear wave: half way to the first site, at it, past the last, near the end.

        The packet's middle leaves the driven cell when half the burst is over.
        """
        member = self.runs[0]
        sites, chain = recorded_sites(member.run), member.model.chain
        delay = cells_between(sites - 1, member.model.drive_cell, chain.cells, chain.ends) / self.wave.speed
        burst, end = member.model.drive.duration, field_time(member.run)[-1]
        near, far = delay.min(), delay.max()
        return np.minimum(np.array([0.5 * burst + 0.5 * near, 0.5 * burst + near, burst + far, 0.95 * end]), end)


def from_series(*needs: str, wave: bool = False, sites: bool = False) -> Callable[..., Any]:
    """Decorator of a figure of an `AmplitudeSeries`: offers one picture a series whose analyses hold ``needs``.

    Of those only series that drive a ``wave`` of a pass band, or that recorded contact ``sites`` and cells beside them.
    """

    def decorate(page: Callable[[AmplitudeSeries], Figure]) -> Callable[[Sweeps], Iterator[Drawing]]:
        @wraps(page)
        def offer(sweeps: Sweeps) -> Iterator[Drawing]:
            for series in series_of(sweeps, *needs):
                run = series.runs[0].run
                has_sites = len(recorded_sites(run)) > 0 and run.sizes["cell"] > 1
                if (series.wave.band or not wave) and (has_sites or not sites):
                    yield Drawing(series.suffix, partial(page, series))

        return offer

    return decorate


def series_of(sweeps: Sweeps, *needs: str) -> Iterator[AmplitudeSeries]:
    """Every configuration of the sweeps with full fields at its lowest, middle and highest amplitude.

    ``needs`` names what their analyses must hold.
    """
    measured = [(ensemble, triples) for ensemble in sweeps if (triples := _triples(ensemble))]
    for ensemble, triple in ((ensemble, triple) for ensemble, triples in measured for triple in triples):
        runs = tuple(sweeps.files.get(folder, MeasuredRun.open) for _, folder in triple)
        if all("velocity" in r.run and all(name in r.analysis for name in needs) for r in runs):
            first, case = triple[0][0], runs[0].case
            wave = Wave.of(case)
            others = [name for name in axes(ensemble) if name not in (AMPLITUDE, "reading", "wavenumber", "sites")]
            title = [f"{case.lattice.reading.capitalize()} reading", *(_in_words(first, n, " ") for n in others)]
            title += [counted(len(sites_of(case)), "site")]
            title += [f"κ* = {in_pi(wave.wavenumber)}"] if wave.band else []
            yield AmplitudeSeries(suffix(first, ensemble, len(measured) > 1), ", ".join(title), runs, wave)


def _triples(ensemble: xr.Dataset) -> list[list[tuple[xr.Dataset, Path]]]:
    """Members and folders at the lowest, middle and highest amplitude of every configuration that has three."""
    if AMPLITUDE not in axes(ensemble):
        return []
    others = [name for name in axes(ensemble) if name != AMPLITUDE]
    rows = grouped(whole_members(ensemble), lambda pair: repr([pair[0][name].item() for name in others]))
    ordered = [sorted(row, key=lambda pair: pair[0][AMPLITUDE].item()) for row in rows.values()]
    return [[row[0], row[len(row) // 2], row[-1]] for row in ordered if len(row) >= len(LEVELS)]


def _in_words(member: xr.Dataset, name: str, joint: str) -> str:
    """The value of a swept key; a number after the key's name."""
    value = member[name].item()
    return value if isinstance(value, str) else f"{name}{joint}{value:g}"


def table(ensemble: xr.Dataset) -> dict[str, Any]:
    """The sweep's case file."""
    return tomllib.loads(ensemble.attrs["case"])


def grouped(items: Iterable[T], key: Callable[[T], str]) -> dict[str, list[T]]:
    """The ``items`` by their ``key``, in the order in which they come."""
    groups: dict[str, list[T]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def reading_of(ensemble: xr.Dataset) -> str:
    """The reading that all members of a sweep share which does not vary it."""
    return next((Sweep.of(ensemble).case(number).lattice.reading for _, number in curves(ensemble)), "")


def suffix(member: xr.Dataset, ensemble: xr.Dataset, named: bool, dims: Collection[str] | None = None) -> str:
    """What tells ``member`` (or a row of them) from others of the ensemble in a file's name; the amplitude aside.

    The sweep's name if it is to be ``named``, the reading, and whatever else has several values; of the axes only
    ``dims``, by default all.
    """
    parts = [table(ensemble)["name"]] if named else []
    parts += [] if "reading" in axes(ensemble) else [reading_of(ensemble)]
    for name in axes(ensemble):
        tells = name in ("reading", "wavenumber") or ensemble.sizes[name] > 1
        if name != AMPLITUDE and tells and (dims is None or name in dims):
            wave = name == "wavenumber"
            text = in_pi(member[name].item()).replace("π", "pi") if wave else _in_words(member, name, "-")
            parts.append("".join(c if c.isalnum() or c in "-." else "-" for c in text))
    return "-".join(parts)


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


def sites_of(case: Case) -> list[int]:
    """Cells of the contact sites, from 1."""
    sites = case.contacts.sites
    assert isinstance(sites, list)  # those of a resolved case are
    return sites


class Labels(NamedTuple):
    """How a case is named on pages and, as a ``stem``, in their files' names."""

    law: str  # Hertz
    configuration: str  # 5 sites, 30 cycles
    page: str  # Calibrated, 5 sites, 30 cycles
    page_stem: str
    member: str  # Hertz, calibrated, 5 sites, 30 cycles, 24.33 N
    member_stem: str

    @classmethod
    def of(cls, case: Case) -> Self:
        """The names of ``case``."""
        law, reading, amplitude = case.contacts.law, case.lattice.reading, f"{case.drive.amplitude:.4g}"
        configuration = f"{counted(len(sites_of(case)), 'site')}, {case.drive.cycles:g} cycles"
        stem = f"{reading}-{configuration}".replace(",", "").replace(" ", "-")
        member = f"{law.capitalize()}, {reading}, {configuration}, {amplitude} N"
        page = f"{reading.capitalize()}, {configuration}"
        return cls(law.capitalize(), configuration, page, stem, member, f"{law}-{stem}-{amplitude}N")
