"""The registry of measures: numbers that a run leaves, each with its name, its unit and what gives it.

``run``, ``sweep``, ``optimise`` and ``export`` all take them from here. A measure of a point or of a pair of points
has a value for each of these, under a name of its own: ``peak_velocity/tip``, ``transmission/base-tip``.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np

from vipetsc.plugins import call, number_of, only, registered
from vipetsc.register import MEASURE, PARTS, MeasurePart, reserve
from vipetsc.spectra import histories
from vipetsc.spectra.histories import History, SteadyAmplitude, SteadyDrive

if TYPE_CHECKING:
    import xarray as xr

# Defaults of the steady amplitude: periods of the drive in a window, and the largest drift between windows over
# the amplitude: 1 %, to which accelerometers are calibrated.
PERIODS = 10
TOLERANCE = 0.01
MOTIONS = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s2"}
PART = "part"  # the dimension of parts of the frequency axis: pass bands, gaps, what is above
JOINT = "-"  # between the names of a pair

Group = Literal["statistics", "entropy", "transfer", "motion"]
Over = Literal["run", "point", "pair"]


@dataclass(frozen=True)
class RunRecord:
    """A run as measures see it.

    ``run`` is the dataset of ``run.h5``, ``points`` are the histories of its named points, ``pairs`` the pairs of them
    between which transmission is measured, ``drive`` is the steady part of its first drive, if that has one. ``edges``
    (part + 1) in rad/s and ``parts`` are those of the frequency axis. A steady amplitude needs windows of so many
    ``periods`` and a drift within the ``tolerance``. Measures add sentences to ``warnings``.
    """

    run: xr.Dataset
    points: Mapping[str, History]
    pairs: Sequence[Sequence[str]]
    edges: np.ndarray
    parts: tuple[str, ...]
    drive: SteadyDrive | None = None
    periods: int = PERIODS
    tolerance: float = TOLERANCE
    warnings: list[str] = field(default_factory=list)
    _steady: dict[str, dict[str, SteadyAmplitude]] = field(default_factory=dict)

    def steady(self, point: str) -> dict[str, SteadyAmplitude] | None:
        """Return steady amplitude of each quantity at a ``point``; None where the first drive is no lasting sine."""
        if self.drive is None:
            return None
        if point not in self._steady:
            history = self.points[point]
            amplitudes = {}
            for quantity in MOTIONS:
                values = getattr(history, quantity)
                amplitudes[quantity] = histories.steady_amplitude(history.time, values, self.drive, self.periods)
            self._steady[point] = amplitudes
        return self._steady[point]

    def drift(self, point: str) -> float | None:
        """Return the largest drift of the steady amplitudes at a ``point``."""
        steady = self.steady(point)
        if steady is None:
            return None
        return float(np.max([amplitude.drift for amplitude in steady.values()]))

    def settled(self, point: str, quantity: str) -> float | None:
        """Return the steady amplitude of a ``quantity`` at a ``point``, NaN and a warning where it has not settled."""
        steady = self.steady(point)
        drift = self.drift(point)
        if steady is None or drift is None:
            return None
        if drift <= self.tolerance:
            return steady[quantity].amplitude

        sentence = self._unsettled(point, drift)
        if sentence not in self.warnings:
            self.warnings.append(sentence)
        return np.nan

    def _unsettled(self, point: str, drift: float) -> str:
        """Return the sentence about a ``point`` whose amplitude is not steady."""
        about = f"steady amplitude at {point}: three windows of {self.periods} periods of the drive"
        if not np.isnan(drift):
            return (
                f"{about} differ by {drift:.2g} of it, more than {self.tolerance:g}; a later time.end, or more damping"
            )
        return f"{about} do not lie in its steady part, or samples do not resolve it; a later time.end"


class RunMeasure(NamedTuple):
    """A number that a run leaves, or one for each of its points or pairs of points (``over``).

    ``of(record)``, ``of(record, point)`` or ``of(record, source, receiver)`` gives it, in ``unit``, from a
    ``RunRecord``: None where the run cannot have it, as a steady amplitude without a steady drive, NaN where it could
    have it but has no value. A measure without ``of`` is a variable of its name in the run's analysis or statistics.
    ``dimension``: "" for a number, ``PART`` for one of each part of the frequency axis, "snapshot". As long as nothing
    touches, the measure is proportional to the drive's amplitude to the ``power``: sweeps scale a linear run. If any
    has no ``power``, they simulate every member. ``group``: the measures that are computed together.
    """

    name: str
    unit: str
    text: str
    of: Callable[..., Any] | None = None
    over: Over = "run"
    dimension: str = ""
    power: float | None = None
    group: Group = "motion"

    @property
    def row(self) -> tuple[str, str, str]:
        """Dimension, unit and text, as tables of variables have them."""
        return self.dimension, self.unit, self.text

    def at(self, *points: str) -> RunMeasure:
        """Return the measure of these ``points``: named after them, it has a function of the record alone.

        A measure of a run is returned as it is.
        """
        if self.over == "run":
            return self
        if self.over == "point":
            place = f"at {points[0]}"
        else:
            place = f"of {points[1]} over that of {points[0]}"
        of = self.of
        assert of is not None
        return self._replace(
            name=f"{self.name}/{JOINT.join(points)}",
            text=f"{self.text} {place}",
            of=lambda record: of(record, *points),
            over="run",
        )


def every_measure() -> dict[str, RunMeasure]:
    """Return the shipped measures by name, and those that users' modules register.

    While a case is read, these are the modules that it names; else all that are imported.
    """
    measures = dict(MEASURES)
    for name in registered(MEASURE):
        part = PARTS[MEASURE][name]
        assert isinstance(part, MeasurePart)
        measures[name] = RunMeasure(name, part.unit, part.text, partial(_number_of_part, part), power=part.power)
    return measures


def _number_of_part(part: MeasurePart, record: RunRecord) -> float | None:
    """Return the number that a registered measure has of a ``record``; raises PartError if it is not a real number."""
    value = call(part, part.function, record)
    if value is None:
        return None
    return number_of(part, value)


def _foreign(run: xr.Dataset) -> set[str]:
    """Return the registered measures of modules that the case of a ``run`` does not name."""
    case = tomllib.loads(run.attrs.get("case", ""))
    with only(case.get("plugins", {}).get("modules", [])):
        return {*PARTS[MEASURE]} - {*registered(MEASURE)}


def measures_of(points: Sequence[str], pairs: Sequence[Sequence[str]]) -> dict[str, RunMeasure]:
    """Return the measures, by name, of a run with these ``points`` and ``pairs`` of them."""
    expanded: dict[str, RunMeasure] = {}
    for measure in every_measure().values():
        for one in _expanded(measure, points, pairs):
            expanded[one.name] = one
    return expanded


def _expanded(measure: RunMeasure, points: Sequence[str], pairs: Sequence[Sequence[str]]) -> Iterator[RunMeasure]:
    """Yield a ``measure`` of a run; one of points or of pairs for each of them."""
    if measure.over == "run":
        yield measure
    elif measure.over == "point":
        for point in points:
            yield measure.at(point)
    else:
        for source, receiver in pairs:
            yield measure.at(source, receiver)


def row_of(name: str) -> tuple[str, str, str]:
    """Return dimension, unit and text of the measure ``name``, with points or without; raises KeyError for none."""
    measures = every_measure()
    if name in measures:
        return measures[name].row
    base, _, points = name.partition("/")
    return measures[base].at(*points.split(JOINT)).row


def is_measure(name: str) -> bool:
    """Return whether ``name`` is a measure of a run, or of points: ``peak_velocity/tip``."""
    base, _, points = name.partition("/")
    return name in every_measure() or (bool(points) and base in MEASURES and MEASURES[base].over != "run")


def _of_name(name: str) -> RunMeasure:
    """Return the measure ``name`` in the registry, where a measure of points stands without their names."""
    return every_measure().get(name) or MEASURES[name.partition("/")[0]]


def power_of(name: str) -> float:
    """Return the power of the amplitude in the measure ``name`` without contact; 0 if it is unknown."""
    return _of_name(name).power or 0.0


def can_be_scaled(modules: Sequence[str]) -> bool:
    """Return whether every measure that a sweep takes of the motion is proportional to a power of the amplitude.

    The measures are the shipped ones and those of the ``modules`` that the case names.
    """
    with only(modules):
        return all(measure.power is not None for measure in every_measure().values() if measure.group == "motion")


def group_of(name: str) -> Group:
    """Return the group of the measure ``name``."""
    return _of_name(name).group


def names_in(asked: Collection[str]) -> set[str]:
    """Return the names of measures that are ``asked`` for, with those of all measures of a group for its name."""
    names = {measure.name for measure in every_measure().values() if measure.group in asked}
    return names | {name for name in asked if name not in get_args(Group)}


def take(record: RunRecord, asked: Collection[str] | None = None) -> dict[str, Any]:
    """Return the values by name of the measures ``asked`` for, by default all, that the run of ``record`` has.

    A name without points stands for those of all points.
    """
    values = {}
    foreign = _foreign(record.run)
    for name, measure in measures_of([*record.points], record.pairs).items():
        is_asked = asked is None or name in asked or name.partition("/")[0] in asked
        if measure.of is None or not is_asked or name in foreign:
            continue
        value = measure.of(record)
        # None is a measure that the run cannot have; NaN, one that it should have, is written.
        if value is not None:
            values[name] = value
    return values


def _contact_episodes(record: RunRecord) -> int | None:
    return record.run.sizes.get("episode")


def _work(record: RunRecord) -> float | None:
    if "energy/work" not in record.run:
        return None
    return float(record.run["energy/work"][-1])


def _dissipated_fraction(record: RunRecord) -> float | None:
    work = _work(record)
    if work is None or "energy/dissipated" not in record.run:
        return None
    if work == 0:
        return np.nan
    return float(record.run["energy/dissipated"][-1]) / work


def _largest_force(record: RunRecord) -> float | None:
    if not record.run.sizes.get("site") or "impacts/force" not in record.run:
        return None
    if record.run.sizes["episode"] == 0:
        return 0.0
    return float(record.run["impacts/force"].max())


def _of_statistics(name: str) -> Callable[[RunRecord], float | None]:
    """Return the measure that the run itself has left among its statistics, under this ``name``."""

    def of(record: RunRecord) -> float | None:
        statistics = record.run.attrs.get("statistics", {})
        if isinstance(statistics, str):
            statistics = json.loads(statistics)
        return statistics.get(name)

    return of


def _velocities(record: RunRecord, source: str, receiver: str) -> tuple[np.ndarray, np.ndarray]:
    return record.points[source].velocity, record.points[receiver].velocity


def _transmission(record: RunRecord, source: str, receiver: str) -> float:
    return histories.transmission(*_velocities(record, source, receiver))


def _band_transmission(record: RunRecord, source: str, receiver: str) -> np.ndarray | None:
    time = record.points[source].time
    if len(time) < 2:
        return None
    before, after = _velocities(record, source, receiver)
    goes_on = record.drive is not None and record.drive.stop > time[-1]
    return histories.transmission_by_part(before, after, float(time[1] - time[0]), record.edges, goes_on=goes_on)


def _steady_transmission(record: RunRecord, source: str, receiver: str) -> float | None:
    of_source = record.settled(source, "velocity")
    of_receiver = record.settled(receiver, "velocity")
    if of_source is None or of_receiver is None:
        return None
    if of_source == 0:
        return np.nan
    return of_receiver / of_source


def _of_points(kind: str, quantity: str) -> RunMeasure:
    """Return the measure of a ``kind`` (peak, rms, steady) of a ``quantity`` at a point."""
    unit = MOTIONS[quantity]
    name = f"{kind}_{quantity}"
    if kind == "steady":
        text = f"steady amplitude of the {quantity}"
        return RunMeasure(
            name, unit, text, lambda record, point: record.settled(point, quantity), over="point", power=1.0
        )

    function = {"peak": histories.peak, "rms": histories.rms}[kind]
    text = {"peak": f"largest {quantity}", "rms": f"root mean square of the {quantity}"}[kind]

    def of(record: RunRecord, point: str) -> float:
        return function(getattr(record.points[point], quantity))

    return RunMeasure(name, unit, text, of, over="point", power=1.0)


IBTET_WHOLE = "inter-band energy transfer as in the paper: the mean includes the ends of the record"
UPPER_FRACTION = "energy of the bands above the driven one at the end, over the drive's work"
MEAN_FRACTION = "mean fraction of the energy in a pass band or gap after the front's arrival"
STANDARD = (
    RunMeasure("contact_episodes", "1", "contact episodes", _contact_episodes, group="statistics"),
    RunMeasure(
        "dissipated_fraction", "1", "dissipated energy over the drive's work", _dissipated_fraction, group="statistics"
    ),
    RunMeasure("work", "J", "work done by the drive", _work, power=2.0, group="statistics"),
    RunMeasure("ledger_error", "1", "largest error of the energy ledger over the work", group="statistics"),
    RunMeasure("ibtet", "1", "inter-band energy transfer", group="transfer"),
    RunMeasure("entropy/energy_weighted", "bit", "mean over time of the energy-weighted entropy", group="entropy"),
    RunMeasure(
        "entropy/masked", "bit", "mean entropy where the wave energy exceeds 1 % of its largest value", group="entropy"
    ),
    RunMeasure(
        "entropy/joint", "bit", "mean over time of the joint entropy over cells and wavenumbers", group="entropy"
    ),
    RunMeasure("ibtet_whole", "1", IBTET_WHOLE, group="transfer"),
    RunMeasure("entropy/error", "bit", "standard deviation over the cells of the masked time mean", group="entropy"),
    RunMeasure("entropy/start", "s", "time at which averages of the entropy begin", group="entropy"),
    RunMeasure("entropy/history", "bit", "entropy of a snapshot", dimension="snapshot", group="entropy"),
    RunMeasure("entropy/snapshot", "s", "time of a snapshot", dimension="snapshot", group="entropy"),
    RunMeasure("upper_share_at_end", "1", UPPER_FRACTION, group="transfer"),
    RunMeasure(
        "bands/modal_energy", "J", "energy of the linear modes in a part at the end", dimension=PART, group="transfer"
    ),
    RunMeasure("bands/share", "1", MEAN_FRACTION, dimension=PART, group="transfer"),
    RunMeasure("largest_force", "N", "largest contact force of all impacts", _largest_force, power=0.0),
    # Of a linear lattice it does not depend on the amplitude.
    RunMeasure("lyapunov", "1/s", "largest Lyapunov exponent", _of_statistics("lyapunov"), power=0.0),
    RunMeasure("lyapunov_error", "1/s", "standard error of the exponent", _of_statistics("lyapunov_error"), power=0.0),
    *(_of_points(kind, quantity) for kind in ("peak", "rms", "steady") for quantity in MOTIONS),
    RunMeasure(
        "steady_drift",
        "1",
        "drift of the steady amplitude",
        lambda record, point: record.drift(point),
        over="point",
        power=0.0,
    ),
    RunMeasure("transmission", "1", "transmission, rms velocity", _transmission, over="pair", power=0.0),
    RunMeasure(
        "steady_transmission", "1", "transmission, steady velocity", _steady_transmission, over="pair", power=0.0
    ),
    RunMeasure(
        "band_transmission",
        "1",
        "transmission in a part of the frequency axis, rms velocity",
        _band_transmission,
        over="pair",
        dimension=PART,
        power=0.0,
    ),
)
MEASURES: dict[str, RunMeasure] = {measure.name: measure for measure in STANDARD}
"""The shipped measures by name, in the order in which files hold them."""

reserve(MEASURE, MEASURES)
