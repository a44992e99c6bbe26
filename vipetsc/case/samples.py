"""Samples of a drive's waveform, as they stand in a case or in a file."""

import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from pydantic import Field

from vipetsc.case.case_file import LARGEST, Problem, Section, Table
from vipetsc.case.initial import file_hash
from vipetsc.case.schema import Finite

MOST_SAMPLES = 100_000


class SamplesTable(Section):
    """A waveform's ``value`` at each ``time``, or the ``file`` that has them: two columns of text, or a ``dataset``.

    What stands in a file is filled in, with its ``sha256``.
    """

    file: str | None = None
    dataset: str | None = None
    sha256: str | None = None
    time: list[Finite] = Field([], max_length=MOST_SAMPLES)
    value: list[Finite] = Field([], max_length=MOST_SAMPLES)


def with_samples(table: Table) -> tuple[Table, list[Problem]]:
    """``table`` with the samples of the files that its drives name, and what is wrong with these."""
    problems: list[Problem] = []

    def filled(drive: Any, key: str) -> Any:
        samples = drive.get("samples") if isinstance(drive, dict) else None
        if not isinstance(samples, dict) or not isinstance(samples.get("file"), str) or "sha256" in samples:
            return drive
        if {"time", "value"} & samples.keys():
            problems.append(Problem(f"{key}.samples.file", samples["file"], "give it or time and value, not both"))
            return drive
        path = Path(samples["file"]).resolve()
        try:
            rows, digest = _read(path, samples.get("dataset")), file_hash(path)
        except (OSError, ValueError, KeyError) as error:
            problems.append(Problem(f"{key}.samples.file", samples["file"], str(error)))
            return drive
        columns = np.where(np.abs(rows) < 1 / LARGEST, 0.0, rows).T.tolist()
        told = {"file": str(path), "sha256": digest, "time": columns[0], "value": columns[1]}
        return drive | {"samples": samples | told}

    drive = table.get("drive")
    if isinstance(drive, dict):
        drive = filled(drive, "drive")
        if isinstance(drive.get("more"), list):
            drive = drive | {"more": [filled(one, f"drive.more[{i}]") for i, one in enumerate(drive["more"], 1)]}
        table = table | {"drive": drive}
    return table, problems


def _read(path: Path, dataset: Any) -> np.ndarray:
    """Rows (sample, 2) of time in s and value; raises OSError, ValueError or KeyError."""
    if dataset is not None:
        with h5py.File(path, "r") as file:
            rows = np.asarray(file[str(dataset)], float)
    else:
        lines = [re.split(r"[,;\s]+", line.strip()) for line in path.read_text(encoding="utf-8-sig").splitlines()]
        lines = [line for line in lines if line[0] and not line[0].startswith("#")]
        try:
            rows = np.array(lines[1 if lines and not re.match(r"[-+.\d]", lines[0][0]) else 0 :], float)
        except ValueError:
            raise ValueError("is no table of numbers: time and value in two columns are needed") from None
    if rows.ndim != 2 or rows.shape[1] != 2 or len(rows) > MOST_SAMPLES:
        raise ValueError(f"holds {rows.shape} numbers; time and value in two columns, {MOST_SAMPLES} rows at most")
    return rows
