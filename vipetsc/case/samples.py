"""Samples of a drive's waveform, from a case or from a file."""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from vipetsc.case.reading import LARGEST, MISSING, Table
from vipetsc.case.schema import Finite, Positive
from vipetsc.case.section import BY_SHAPE, Problem, Section, described
from vipetsc.io.names import file_hash, resolved_path
from vipetsc.io.tables import ColumnError, read_columns, read_table
from vipetsc.lattice.drive import Interpolation, Joined, joined

# The resolved case holds the samples, and so does every result: so many are 5 MB of text and 0.6 s to read.
MOST_SAMPLES = 100_000
WALL_UNITS = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s^2"}
"""Units of the quantities by which the motion of a wall is measured, in the order of its derivatives."""

Place = Annotated[int | str, BY_SHAPE]
"""Of a column (``io.tables``): its number from 1, or its name."""


class SamplesTable(Section):
    """A waveform's ``value`` at each ``time``, or the ``file`` that has them: two columns of text, or a ``dataset``.

    Other files have them in the ``columns`` of time and value, or of value alone at a ``rate``. The values of a wall
    that moves may be its velocity or acceleration, the ``quantity``.
    """

    file: str | None = described(
        "CSV or text file with columns of time and value, or an HDF5 file; a relative path: in the folder"
        " of the case file, else in the current folder",
        None,
    )
    dataset: str | None = described("dataset of shape (sample, 2) in an HDF5 file", None)
    columns: list[Place] | None = described(
        "columns of time and value, or of the value alone with a `rate`: names or numbers from 1; of HDF5 datasets,"
        " with [3] behind a name its third column",
        None,
        min_length=1,
        max_length=2,
    )
    rate: Positive | None = described("sample rate, instead of a column of times", None, unit="Hz")
    time_factor: Positive | None = described("factor that makes the times of the file seconds", None)
    sha256: str | None = described("SHA-256 hash of the file, filled in", None)
    time: list[Finite] = described("times of the samples, instead of a file", [], unit="s", max_length=MOST_SAMPLES)
    value: list[Finite] = described(
        "values of the samples, which are multiplied by `amplitude`", [], max_length=MOST_SAMPLES
    )
    interpolation: Interpolation = described(
        "between samples: cubics that stay between neighbouring values (monotone), straight lines, or a"
        " cubic spline, for smooth and evenly sampled waveforms",
        "monotone",
    )
    quantity: Literal["displacement", "velocity", "acceleration"] | None = described(
        "what the values are of a wall that moves; velocity and acceleration are integrated (default: displacement)",
        None,
    )
    drift: Literal["remove", "keep"] | None = described(
        "of a velocity or an acceleration: whether an offset, of an acceleration also a drift in proportion to time, is"
        " removed, so that the wall ends at rest where it began (default: remove)",
        None,
    )

    @property
    def derivative(self) -> int:
        """How often the wall's displacement is differentiated for the values."""
        return list(WALL_UNITS).index(self.quantity or "displacement")

    @property
    def unit(self) -> str:
        """The unit of the values of a wall."""
        return WALL_UNITS[self.quantity or "displacement"]

    def motion(self) -> Joined:
        """Return the curve through the samples, of a wall its displacement."""
        return joined(
            self.time, self.value, self.interpolation, derivative=self.derivative, removes=self.drift != "keep"
        )

    def describe_removed(self, amplitude: float) -> str:
        """Return a clause on the offset and drift that are removed, in the unit of the ``amplitude``, or ""."""
        names = "offset", "drift"
        # An acceleration alone has a drift.
        units = self.unit, "m/s^3"
        removed = (amplitude * self.motion().removed).tolist()
        parts = [f"{name} {value:.4g} {of}" for name, value, of in zip(names, removed, units, strict=False)]
        if not parts:
            return ""
        return f"{' and '.join(parts)} removed, so that the wall ends at rest where it began"


