"""Measured records of the verb ``identify``: their sections, and the reading of their files."""

from collections.abc import Iterator
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from vipetsc.case.places import Place as CellPlace
from vipetsc.case.points import masses_remedy
from vipetsc.case.reading import MISSING
from vipetsc.case.samples import WALL_UNITS, Place
from vipetsc.case.schema import Finite, Positive, Range
from vipetsc.case.section import BY_SHAPE, Problem, Section, described
from vipetsc.io.names import file_hash, resolved_path
from vipetsc.io.tables import ColumnError, read_columns
from vipetsc.wording import counted

LEAST_SAMPLES = 8  # of a record: two windows of the least length in ``identification.growing_windows``
# Times may differ from even ones by this fraction of their interval, as those printed with few digits do. With ten
# samples a period, .05 of a sample is a phase of .03, which moves a value by 3 % of its amplitude.
UNEVEN = 0.05
SENSOR_UNITS = WALL_UNITS | {"force": "N"}


class SensorTable(Section):
    """A ``quantity`` at a ``mass`` of a ``cell``, or the force of a ``drive``, in a ``column`` of the record."""

    quantity: Literal["displacement", "velocity", "acceleration", "force"] = described("what the sensor measures")
    column: Place = described("column: name or number from 1; of HDF5 a dataset, with [3] behind it its third column")
    cell: int | None = described("cell of the sensor, from 1", None, ge=1)
    mass: int | None = described("mass of the cell, from 1; default: 1", None, ge=1)
    place: CellPlace | None = described("a strip: cell [i, j] or [i, j, mass], instead of cell and mass", None)
    drive: int | None = described("for a force: number of the drive, from 1; default: 1", None, ge=1)
    factor: Finite = described("factor that makes the values SI units", 1.0)
    noise: Positive | None = described(
        "standard deviation of the errors, in SI units; default: estimated from the residuals", None
    )

    @property
    def name(self) -> str:
        """A description of the sensor: its quantity and its place."""
        if self.quantity == "force":
            return f"force of drive {self.drive or 1}"
        return f"{self.quantity} of mass {self.mass or 1} in cell {self.cell}"


class RecordTable(Section):
    """A measurement: its ``file``, the times, and what the ``sensors`` recorded.

    ``initial`` = "estimate": the displacements and velocities of all masses at the first time are estimated with the
    parameters.
    """

    file: str = described(
        "file with the record: a table of text, or HDF5 (.h5, .hdf5, .nc); a relative path: in the folder"
        " of the case file, else in the current folder"
    )
    sha256: str | None = described("SHA-256 hash of the file, filled in", None)
    time: Place | None = described("column of the times: name or number from 1; of HDF5 a dataset", None)
    time_factor: Positive = described("factor that makes the times seconds", 1.0)
    rate: Positive | None = described("sample rate, in place of time", None, unit="Hz")
    offset: Annotated[Finite | Range, BY_SHAPE] = described(
        "time of the record at which the drive begins, or bounds [low, high] of an unknown one", 0.0, unit="s"
    )
    begin: Finite | None = described("first time of the record that is used", None, unit="s")
    end: Finite | None = described("last time of the record that is used", None, unit="s")
    initial: Annotated[Literal["estimate"] | dict[str, Any], BY_SHAPE] = described(
        "keys of [initial] that differ in this record, or `estimate` for a lattice that moves already", {}
    )
    drive: dict[str, Any] = described("keys of [drive] that differ in this record, such as amplitude", {})
    contact: bool = described(
        "whether contacts may close; false: a record at an amplitude at which nothing touches, which is fitted first",
        True,
    )
    sensors: list[SensorTable] = described("what was measured", min_length=1)


class Measured(NamedTuple):
    """A record in SI units: even ``times`` (sample,) in s of its own clock, ``values`` (sample, sensor).

    ``sha256`` is that of its file.
    """

    times: np.ndarray
    values: np.ndarray
    sha256: str


class MeasuredError(ValueError):
    """A record that cannot be used: ``key`` below that of the record, the ``value`` there, and the ``remedy``."""

    def __init__(self, key: str, value: Any, remedy: str) -> None:
        super().__init__(key, value, remedy)
        self.key = key
        self.value = value
        self.remedy = remedy


