"""Parameters of a case from measured records: the result is ``identified.h5``, with ``identified.toml`` for ``run``.

The parameters minimise the squares of (model - measured)/noise over all samples; ``vipetsc.identification`` has the
method. A fit has for each parameter a coordinate z, for most its logarithm, and further ones for initial states that
are estimated. Fits begin at several starts, since the misfit may have several valleys. About the best fit each
parameter is held at a row of values while all others are fitted: the cost over these values is its profile.

Ranks divide the starts, then the fits of the profiles; with more ranks than starts, the ranks of a team divide the
records and derivatives of a start. The solution of each window is recorded at once, so that an identification that was
stopped goes on where it was. The files are the same, to the bit, on any number of ranks.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

from mpi4py import MPI

import numpy as np
import xarray as xr
from scipy.stats import qmc

from vipetsc.case import CaseError
from vipetsc.case.identify import IdentifyCase, Measured, MeasuredError, read_measured
from vipetsc.case.section import Problem
from vipetsc.identification.growing_windows import GrowingWindows
from vipetsc.identification.misfit import Misfit
from vipetsc.identification.misfit_profile import SIDES, MisfitProfile, ProfileCosts, Side, profile_about, profile_costs
from vipetsc.identification.motion import MotionError
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import provenance
from vipetsc.io.kinds import IDENTIFIED
from vipetsc.io.netcdf import open_netcdf, tabulated
from vipetsc.io.records import Record
from vipetsc.parallel import StopRequest, StudyError, divided, on_root
from vipetsc.studies.identified import LAYOUT, identified_values, summary_of, warnings_of
from vipetsc.studies.recorded_runs import FAILURES, Key, RecordedRuns
from vipetsc.studies.study import How, Study, StudyWork


def run_identification(
    plan: IdentifyCase, folder: str | Path, comm: MPI.Comm = MPI.COMM_WORLD, **how: Unpack[How]
) -> xr.Dataset:
    """Fit the parameters of ``plan`` to its records in ``folder``; returns the content of ``identified.h5``.

    The attribute ``summary`` is a table of the results. ``how`` it is computed, and what it raises, is in
    ``Study.run``; moreover CaseError if a record has changed, StudyError if no start leads to a fit.
    """
    IdentifyCase.expect(plan, "run_identification")
    return STUDY.run(plan, folder, comm, **how)


def read_measured_records(plan: IdentifyCase) -> list[Measured]:
    """Return measured records of ``plan``; raises CaseError for one that is not as it was when the case was read."""
    records = []
    for number, table in enumerate(plan.options.records, 1):
        at = f"identify.records[{number}]"
        try:
            record = read_measured(table)
        except MeasuredError as error:
            raise CaseError([Problem(f"{at}.{error.key}", error.value, error.remedy)], plan.name) from None
        if record.sha256 != table.sha256:
            raise CaseError([Problem(f"{at}.sha256", table.sha256, "the file has changed; remove this key")], plan.name)
        records.append(record)
    return records


class Identification:
    """Fits of one ``plan`` to its ``measured`` records, each by all ranks of ``team``; ``stop`` ends them."""

    def __init__(
        self, plan: IdentifyCase, measured: list[Measured], stop: StopRequest, team: MPI.Comm = MPI.COMM_SELF
    ) -> None:
        self.plan = plan
        self.measured = measured
        self.stop = stop
        self.team = team

    def windows(self) -> GrowingWindows:
        """Return a fit that begins anew: no window is solved, and solutions are not recorded."""
        return self._windows((), lambda number, z: None)

    def _windows(self, solved: Sequence[Sequence[float]], keep: Callable[[int, np.ndarray], None]) -> GrowingWindows:
        """Return a fit whose first windows are ``solved``; what the others solve is given to ``keep``."""
        return GrowingWindows(
            Misfit(self.plan, self.measured, compute=lambda jobs: divided(self.team, jobs)),
            check=lambda: self.stop.check(self.team),
            solved=solved,
            keep=keep,
        )

    def starts(self) -> np.ndarray:
        """Return the coordinates (start, coordinate) at which fits begin: those of the case, then a Latin hypercube.

        Initial states that are estimated begin at rest.
        """
        parameters = self.plan.parameters
        first = np.array([parameter.to_coordinate(parameter.start) for parameter in parameters])
        begins = first[None]
        count = self.plan.options.starts - 1
        if count:
            bounds = np.array([(p.to_coordinate(p.low), p.to_coordinate(p.high)) for p in parameters]).T
            # Over coordinates, which are logarithms of most parameters: bounds may be decades apart.
            drawn = qmc.LatinHypercube(len(parameters), seed=self.plan.options.seed).random(count)
            begins = np.vstack([first, qmc.scale(drawn, *bounds)])
        states = self.windows().misfit.size - len(parameters)
        return np.pad(begins, ((0, 0), (0, states)))

    def fit(
        self,
        number: int,
        solved: Sequence[Sequence[float]] = (),
        keep: Callable[[int, np.ndarray], None] = lambda number, z: None,
    ) -> Record:
        """Return the record of the fit from the start of that ``number``; ``solved`` and ``keep`` as of GrowingWindows.

        Coordinates are (coordinate,), those of parameters before those of initial states.
        """
        start = self.starts()[number]
        windows = self._windows(solved, keep)
        fit = windows.fit(start)

        return {
            "begin": start.tolist(),
            "coordinates": fit.coordinates.tolist(),
            "deviance": fit.deviance,
            "misfit": fit.misfit,
            "noise": [noise.tolist() for noise in fit.noise],
            "windows": [
                {
                    "end": window.end,
                    "impacts": window.impacts,
                    "misfit": window.misfit,
                    "coordinates": window.coordinates.tolist(),
                }
                for window in fit.windows
            ],
        }

    def solution(self, record: Record) -> tuple[GrowingWindows, np.ndarray]:
        """Return the fit of a ``record``, with the noise that it found, and its coordinates (coordinate,)."""
        windows = self.windows()
        windows.misfit.noise = [np.array(noise) for noise in record["noise"]]
        return windows, np.array(record["coordinates"])

    def profile(self, record: Record) -> MisfitProfile:
        """Return the values at which each parameter is held about the fit of a ``record``."""
        windows, z = self.solution(record)
        return profile_about(windows, z, self.plan.options.profile)

    def profile_record(self, record: Record, profile: MisfitProfile, number: int, side: Side) -> Record:
        """Return record of the ``costs`` with parameter ``number`` held on one ``side`` of the fit of a ``record``."""
        windows, z = self.solution(record)
        return {"costs": profile_costs(windows, z, profile, number, side)}


def _make(plan: IdentifyCase, work: StudyWork) -> Callable[[], xr.Dataset]:
    """Fit from all starts, and profile the best fit; returns the function that gives the results, for rank 0."""
    comm = work.comm
    measured = on_root(comm, lambda: read_measured_records(plan))
    fitting = Identification(plan, measured, work.stop)
    starts = [f"start {number}" for number in range(plan.options.starts)]
    fits = _fits(fitting, starts, work)
    fitted = [number for number, record in enumerate(fits) if "deviance" in record]
    if not fitted:
        raise StudyError(f"no start leads to a fit: {fits[0]['reason']}")
    # The number decides between equal fits, so that every rank takes the same one.
    best = min(fitted, key=lambda number: (fits[number]["deviance"], number))
    recorded = _recorded_runs(fitting, work, ranks=1)
    profile = on_root(comm, lambda: fitting.profile(fits[best]))

    def take_profile(key: Key) -> Record:
        _, number, name = str(key).split()
        side: Side = "above"
        if name == "below":
            side = "below"
        return fitting.profile_record(fits[best], profile, int(number), side)

    keys = [f"profile {number} {side}" for number in range(len(plan.parameters)) for side in SIDES]
    recorded.make(keys, take_profile, what="profiles", progress=work.progress, allow_failures=True)
    costs = _profile_costs(recorded.records, profile, np.array(fits[best]["coordinates"]))
    recorded.finish()
    return lambda: _results(fitting, fits, best, costs, work)


def _profile_costs(records: Mapping[Key, Record], profile: MisfitProfile, z: np.ndarray) -> ProfileCosts:
    """Return the costs of a ``profile`` about the fit ``z`` (coordinate,), from the ``records`` of its sides."""
    costs = np.full(profile.places.shape, np.nan)
    for number in range(len(costs)):
        for side in SIDES:
            places = profile.outwards(number, float(z[number]), side)
            costs[number, places] = records[f"profile {number} {side}"].get("costs", np.nan)
    return ProfileCosts(places=profile.places, costs=costs)


def _recorded_runs(fitting: Identification, work: StudyWork, ranks: int) -> RecordedRuns:
    """Return the records of fits by teams of so many ``ranks``."""
    failures = (*FAILURES, CaseError, MotionError)
    return RecordedRuns("identified-runs", work.folder, work.comm, fitting.stop, ranks=ranks, failures=failures).read()


def _fits(fitting: Identification, starts: list[str], work: StudyWork) -> list[Record]:
    """Return the records of the fits from all ``starts``, which the ranks divide."""
    recorded = _recorded_runs(fitting, work, ranks=max(work.comm.size // len(starts), 1))
    by_team = Identification(fitting.plan, fitting.measured, fitting.stop, recorded.team)

    def fit(key: Key) -> Record:
        solved: list[list[float]] = []
        # Windows are recorded one by one: the first that is missing is where an earlier call was stopped.
        while (part := f"{key} window {len(solved)}") in recorded.records:
            solved.append(recorded.records[part]["coordinates"])

        def keep(number: int, z: np.ndarray) -> None:
            recorded.keep_part(f"{key} window {number}", {"coordinates": z.tolist()})

        return by_team.fit(int(str(key).split()[-1]), solved, keep)

    recorded.make(starts, fit, what="starts", progress=work.progress, allow_failures=True)
    recorded.finish()
    return [recorded.records[key] for key in starts]


def _results(
    fitting: Identification, fits: list[Record], best: int, profile: ProfileCosts, work: StudyWork
) -> xr.Dataset:
    """Return the content of ``identified.h5``; writes the case that was fitted, ``identified.toml``.

    ``best`` is the number of the best one of the ``fits``.
    """
    plan = fitting.plan
    windows, z = fitting.solution(fits[best])
    case = plan.case_of(windows.misfit.values(z), name=f"{plan.name}-identified")
    write_text(work.folder / "identified.toml", case.to_toml())

    values = identified_values(windows, z, fits, best, profile)
    about: dict[str, Any] = provenance(work.comm) | {"case": plan.to_toml()}
    data = xr.Dataset(tabulated(LAYOUT, values), attrs=about)
    data = data.assign_attrs(warnings=warnings_of(data))
    return data.assign_attrs(summary=summary_of(data))


def read_identified(folder: str | Path) -> xr.Dataset:
    """Return the content of ``identified.h5`` in ``folder``; raises OSError or ValueError if it is none."""
    with open_netcdf(Path(folder) / "identified.h5", "identification", ("value", "summary")) as data:
        return data.load()


STUDY = Study(IDENTIFIED, "identified.h5", make=_make, read=read_identified)