def with_samples(table: Table) -> tuple[Table, list[Problem]]:
    """Return ``table`` with the samples of the files that its drives name, and what is wrong with these."""
    drive = table.get("drive")
    if not isinstance(drive, dict):
        return table, []

    drive, problems = _filled(drive, "drive")
    if isinstance(drive.get("more"), list):
        others = []
        for number, other in enumerate(drive["more"], 1):
            filled, wrong = _filled(other, f"drive.more[{number}]")
            others.append(filled)
            problems += wrong
        drive = drive | {"more": others}
    return table | {"drive": drive}, problems


def _filled(drive: Any, path: str) -> tuple[Any, list[Problem]]:
    """Return the table of a ``drive`` with the samples of the file that it names, and what is wrong with that."""
    samples = None
    # Types are not checked yet.
    if isinstance(drive, dict):
        samples = drive.get("samples")
    # With a hash the drive is a resolved one, and has its samples: results are read where that file is gone.
    if not isinstance(samples, dict) or not isinstance(samples.get("file"), str) or "sha256" in samples:
        return drive, []

    key = f"{path}.samples.file"
    if {"time", "value"} & samples.keys():
        return drive, [Problem(key, samples["file"], "give it or time and value, not both")]
    try:
        # The absolute path is recorded, since the resolved case is stored in a folder of results.
        file = resolved_path(samples["file"])
        rows = _read(file, samples)
        digest = file_hash(file)
    except FileNotFoundError:
        return drive, [Problem(key, samples["file"], MISSING)]
    except ColumnError as error:
        given = samples.get("columns") if error.key else samples["file"]
        return drive, [Problem(f"{path}.samples.columns" if error.key else key, given, error.remedy)]
    # TypeError: a dataset of a type that numpy does not have.
    except (OSError, ValueError, KeyError, TypeError) as error:
        return drive, [Problem(key, samples["file"], str(error))]

    # Numbers that are smaller than those allowed in a case are noise about 0.
    times, values = np.where(np.abs(rows) < 1 / LARGEST, 0.0, rows).T.tolist()
    filled = {"file": str(file), "sha256": digest, "time": times, "value": values}
    return drive | {"samples": samples | filled}, []


def _read(path: Path, samples: Table) -> np.ndarray:
    """Return rows (sample, 2) of time in s and value; raises OSError, ValueError, KeyError or TypeError."""
    rows = _rows(path, samples)
    factor = samples.get("time_factor")
    # Types are not checked yet.
    if isinstance(factor, int | float) and rows.ndim == 2:
        rows[:, :1] *= factor
    _check_shape(rows.shape)
    return rows


def _rows(path: Path, samples: Table) -> np.ndarray:
    """Return rows (sample, 2) of time and value as the file has them, and as ``_read`` raises."""
    import h5py

    dataset = samples.get("dataset")
    columns = samples.get("columns")
    rate = samples.get("rate")
    if columns is not None or rate is not None:
        places = columns if isinstance(columns, list) else [1]
        if dataset is not None or len(places) != 1 + (rate is None):
            raise ValueError("give samples.columns of time and value, or of the value alone with samples.rate")
        read = read_columns(path, {f"columns[{i}]": place for i, place in enumerate(places, 1)}, MOST_SAMPLES)
        series = list(read.values())
        if rate is not None:
            series.insert(0, np.arange(len(series[0])) / float(rate))
        return np.stack(series, axis=1)
    if dataset is not None:
        with h5py.File(path, "r") as file:
            values = file[str(dataset)]
            if not isinstance(values, h5py.Dataset) or values.shape is None:
                raise ValueError(f"{dataset} is not a dataset of numbers")
            # The shape is checked before the data are read: a file may hold more than the memory.
            _check_shape(values.shape)
            return np.asarray(values, float)
    if h5py.is_hdf5(path):
        raise ValueError("is an HDF5 file; give samples.dataset or samples.columns")
    return read_table(path, MOST_SAMPLES).values


def _check_shape(shape: tuple[int, ...]) -> None:
    """Raise ValueError for numbers of another ``shape`` than two columns of samples, no more than are allowed."""
    if len(shape) != 2 or shape[1] != 2 or shape[0] > MOST_SAMPLES:
        remedy = f"give the columns of time and value (samples.columns), with at most {MOST_SAMPLES} rows"
        raise ValueError(f"holds {shape} numbers; {remedy}")
