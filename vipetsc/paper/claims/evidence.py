"""The evidence for the claims: the steps of the paper in one folder, and the numbers of a measurement."""

import tomllib
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, SupportsFloat

import numpy as np
import xarray as xr

from vipetsc.case import Case
from vipetsc.io.errors import is_of_file_system
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import axes, member_folder, open_ensemble, select
from vipetsc.studies.backbone import initiation_of

EXCITED = 5 * np.pi / 9  # rad/cell, driven in the paper's section II

Numbers = dict[str, SupportsFloat | None]


class MissingEvidence(Exception):
    """Missing results from which a claim is measured; the message names them."""


@dataclass
class Measurement:
    """What a claim's measurement has found: numbers by name, their uncertainties, and sentences that explain them.

    ``figure`` is the stem of the picture that shows it, if that depends on the data; otherwise the claim's is taken.
    """

    value: Numbers = field(default_factory=dict)
    uncertainty: Numbers = field(default_factory=dict)
    reasons: list[str] = field(default_factory=list)
    figure: str = ""


class AnalysedMember:
    """A member of a sweep whose fields were kept: its ``folder``, its ``case`` and its ``analysis`` (``analysis.h5``).

    ``episodes`` is the number of contact episodes, ``amplitude`` that of the drive in N.
    """

    def __init__(self, folder: Path, analysis: xr.Dataset, episodes: int) -> None:
        self.folder = folder
        self.analysis = analysis
        self.episodes = episodes
        self.case = Case.of(analysis)
        self.amplitude = self.case.drive.amplitude

    @property
    def onset(self) -> float:
        """Least amplitude in N at which a run like this one has a contact; NaN without the record of its linear run."""
        try:
            return initiation_of(self.folder.parent, self.case).onset
        except (OSError, ValueError) as error:
            if is_of_file_system(error):
                raise
        return float("nan")

    def arrays(self, *names: str) -> tuple[np.ndarray, ...]:
        """Return variables of the analysis by name, each with its shape (...) in the file."""
        return tuple(self.analysis[name].values for name in names)


class AmplitudeCurve:
    """A measure over rising ``amplitude`` (point,) in N: the ``value`` (point,), without failed members.

    ``members`` are what `Evidence.select` gives, ``name`` is the measure's. ``untouched`` (point,) is true where there
    is no contact; ``peak`` is the index of the largest value, at ``peak_amplitude``. Raises MissingEvidence if the
    measure is missing or all members failed.
    """

    def __init__(self, members: xr.Dataset, name: str) -> None:
        step = Path(members.attrs["folder"]).name
        if name not in members:
            raise MissingEvidence(f"{step} holds no {name} over the amplitude")
        valid = members.isel(amplitude=np.isfinite(members[name].values))
        if not valid.sizes["amplitude"]:
            raise MissingEvidence(f"{step}: every member of a curve of {name} failed")
        self.amplitude = valid["amplitude"].values
        self.value = valid[name].values
        self.untouched = valid["contact_episodes"].values == 0
        self.peak = int(np.argmax(self.value))
        self.peak_amplitude = float(self.amplitude[self.peak])

    def growth_ratio(self, low: float, high: float) -> float:
        """Return the ratio of the amplitudes between which the values grow on the way to the peak.

        It is that of the first point with a value >= ``high`` after the last one with a value <= ``low``; NaN if there
        are no such points.
        """
        # Up to the peak: behind it the values fall again, and may be as low as before.
        value = self.value[: self.peak + 1]
        before = np.nonzero(value <= low)[0]
        if not before.size:
            return float("nan")
        last = before[-1]
        after = np.nonzero(value[last + 1 :] >= high)[0]
        # A curve that stays on its floor is low up to the peak.
        if not after.size:
            return float("nan")
        return float(self.amplitude[last + 1 + after[0]] / self.amplitude[last])

    def interpolate(self, amplitude: float) -> float:
        """Return the value at ``amplitude`` in N, interpolated over its logarithm; NaN beyond the ends."""
        return float(np.interp(np.log(amplitude), np.log(self.amplitude), self.value, left=np.nan, right=np.nan))