def read_measured(record: RecordTable) -> Measured:
    """Return times and values of a ``record`` between its ``begin`` and ``end``; raises MeasuredError for bad data."""
    try:
        path = resolved_path(record.file)
        digest = file_hash(path)
    except FileNotFoundError:
        raise MeasuredError("file", record.file, MISSING) from None
    except OSError as error:
        raise MeasuredError("file", record.file, str(error.strerror or error)) from None

    try:
        columns = read_columns(path, dict(_wanted(record)))
    except ColumnError as error:
        if error.key:
            raise MeasuredError(error.key, error.place, error.remedy) from None
        raise MeasuredError("file", record.file, error.remedy) from None

    lengths = {key: len(values) for key, values in columns.items()}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{key}: {length}" for key, length in lengths.items())
        raise MeasuredError("file", record.file, f"its columns have different lengths ({listed})")
    for key, values in columns.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            remedy = f"sample {bad[0] + 1} of {len(values)} is not a finite number; cut the record or fill the gap"
            raise MeasuredError(key, float(values[bad[0]]), remedy)

    values = np.column_stack(
        [columns[f"sensors[{number}].column"] * sensor.factor for number, sensor in enumerate(record.sensors, 1)]
    )
    _check_count("file", record.file, len(values))
    # The record is cut only after its times were found even: the interval of a short part would be less exact.
    times = _times(record, columns.get("time"), len(values))
    for key, sign in (("begin", -1.0), ("end", 1.0)):
        limit = getattr(record, key)
        if limit is not None:
            # A sample at the limit is kept, even if its time is beyond it by rounding.
            used = sign * (times - limit) <= 1e-9 * abs(times[-1] - times[0])
            times = times[used]
            values = values[used]
            _check_count(key, limit, len(times))

    for number, column in enumerate(values.T, 1):
        if not column.any():
            raise MeasuredError(
                f"sensors[{number}].column",
                record.sensors[number - 1].column,
                "is zero at all times; is the sensor connected?",
            )
    return Measured(times=times, values=values, sha256=digest)


def _check_count(key: str, value: Any, count: int) -> None:
    """Raise MeasuredError if a ``key`` with this ``value`` leaves too few samples."""
    if count < LEAST_SAMPLES:
        raise MeasuredError(key, value, f"leaves {count} samples; at least {LEAST_SAMPLES} are needed")


def _times(record: RecordTable, column: np.ndarray | None, count: int) -> np.ndarray:
    """Return even times (count,) in s from the ``rate`` or from the ``column`` of times."""
    if record.rate is not None:
        return np.arange(count) / record.rate
    assert column is not None

    times = column * record.time_factor
    interval = (times[-1] - times[0]) / (count - 1)
    even = times[0] + interval * np.arange(count)
    if not interval > 0:
        raise MeasuredError("time", record.time, "must rise from sample to sample")
    worst = int(np.argmax(abs(times - even)))
    if abs(times[worst] - even[worst]) > UNEVEN * interval:
        where = f"sample {worst + 1} is at {times[worst]:.9g} s instead of {even[worst]:.9g} s"
        remedy = f"is uneven: {where}; resample the record evenly, or give its rate"
        raise MeasuredError("time", record.time, remedy)
    return np.asarray(even)


def _wanted(record: RecordTable) -> Iterator[tuple[str, Place]]:
    """Yield the places of all columns of a record, by their keys."""
    if record.time is not None:
        yield "time", record.time
    for number, sensor in enumerate(record.sensors, 1):
        yield f"sensors[{number}].column", sensor.column


def sensor_problems(record: RecordTable, at: str, cells: int, dofs: int, drives: int) -> Iterator[Problem]:
    """Yield problems of the sensors of a ``record`` at the path ``at``.

    The lattice has ``cells`` cells with ``dofs`` masses each, and as many ``drives``.
    """
    for number, sensor in enumerate(record.sensors, 1):
        path = f"{at}.sensors[{number}]"
        if sensor.factor == 0:
            yield Problem(f"{path}.factor", 0.0, "must not be zero")
        if sensor.quantity == "force":
            if sensor.cell is not None or sensor.mass is not None:
                yield Problem(
                    f"{path}.cell", sensor.cell, "a force sensor measures a drive: use drive in place of cell and mass"
                )
            if (sensor.drive or 1) > drives:
                yield Problem(f"{path}.drive", sensor.drive, f"the case has {counted(drives, 'drive')}")
            continue

        if sensor.drive is not None:
            yield Problem(f"{path}.drive", sensor.drive, "applies to a force; give cell and mass")
        if sensor.cell is None:
            yield Problem(f"{path}.cell", None, f"missing; give the sensor's cell, 1 to {cells}, and mass")
        elif sensor.cell > cells:
            yield Problem(f"{path}.cell", sensor.cell, f"the lattice has the cells 1 to {cells}")
        if sensor.mass is not None and sensor.mass > dofs:
            yield Problem(f"{path}.mass", sensor.mass, masses_remedy(dofs))
