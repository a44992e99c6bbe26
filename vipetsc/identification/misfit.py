"""Residuals of measured records and their Jacobian, over windows from the beginning of each record."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from vipetsc.case import CaseError, Model
from vipetsc.case.drive import first_built
from vipetsc.case.identify import IdentifyCase
from vipetsc.case.measured import Measured, SensorTable
from vipetsc.dynamics.drives import create_drives, drive_forces
from vipetsc.identification.coefficient_slopes import CoefficientSlopes, ParameterSlope, values_at
from vipetsc.identification.initial_state import WIDTH, InitialState, initial_state, state_of
from vipetsc.identification.motion import (
    MotionCoefficients,
    MotionError,
    RecordedMotion,
    fastest_of,
    no_slopes,
    respond,
    stacked_slopes,
)
from vipetsc.identification.motion_begin import MotionBegin
from vipetsc.identification.motion_rates import SHORT
from vipetsc.identification.precision import EXACT, Tolerances

# Rows of a response, by the quantity of a sensor; the derivative with respect to time is in the row after it.
ROWS = {"displacement": 0, "velocity": 1, "acceleration": 2}
# Residual of a motion that cannot be computed, in units of the noise: a step that leads there is rejected. It is at
# least so many times the size of the data, which motions that can be computed do not reach however small the noise is.
# Of the two the second is the larger one where the noise is below 1e-5 of the data.
REJECTED = 1e8
REJECTED_SIZE = 1e3
# Derivatives of a record are integrated in so many parts at most, of so many coordinates at least. The parts do not
# depend on the number of ranks that share them, and with the parts all steps and bits are the same on any number. Each
# part integrates the motion again: seven derivatives in two parts cost 1.3 times as much as in one, and a fit of twelve
# coordinates takes 3.1 s of CPU in two parts, 2.7 s in one and 4.0 s in three.
MOST_PARTS = 8
LEAST_PART = 8
# Motions without derivatives that are kept: at the end of a fit the residuals, the contacts and the cost are asked for
# of the same motion. A fit to two records takes 262 integrations with 4 or 8, 260 with 16, 310 with 1.
KEPT = 8

Job = Callable[[], np.ndarray]


def one_by_one(jobs: Sequence[Job]) -> list[np.ndarray]:
    """The values of all ``jobs``, arrays (...) each, which this rank computes alone."""
    return [job() for job in jobs]


class SensorSignal(NamedTuple):
    """What a sensor of the model reads: ``values`` (sample,) in SI units, ``rate`` (sample,) their change in a second.

    ``slopes`` are derivatives (sample,) by the number of the coordinate. Offsets are not among them: their derivatives
    follow from the rate. By all other coordinates that are missing the derivative is 0.
    """

    values: np.ndarray
    rate: np.ndarray
    slopes: Mapping[int, np.ndarray]


class Misfit:
    """Residuals of the ``records`` of a ``plan`` over their noise, (model - measured)/``noise``.

    ``noise`` has one array (sensor,) a record, in SI units; a new misfit has the ``sizes`` of the channels there, root
    mean squares. The ``size`` coordinates z (coordinate,) are those of the parameters, then those of the initial states
    that are estimated, ``states`` by the number of the record. ``watched`` (record) are the masses (sensor,) at which
    the sensors are. ``compute`` returns the values of jobs that do not depend on each other: ranks may share them.
    """

    def __init__(
        self,
        plan: IdentifyCase,
        records: Sequence[Measured],
        compute: Callable[[Sequence[Job]], list[np.ndarray]] = one_by_one,
    ) -> None:
        self.plan = plan
        self.records = records
        self.compute = compute
        self._trials = [plan.trials(number) for number in range(len(records))]
        self._kept_motion = lru_cache(maxsize=KEPT)(self._new_motion)
        self._slopes = [CoefficientSlopes(plan.parameters, trials) for trials in self._trials]
        self.sizes = [np.sqrt(np.mean(record.values**2, axis=0)) for record in records]
        self.noise = list(self.sizes)
        base = plan.base
        dofs = base.lattice.unit_cell().dofs
        self.watched = []
        for table in plan.options.records:
            # A sensor of the drive's force has no mass: the first one holds its place.
            masses = np.zeros(len(table.sensors), int)
            for i, sensor in enumerate(table.sensors):
                if sensor.cell is not None:
                    masses[i] = (sensor.cell - 1) * dofs + (sensor.mass or 1) - 1
            self.watched.append(masses)

        self.states: dict[int, InitialState] = {}
        self.size = len(plan.parameters)
        for number, table in enumerate(plan.options.records):
            if table.initial == "estimate":
                sensors = [
                    (int(mass), ROWS[sensor.quantity], float(size))
                    for mass, sensor, size in zip(self.watched[number], table.sensors, self.noise[number], strict=True)
                    if sensor.quantity != "force"
                ]
                state = initial_state(self._trials[number].base.model(), self.size, sensors)
                self.states[number] = state
                self.size = state.stop

    @property
    def count(self) -> int:
        """The number of parameters."""
        return len(self.plan.parameters)

    def model(self, z: np.ndarray, number: int) -> Model:
        """The model of record ``number`` (from 0) at ``z`` (coordinate,); raises CaseError if it is impossible."""
        return self._trials[number].case(self.values(z)).model()

    def values(self, z: np.ndarray) -> np.ndarray:
        """The values (parameter,) at the coordinates ``z``."""
        return values_at(self.plan.parameters, z)

    def offset(self, z: np.ndarray, number: int) -> float:
        """The time in s of the record ``number``'s clock at which its drive begins, at ``z`` (coordinate,)."""
        offset = self.plan.options.records[number].offset
        if not isinstance(offset, list):
            return offset
        values = self.values(z)
        return next(
            float(value)
            for parameter, value in zip(self.plan.parameters, values, strict=True)
            if parameter.quantity == "offset" and parameter.members == (number,)
        )

    def columns(self, number: int, active: Iterable[int]) -> tuple[list[int], list[int]]:
        """The ``active`` coordinates by which the motion of record ``number`` is differentiated, in two lists.

        The first are parameters of the equations of motion, all but offsets, which only shift the motion in time. The
        second are coordinates of the record's initial state.
        """
        active = list(active)
        inner = [p for p in active if p < self.count and not self._is_of(p, "offset")]
        state = self.states.get(number)
        return inner, [p for p in active if state and p in state.indices]

    def motion(self, z: np.ndarray, number: int, end: float, tolerances: Tolerances = EXACT) -> RecordedMotion:
        """The motion of record ``number`` at ``z`` (coordinate,), at its sensors, without derivatives.

        It goes up to the time ``end`` in s of the record's clock. The latest ``KEPT`` motions are kept. Raises
        CaseError, MotionError.
        """
        samples = int(np.sum(self.records[number].times <= end))
        return self._kept_motion(tuple(z.tolist()), number, samples, tolerances)

    def _new_motion(self, z: tuple[float, ...], number: int, samples: int, tolerances: Tolerances) -> RecordedMotion:
        """The ``motion`` at ``z`` over so many ``samples``, computed; a cache needs a tuple of numbers."""
        end = float(self.records[number].times[samples - 1])
        return self.respond(np.array(z), number, end, tolerances=tolerances)

    def respond(
        self,
        z: np.ndarray,
        number: int,
        end: float,
        active: Iterable[int] = (),
        watched: np.ndarray | None = None,
        stride: int = 1,
        tolerances: Tolerances = EXACT,
    ) -> RecordedMotion:
        """The motion of record ``number`` up to the time ``end`` in s of its clock, at ``z`` (coordinate,).

        It has derivatives with respect to those of the ``active`` coordinates that ``columns`` names, in that order. It
        is sampled at the masses ``watched`` (mass,), by default those of the sensors, and at every ``stride``-th sample
        of the record. Raises CaseError, MotionError.
        """
        table = self.plan.options.records[number]
        model = self.model(z, number)
        if watched is None:
            watched = self.watched[number]

        coefficients = MotionCoefficients.of(model)
        inner, estimated = self.columns(number, active)
        by_parameter = [self._slopes[number].at(z, p, model, coefficients) for p in inner]
        none = no_slopes(model, coefficients)
        # Behind the parameters come coordinates of the initial state, on which no coefficient depends.
        rows = [slope.coefficients for slope in by_parameter] + [none] * len(estimated)
        return respond(
            model,
            coefficients,
            stacked_slopes(rows, none),
            times=self.times(z, number, end)[::stride],
            watched=watched,
            touches=table.contact,
            begin=self._begin(z, number, model, by_parameter, estimated),
            tolerances=tolerances,
        )

    def _begin(
        self, z: np.ndarray, number: int, model: Model, by_parameter: Sequence[ParameterSlope], estimated: Sequence[int]
    ) -> MotionBegin | None:
        """The beginning of the motion of record ``number`` at ``z`` (coordinate,); None for rest.

        Its derivatives are those ``by_parameter``, then those by the ``estimated`` coordinates of the initial state.
        """
        state = self.states.get(number)
        if state is not None:
            matrix = state.matrix
            slopes = np.zeros((len(matrix), len(by_parameter) + len(estimated)))
            slopes[:, len(by_parameter) :] = matrix[:, [p - state.first for p in estimated]]
            return MotionBegin(self._earliest(number), matrix @ z[state.first : state.stop], slopes)
        if model.initial is None:
            return None

        begin = state_of(model)
        slopes = np.zeros((len(begin), len(by_parameter)))
        for column, slope in enumerate(by_parameter):
            slopes[:, column] = slope.state
        return MotionBegin(0.0, begin, slopes)

    def _earliest(self, number: int) -> float:
        """The time in s, since the drive's beginning, at which the state that is estimated for a record is taken.

        It is the time of the first sample of record ``number``. If the offset is unknown, it is the earliest that this
        sample may have: what the state stands for does not then depend on the offset.
        """
        offset = self.plan.options.records[number].offset
        if isinstance(offset, list):
            offset = offset[1]
        return float(self.records[number].times[0]) - offset

    def times(self, z: np.ndarray, number: int, end: float) -> np.ndarray:
        """The samples' times (time,) in s since the beginning of the drive, up to the record's time ``end``."""
        times = self.records[number].times
        return np.asarray(times[times <= end] - self.offset(z, number))

    def predicted(
        self, z: np.ndarray, number: int, end: float, active: Sequence[int] = (), tolerances: Tolerances = EXACT
    ) -> tuple[np.ndarray, np.ndarray]:
        """Values of the model at the sensors of a record (sample, sensor), and derivatives (sample, sensor, active).

        ``z`` (coordinate,) are the model's coordinates, ``end`` in s is a time of the record's clock. Raises CaseError,
        MotionError.
        """
        if active:
            motion = self.respond(z, number, end, active, tolerances=tolerances).motion
        else:
            motion = self.motion(z, number, end, tolerances).motion

        values = np.zeros(motion.shape[:2])
        slopes = np.zeros((*values.shape, len(active)))
        for k, sensor in enumerate(self.plan.options.records[number].sensors):
            if sensor.quantity == "force":
                signal = self._force_signal(z, number, end, sensor, active)
            else:
                signal = self._motion_signal(motion[:, k], number, sensor, active)
            values[:, k] = signal.values
            for column, p in enumerate(active):
                if self._is_of(p, "offset"):
                    slopes[:, k, column] = self._offset_slope(z, number, p, signal.rate)
                elif p in signal.slopes:
                    slopes[:, k, column] = signal.slopes[p]
        return values, slopes

    def _motion_signal(
        self, motion: np.ndarray, number: int, sensor: SensorTable, active: Sequence[int]
    ) -> SensorSignal:
        """What a ``sensor`` of motion reads; ``motion`` (sample, row, 1 + column) is that of its mass."""
        row = ROWS[sensor.quantity]
        inner, estimated = self.columns(number, active)
        # Column 0 is the motion itself, the others are its derivatives.
        slopes = {p: motion[:, row, 1 + column] for column, p in enumerate(inner + estimated)}
        return SensorSignal(values=motion[:, row, 0], rate=motion[:, row + 1, 0], slopes=slopes)

    def _force_signal(
        self, z: np.ndarray, number: int, end: float, sensor: SensorTable, active: Sequence[int]
    ) -> SensorSignal:
        """What a ``sensor`` of a drive's force reads, at ``z`` (coordinate,), up to the record's time ``end`` in s."""
        force, rate = self._force(z, number, end, (sensor.drive or 1) - 1)

        # The amplitude that is sought is the first drive's, unless the record has one of its own. No other parameter
        # changes a drive's force, which is proportional to its amplitude.
        slopes = {}
        if sensor.drive in (None, 1) and "amplitude" not in self.plan.options.records[number].drive:
            for p in active:
                if self._is_of(p, "amplitude"):
                    parameter = self.plan.parameters[p]
                    slopes[p] = force / parameter.from_coordinate(z[p]) * parameter.slope(z[p])
        return SensorSignal(values=force, rate=rate, slopes=slopes)

    def _offset_slope(self, z: np.ndarray, number: int, p: int, rate: np.ndarray) -> np.ndarray:
        """Derivative (sample,) of a signal with this ``rate`` (sample,) by coordinate ``p``, which is an offset.

        A later beginning of the drive shifts the whole motion of record ``number`` to later times.
        """
        parameter = self.plan.parameters[p]
        is_own = parameter.members == (number,)
        return np.asarray(-rate * parameter.slope(z[p]) * is_own)

    def _is_of(self, p: int, quantity: str) -> bool:
        """Whether coordinate ``p`` is that of a parameter of this ``quantity``."""
        return p < self.count and self.plan.parameters[p].quantity == quantity

    def _force(self, z: np.ndarray, number: int, end: float, drive: int) -> tuple[np.ndarray, np.ndarray]:
        """The force (sample,) in N of the ``drive`` of that number (from 0) in the case, and its rate in N/s."""
        case = self._trials[number].case(self.values(z))
        model = case.model()
        # The model has a drive for each spring to a moved wall, and so may have more of them than the case.
        place = first_built(case.drive, model.chain)[drive]
        drives = create_drives(model.drives, range(len(model.drives)))
        times = self.times(z, number, end)
        short = SHORT / fastest_of(model.drives[place].waveform)
        before, force, after = (drive_forces(drives, times + shift)[place] for shift in (-short, 0.0, short))
        # Before its beginning there is no drive.
        started = times > 0
        return force * started, (after - before) / (2 * short) * started

    def residuals(self, z: np.ndarray, ends: Sequence[float], tolerances: Tolerances = EXACT) -> np.ndarray:
        """Residuals (datum,) over the noise at ``z`` (coordinate,), up to times ``ends`` (record,) in s of the records.

        Data are ordered by record, sample, sensor; a record with an end of -inf is left out. Residuals of a record are
        ``REJECTED``, or more if the noise is very small, where the model is impossible or its motion cannot be
        followed.
        """

        def residuals_of(number: int) -> np.ndarray:
            record = self.records[number]
            measured = record.values[record.times <= ends[number]]
            try:
                values, _ = self.predicted(z, number, ends[number], tolerances=tolerances)
            except (CaseError, MotionError):
                rejected = np.maximum(REJECTED, REJECTED_SIZE * self.sizes[number] / self.noise[number])
                return np.broadcast_to(rejected, measured.shape).ravel()
            return np.asarray((values - measured) / self.noise[number]).ravel()

        return np.concatenate(self.compute([partial(residuals_of, number) for number in self._used(ends)]))

    def jacobian(
        self, z: np.ndarray, ends: Sequence[float], active: Sequence[int], tolerances: Tolerances = EXACT
    ) -> np.ndarray:
        """Derivatives (datum, active) of ``residuals``; raises CaseError, MotionError."""

        def slopes_of(number: int, part: Sequence[int]) -> np.ndarray:
            _, slopes = self.predicted(z, number, ends[number], part, tolerances)
            return np.asarray(slopes / self.noise[number][:, None]).reshape(-1, len(part))

        # By which coordinates each part of each record is differentiated; initial states act on their records alone.
        parts = []
        for number in self._used(ends):
            relevant = [p for p in active if p < self.count or p in self.columns(number, active)[1]]
            length = max(LEAST_PART, -(-len(relevant) // MOST_PARTS))
            parts += [(number, relevant[k : k + length]) for k in range(0, len(relevant), length)]
        columns = self.compute([partial(slopes_of, number, part) for number, part in parts])

        column_of = {p: column for column, p in enumerate(active)}
        blocks = []
        for number in self._used(ends):
            samples = int((self.records[number].times <= ends[number]).sum())
            block = np.zeros((samples * len(self.watched[number]), len(active)))
            for (owner, part), values in zip(parts, columns, strict=True):
                if owner == number:
                    block[:, [column_of[p] for p in part]] = values
            blocks.append(block)
        return np.concatenate(blocks)

    def cost(self, z: np.ndarray, ends: Sequence[float], tolerances: Tolerances = EXACT) -> float:
        """The sum of squares at ``z`` (coordinate,) of residuals over the noise and of the initial states' prior.

        The residuals are those up to ``ends`` (record,) in s.
        """
        data = self.residuals(z, ends, tolerances)
        return float(np.sum(data**2)) + float(np.sum((self.prior() @ z) ** 2))

    def _used(self, ends: Sequence[float]) -> list[int]:
        """The numbers of the records that have samples up to ``ends``."""
        return [n for n, (record, end) in enumerate(zip(self.records, ends, strict=True)) if record.times[0] <= end]

    def prior(self) -> np.ndarray:
        """The slopes (state coordinate, coordinate) of the prior's residuals, which are coordinates over ``WIDTH``.

        They keep initial states finite.
        """
        return np.eye(self.size)[self.count :] / WIDTH

    def whole_jacobian(self, z: np.ndarray, ends: Sequence[float]) -> np.ndarray:
        """The ``jacobian`` (residual, coordinate), with the rows of the ``prior`` behind those of data."""
        return np.vstack([self.jacobian(z, ends, range(self.size)), self.prior()])
