"""Residuals of measured records and their Jacobian, over windows from the beginning of each record."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial

import numpy as np

from vipetsc.case import CaseError, Model
from vipetsc.case.identify import IdentifyCase
from vipetsc.case.measured import Measured
from vipetsc.dynamics.drives import create_drives, drive_forces
from vipetsc.identification.initial_state import WIDTH, InitialState, initial_state, state_of
from vipetsc.identification.motion import MotionCoefficients, MotionError, RecordedMotion, respond, slopes_between
from vipetsc.identification.motion_begin import MotionBegin
from vipetsc.identification.motion_rates import SHORT

# Half the distance of the coordinates between which coefficients of the motion are differenced.
HALF_WIDTH = 1e-5
# Rows of a response, by the quantity of a sensor; the derivative with respect to time is in the row after it.
ROWS = {"displacement": 0, "velocity": 1, "acceleration": 2}
# Residual of a motion that cannot be computed: a step that leads there is rejected.
REJECTED = 1e8
# Derivatives of a record are integrated in so many parts at most, of so many coordinates at least. The parts do not
# depend on the number of ranks that work on them, and so the steps, and all bits, do not.
MOST_PARTS = 8
LEAST_PART = 4

Job = Callable[[], np.ndarray]


def one_by_one(jobs: Sequence[Job]) -> list[np.ndarray]:
    """The values of all ``jobs``, arrays (...) each, which this rank computes alone."""
    return [job() for job in jobs]


class Misfit:
    """Residuals of the ``records`` of a ``plan`` over what is allowed, (model - measured)/``noise``.

    ``noise`` has one array (sensor,) a record, in SI units. Coordinates z (coordinate,) are those of the parameters,
    then those of the initial states that are estimated, ``states`` by the number of the record; there are ``size``.
    ``compute`` returns the values of jobs that do not depend on each other: ranks may divide them.
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
        self.noise = [np.sqrt(np.mean(record.values**2, axis=0)) for record in records]
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
        """The model of record ``number`` at ``z`` (coordinate,); raises CaseError if it is impossible."""
        return self._trials[number].case(self.values(z)).model()

    def values(self, z: np.ndarray) -> np.ndarray:
        """The values (parameter,) at the coordinates ``z``."""
        return np.array([p.from_coordinate(x) for p, x in zip(self.plan.parameters, z[: self.count], strict=True)])

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

    def _models(self, z: np.ndarray, number: int, which: Sequence[int]) -> tuple[list[Model], list[Model], np.ndarray]:
        """The models below and above ``z`` in each of the parameters ``which``, and how far apart these are."""
        lower: list[Model] = []
        upper: list[Model] = []
        widths: list[float] = []
        values = self.values(z)
        for p in which:
            parameter = self.plan.parameters[p]
            # At a bound the difference is one-sided.
            below = max(z[p] - HALF_WIDTH, parameter.to_coordinate(parameter.low))
            above = min(z[p] + HALF_WIDTH, parameter.to_coordinate(parameter.high))
            widths.append(above - below)

            for models, coordinate in ((lower, below), (upper, above)):
                moved = values.copy()
                moved[p] = parameter.from_coordinate(coordinate)
                models.append(self._trials[number].case(moved).model())
        return lower, upper, np.array(widths)

    def columns(self, number: int, active: Iterable[int]) -> tuple[list[int], list[int]]:
        """The ``active`` coordinates that have a column in the motion of record ``number``.

        They are parameters of the equations of motion, then coordinates of its initial state.
        """
        active = list(active)
        inner = [p for p in active if p < self.count and not self._is(p, "offset")]
        state = self.states.get(number)
        return inner, [p for p in active if state and p in state.indices]

    def respond(
        self,
        z: np.ndarray,
        number: int,
        end: float,
        active: Iterable[int] = (),
        watched: np.ndarray | None = None,
        stride: int = 1,
    ) -> RecordedMotion:
        """The motion of record ``number`` up to its time ``end``, with derivatives by its ``columns`` of ``active``.

        It is that of the masses ``watched`` (mass,), by default those of the sensors, at every ``stride``-th sample.
        Raises CaseError, MotionError.
        """
        table = self.plan.options.records[number]
        model = self.model(z, number)
        if watched is None:
            watched = self.watched[number]

        # Derivatives of the equations of motion, as differences between two models for each parameter.
        inner, estimated = self.columns(number, active)
        lower, upper, widths = self._models(z, number, inner)
        coefficients = MotionCoefficients.of(model)
        slopes = slopes_between(lower, upper, widths, model, coefficients, others=len(estimated))
        return respond(
            model,
            coefficients,
            slopes,
            times=self.times(z, number, end)[::stride],
            watched=watched,
            touches=table.contact,
            begin=self._begin(z, number, model, (lower, upper, widths), estimated),
        )

    def _begin(
        self,
        z: np.ndarray,
        number: int,
        model: Model,
        neighbours: tuple[list[Model], list[Model], np.ndarray],
        estimated: Sequence[int],
    ) -> MotionBegin | None:
        """The beginning of the motion of record ``number``; None for rest.

        ``neighbours`` are the lower and upper models of each parameter's difference, and its width.
        """
        lower, upper, widths = neighbours
        state = self.states.get(number)
        if state is not None:
            matrix = state.matrix
            slopes = np.zeros((len(matrix), len(widths) + len(estimated)))
            slopes[:, len(widths) :] = matrix[:, [p - state.first for p in estimated]]
            return MotionBegin(self._earliest(number), matrix @ z[state.first : state.stop], slopes)
        if model.initial is None:
            return None

        begin = state_of(model)
        slopes = np.zeros((len(begin), len(widths)))
        # Only modes and packets depend on the cell.
        if model.initial.kind in ("mode", "packet"):
            for p, (low, high, width) in enumerate(zip(lower, upper, widths, strict=True)):
                slopes[:, p] = (state_of(high) - state_of(low)) / width
        return MotionBegin(0.0, begin, slopes)

    def _earliest(self, number: int) -> float:
        """The time in s since the beginning of the drive of the state that is estimated for record ``number``.

        That is the first sample's, and of an unknown offset the earliest that it can have: the state does not then
        depend on the offset.
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
        self, z: np.ndarray, number: int, end: float, active: Sequence[int] = ()
    ) -> tuple[np.ndarray, np.ndarray]:
        """What the sensors of a record measure (sample, sensor), and derivatives (sample, sensor, active).

        Raises CaseError, MotionError.
        """
        response = self.respond(z, number, end, active)
        table = self.plan.options.records[number]
        motion = response.motion
        inner, estimated = self.columns(number, active)
        column_of = {p: 1 + column for column, p in enumerate(inner + estimated)}

        values = np.zeros(motion.shape[:2])
        slopes = np.zeros((*values.shape, len(active)))
        for k, sensor in enumerate(table.sensors):
            if sensor.quantity == "force":
                values[:, k], rate = self._force(z, number, end, (sensor.drive or 1) - 1)
            else:
                row = ROWS[sensor.quantity]
                values[:, k] = motion[:, k, row, 0]
                rate = motion[:, k, row + 1, 0]

            is_of_amplitude = sensor.drive in (None, 1) and "amplitude" not in table.drive
            for column, p in enumerate(active):
                if self._is(p, "offset"):
                    # A later beginning of the drive shifts the whole motion.
                    parameter = self.plan.parameters[p]
                    is_own = parameter.members == (number,)
                    slopes[:, k, column] = -rate * parameter.slope(z[p]) * is_own
                elif sensor.quantity != "force":
                    if p in column_of:
                        slopes[:, k, column] = motion[:, k, ROWS[sensor.quantity], column_of[p]]
                elif self._is(p, "amplitude") and is_of_amplitude:
                    parameter = self.plan.parameters[p]
                    slopes[:, k, column] = values[:, k] / parameter.from_coordinate(z[p]) * parameter.slope(z[p])
        return values, slopes

    def _is(self, p: int, quantity: str) -> bool:
        """Whether coordinate ``p`` is that of a parameter of this ``quantity``."""
        return p < self.count and self.plan.parameters[p].quantity == quantity

    def _force(self, z: np.ndarray, number: int, end: float, drive: int) -> tuple[np.ndarray, np.ndarray]:
        """The force (sample,) in N of a ``drive`` and its rate in N/s."""
        model = self.model(z, number)
        drives = create_drives(model.drives, range(len(model.drives)))
        times = self.times(z, number, end)
        short = SHORT / model.drives[drive].waveform.highest
        before, force, after = (drive_forces(drives, times + shift)[drive] for shift in (-short, 0.0, short))
        # Before its beginning there is no drive.
        started = times > 0
        return force * started, (after - before) / (2 * short) * started

    def residuals(self, z: np.ndarray, ends: Sequence[float]) -> np.ndarray:
        """Residuals (datum,) up to the time ``ends`` of each record's clock; REJECTED where there is no motion.

        Data are ordered by record, sample, sensor; a record with an end of -inf is left out.
        """

        def residuals_of(number: int) -> np.ndarray:
            record = self.records[number]
            measured = record.values[record.times <= ends[number]]
            try:
                values, _ = self.predicted(z, number, ends[number])
            except (CaseError, MotionError):
                return np.full(measured.size, REJECTED)
            return np.asarray((values - measured) / self.noise[number]).ravel()

        return np.concatenate(self.compute([partial(residuals_of, number) for number in self._used(ends)]))

    def jacobian(self, z: np.ndarray, ends: Sequence[float], active: Sequence[int]) -> np.ndarray:
        """Derivatives (datum, active) of ``residuals``; raises CaseError, MotionError."""

        def slopes_of(number: int, part: Sequence[int]) -> np.ndarray:
            _, slopes = self.predicted(z, number, ends[number], part)
            return np.asarray(slopes / self.noise[number][:, None]).reshape(-1, len(part))

        parts = []
        for number in self._used(ends):
            relevant = [p for p in active if p < self.count or p in self.columns(number, active)[1]]
            length = max(LEAST_PART, -(-len(relevant) // MOST_PARTS))
            parts += [(number, relevant[k : k + length]) for k in range(0, len(relevant), length)]
        columns = self.compute([partial(slopes_of, number, part) for number, part in parts])

        place = {p: column for column, p in enumerate(active)}
        blocks = []
        for number in self._used(ends):
            samples = int((self.records[number].times <= ends[number]).sum())
            block = np.zeros((samples * len(self.watched[number]), len(active)))
            for (owner, part), values in zip(parts, columns, strict=True):
                if owner == number:
                    block[:, [place[p] for p in part]] = values
            blocks.append(block)
        return np.concatenate(blocks)

    def _used(self, ends: Sequence[float]) -> list[int]:
        """The numbers of the records that have samples up to ``ends``."""
        return [n for n, (record, end) in enumerate(zip(self.records, ends, strict=True)) if record.times[0] <= end]

    def prior(self) -> np.ndarray:
        """The slopes (state coordinate, coordinate) of residuals that keep initial states finite: coordinate/WIDTH."""
        return np.eye(self.size)[self.count :] / WIDTH

    def whole_jacobian(self, z: np.ndarray, ends: Sequence[float]) -> np.ndarray:
        """The ``jacobian`` (residual, coordinate), with the rows of the ``prior`` behind those of data."""
        return np.vstack([self.jacobian(z, ends, range(self.size)), self.prior()])
