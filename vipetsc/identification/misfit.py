"""Residuals of measured records and their Jacobian, over windows from the beginning of each record."""

from collections.abc import Sequence

import numpy as np

from vipetsc.case import Case, CaseError, Model
from vipetsc.case.identify import IdentifyCase
from vipetsc.case.measured import Measured
from vipetsc.dynamics.drives import create_drives, drive_forces
from vipetsc.identification.motion import MotionError, RecordedMotion, no_slopes, respond, slopes_between
from vipetsc.identification.motion_rates import SHORT

# Half the distance of the coordinates between which coefficients of the motion are differenced.
HALF_WIDTH = 1e-5
# Rows of a response, by the quantity of a sensor; the derivative with respect to time is in the row after it.
ROWS = {"displacement": 0, "velocity": 1, "acceleration": 2}
# Residual of a motion that cannot be computed: a step that leads there is rejected.
REJECTED = 1e8


class Misfit:
    """Residuals of the ``records`` of a ``plan`` over what is allowed, (model - measured)/``noise``.

    ``noise`` has one array (sensor,) a record, in SI units. Coordinates z (parameter,) are those of the parameters.
    """

    def __init__(self, plan: IdentifyCase, records: Sequence[Measured]) -> None:
        self.plan = plan
        self.records = records
        self.noise = [np.sqrt(np.mean(record.values**2, axis=0)) for record in records]
        base = plan.base
        dofs = base.lattice.unit_cell().dofs
        self.watched = []
        for table in plan.options.records:
            masses = [0 if s.cell is None else (s.cell - 1) * dofs + (s.mass or 1) - 1 for s in table.sensors]
            self.watched.append(np.array(masses))

    def case(self, z: np.ndarray) -> Case:
        """The case at the coordinates ``z``; raises CaseError if it is impossible."""
        return self.plan.case_of(self.values(z))

    def values(self, z: np.ndarray) -> np.ndarray:
        """The values (parameter,) at the coordinates ``z``."""
        return np.array([p.from_coordinate(x) for p, x in zip(self.plan.parameters, z, strict=True)])

    def offset(self, z: np.ndarray, number: int) -> float:
        """The time in s of the record ``number``'s clock at which its drive begins."""
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
        for p in which:
            parameter = self.plan.parameters[p]
            # At a bound the difference is one-sided.
            below = max(z[p] - HALF_WIDTH, parameter.to_coordinate(parameter.low))
            above = min(z[p] + HALF_WIDTH, parameter.to_coordinate(parameter.high))
            widths.append(above - below)

            for models, coordinate in ((lower, below), (upper, above)):
                moved = z.copy()
                moved[p] = coordinate
                models.append(self.plan.record_case(self.case(moved), number).model())
        return lower, upper, np.array(widths)

    def respond(
        self, z: np.ndarray, number: int, end: float, active: Sequence[int] = (), watched: np.ndarray | None = None
    ) -> RecordedMotion:
        """The motion of record ``number`` up to its time ``end``, with derivatives by the parameters ``active``.

        Raises CaseError, MotionError.
        """
        table = self.plan.options.records[number]
        model = self.plan.record_case(self.case(z), number).model()
        inner = [p for p in active if self.plan.parameters[p].quantity != "offset"]
        slopes = slopes_between(*self._models(z, number, inner), model) if inner else no_slopes(model)
        times = self.times(z, number, end)
        return respond(model, slopes, times, self.watched[number] if watched is None else watched, table.contact)

    def times(self, z: np.ndarray, number: int, end: float) -> np.ndarray:
        """The samples' times in s since the beginning of the drive, up to the record's time ``end``."""
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
        parameters = self.plan.parameters
        motion = response.motion
        inner = [p for p in active if parameters[p].quantity != "offset"]
        values = np.zeros(motion.shape[:2])
        slopes = np.zeros((*values.shape, len(active)))
        for k, sensor in enumerate(table.sensors):
            if sensor.quantity == "force":
                values[:, k], rate = self._force(z, number, end, (sensor.drive or 1) - 1)
            else:
                row = ROWS[sensor.quantity]
                values[:, k] = motion[:, k, row, 0]
                rate = motion[:, k, row + 1, 0]
            for column, p in enumerate(active):
                parameter = parameters[p]
                if parameter.quantity == "offset":
                    if parameter.members == (number,):
                        slopes[:, k, column] = -rate * parameter.slope(z[p])
                elif sensor.quantity != "force":
                    slopes[:, k, column] = motion[:, k, ROWS[sensor.quantity], 1 + inner.index(p)]
                elif parameter.quantity == "amplitude" and sensor.drive in (None, 1) and "amplitude" not in table.drive:
                    slopes[:, k, column] = values[:, k] / parameter.from_coordinate(z[p]) * parameter.slope(z[p])
        return values, slopes

    def _force(self, z: np.ndarray, number: int, end: float, drive: int) -> tuple[np.ndarray, np.ndarray]:
        """The force (sample,) in N of a ``drive`` and its rate in N/s."""
        model = self.plan.record_case(self.case(z), number).model()
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
        parts = []
        for number, (record, end) in enumerate(zip(self.records, ends, strict=True)):
            used = record.times <= end
            measured = record.values[used]
            if not used.any():
                continue
            try:
                values, _ = self.predicted(z, number, end)
                parts.append(((values - measured) / self.noise[number]).ravel())
            except (CaseError, MotionError):
                parts.append(np.full(measured.size, REJECTED))
        return np.concatenate(parts)

    def jacobian(self, z: np.ndarray, ends: Sequence[float], active: Sequence[int]) -> np.ndarray:
        """Derivatives (datum, active) of ``residuals``; raises CaseError, MotionError."""
        parts = []
        for number, (record, end) in enumerate(zip(self.records, ends, strict=True)):
            if not (record.times <= end).any():
                continue
            _, slopes = self.predicted(z, number, end, active)
            parts.append((slopes / self.noise[number][:, None]).reshape(-1, len(active)))
        return np.concatenate(parts)