class Evidence(ExitStack):
    """Access to the results of the steps in ``root``: files are opened when asked for, and closed with the context.

    ``files`` lists those asked for since the list was emptied, relative to ``root``, in order. ``unusable`` are reasons
    why steps have no results to use, by their names. Every method raises MissingEvidence for what is not there or of
    such a step, OSError or ValueError for a file that cannot be used.
    """

    def __init__(self, root: str | Path, unusable: Mapping[str, str] | None = None) -> None:
        super().__init__()
        self.root = Path(root)
        self.unusable = unusable or {}
        self.files: list[str] = []
        # Claims ask for the same files again and again.
        self._open_ensemble = cache(open_ensemble)
        self._open = cache(lambda path, needs: self.enter_context(open_netcdf(path, "file of results", needs)))

    def path(self, *parts: str) -> Path:
        """Return a file below ``root``, noted down; raises MissingEvidence if it is missing or its step unusable."""
        name = "/".join(parts)
        step = name.split("/")[0]
        if step in self.unusable:
            raise MissingEvidence(f"{step} {self.unusable[step]}")
        if not (self.root / name).exists():
            raise MissingEvidence(f"{name} is missing")
        if name not in self.files:
            self.files.append(name)
        return self.root / name

    def open(self, *parts: str, needs: tuple[str, ...] = ()) -> xr.Dataset:
        """Open an HDF5 file below ``root`` that holds the variables and groups ``needs``."""
        return self._open(self.path(*parts), needs)

    def ensemble(self, step: str) -> xr.Dataset:
        """Return the ensemble of the finished sweep ``step``."""
        return self._open_ensemble(self.path(step, "ensemble.h5").parent)

    def select(self, step: str, reading: str, **wanted: Any) -> xr.Dataset:
        """Return members of the sweep ``step`` over rising amplitude, in one reading and at the coordinates ``wanted``.

        Of an axis that is not among these the first value is taken. Raises MissingEvidence if the sweep has no such
        members.
        """
        ensemble = self.ensemble(step)
        wanted = {"reading": reading} | wanted
        # A sweep over no reading has that of its case, by default the calibrated one.
        only = tomllib.loads(ensemble.attrs["case"]).get("lattice", {}).get("reading", "calibrated")
        swept = "reading" in ensemble.coords
        if not swept and only != reading:
            raise MissingEvidence(f"{step} has the reading {only!r} alone")

        coordinates = {key: value for key, value in wanted.items() if swept or key != "reading"}
        try:
            members = select(ensemble, **coordinates)
        except KeyError:
            values = (f"{k} = {v:.6g}" if isinstance(v, float) else f"{k} = {v}" for k, v in wanted.items())
            raise MissingEvidence(f"{step} has no members with {', '.join(values)}") from None
        if "amplitude" not in axes(members):
            raise MissingEvidence(f"{step} holds no members over the amplitude")
        return members.isel({axis: 0 for axis in axes(members) if axis != "amplitude"}).sortby("amplitude")

    def runs(self, step: str, reading: str, *needs: str, **wanted: Any) -> list[AnalysedMember]:
        """Return the members that ``select`` gives, each with its analysis, by rising amplitude.

        Raises MissingEvidence if a member failed or is missing, ValueError if an analysis lacks one of ``needs``.
        """
        members = self.select(step, reading, **wanted)[["member", "contact_episodes"]]
        runs = []
        for i in range(members.sizes["amplitude"]):
            member = members.isel(amplitude=i)
            folder = member_folder(member)
            if not (folder / "analysis.h5").exists():
                raise MissingEvidence(f"{step}: the member at {member['amplitude']:g} N failed or is missing")
            analysis = self.open(step, folder.name, "analysis.h5", needs=needs)
            runs.append(AnalysedMember(folder, analysis, int(member["contact_episodes"])))
        return runs
