"""Samples of a drive's waveform, from a case or from a file."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vipetsc.case.case_file import LARGEST, Problem, Section, Table
from vipetsc.case.reading import MISSING
from vipetsc.case.schema import Finite
from vipetsc.case.section import described
from vipetsc.io.names import file_hash, resolved_path
from vipetsc.io.tables import read_table
from vipetsc.lattice.drive import Interpolation

# The resolved case holds the samples, and so does every result: so many are 5 MB of text and 0.6 s to read.
MOST_SAMPLES = 100_000


class SamplesTable(Section):
    """A waveform's ``value`` at each ``time``, or the ``file`` that has them: two columns of text, or a ``dataset``."""

    file: str | None = described(
        "CSV or text file with columns of time and value, or an HDF5 file; a relative path: in the folder"
        " of the case file, else in the current folder",
        None,
    )
    dataset: str | None = described("dataset of shape (sample, 2) in an HDF5 file", None)
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


def with_samples(table: Table) -> tuple[Table, list[Problem]]:
    """``table`` with the samples of the files that its drives name, and what is wrong with these."""
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
    """The table of a ``drive`` with the samples of the file that it names, and what is wrong with that."""
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
        rows = _read(file, samples.get("dataset"))
        digest = file_hash(file)
    except FileNotFoundError:
        return drive, [Problem(key, samples["file"], MISSING)]
    # TypeError: a dataset of a type that numpy does not have.
    except (OSError, ValueError, KeyError, TypeError) as error:
        return drive, [Problem(key, samples["file"], str(error))]

    # Numbers that are smaller than those allowed in a case are noise about 0.
    times, values = np.where(np.abs(rows) < 1 / LARGEST, 0.0, rows).T.tolist()
    filled = {"file": str(file), "sha256": digest, "time": times, "value": values}
    return drive | {"samples": samples | filled}, []


def _read(path: Path, dataset: Any) -> np.ndarray:
    """Rows (sample, 2) of time in s and value; raises OSError, ValueError, KeyError or TypeError."""
    if dataset is not None:
        with h5py.File(path, "r") as file:
            values = file[str(dataset)]
            if not isinstance(values, h5py.Dataset) or values.shape is None:
                raise ValueError(f"{dataset} is not a dataset of numbers")
            # The shape is checked before the data are read: a file may hold more than the memory.
            _check_shape(values.shape)
            rows = np.asarray(values, float)
    elif h5py.is_hdf5(path):
        raise ValueError("is an HDF5 file; give samples.dataset")
    else:
        rows = read_table(path, MOST_SAMPLES).values
    _check_shape(rows.shape)
    return rows


def _check_shape(shape: tuple[int, ...]) -> None:
    """Raise ValueError for numbers of another ``shape`` than two columns of samples, no more than are allowed."""
    if len(shape) != 2 or shape[1] != 2 or shape[0] > MOST_SAMPLES:
        raise ValueError(f"holds {shape} numbers; give time and value in two columns, with at most {MOST_SAMPLES} rows")
