"""Samples of a waveform from files: data that are too many or no table, and names that can lead to no file."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.conftest import small_case
from vipetsc.case import CaseError, samples
from vipetsc.case.identify import MeasuredError, RecordTable, read_measured
from vipetsc.case.samples import with_samples

MOST = 1000


def refusal(**samples: object) -> str:
    """Return the text of the only problem with the file of a drive's ``samples``."""
    _, problems = with_samples({"drive": {"waveform": "samples", "samples": samples}})
    (problem,) = problems
    assert problem.key == "drive.samples.file"
    return str(problem)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Return an HDF5 file with a data set of 16 TB without written chunks, a group, and a table of three columns."""
    path = tmp_path / "samples.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("endless", shape=(10**12, 2), chunks=(1000, 2), dtype=float)
        file.create_group("group")
        file["three"] = np.zeros((4, 3))
        file["none"] = h5py.Empty("f8")
    return path


def test_the_size_of_a_data_set_is_checked_before_it_is_read(file):
    """Sixteen terabytes of samples are refused by their number, which no memory could hold."""
    assert "holds (1000000000000, 2) numbers" in refusal(file=str(file), dataset="endless")


def test_what_is_no_table_of_two_columns_is_refused(file):
    """A group, a table of three columns and a data set without numbers are named as such."""
    assert "group is not a dataset" in refusal(file=str(file), dataset="group")
    assert "holds (4, 3) numbers" in refusal(file=str(file), dataset="three")
    assert "none is not a dataset of numbers" in refusal(file=str(file), dataset="none")


@pytest.mark.parametrize("name", ["a\0b", "loop"])
def test_a_name_that_leads_to_no_file_is_refused(tmp_path, monkeypatch, name):
    """A name with a NUL, and a link to itself, are a problem of the key of samples, of a state and of a record."""
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    reason = "embedded null byte|Symlink loop|Too many levels"
    assert re.search(reason, refusal(file=name))
    with pytest.raises(CaseError, match=reason) as error:
        small_case(initial={"kind": "file", "path": name})
    assert [problem.key for problem in error.value.problems] == ["initial.path"]
    sensor = {"quantity": "velocity", "column": "v", "cell": 2}
    with pytest.raises(MeasuredError, match=reason):
        read_measured(RecordTable.model_validate({"file": name, "rate": 1.0, "sensors": [sensor]}))


def test_a_missing_value_in_the_first_row_is_no_line_of_names(tmp_path):
    """A first row of "nan" is one of numbers, which the case refuses; a line of names may begin with a digit."""
    path = tmp_path / "samples.csv"

    def times(text: str) -> list[float]:
        """Return the times that are read from a file with a ``text``."""
        path.write_text(text, encoding="utf-8")
        table, problems = with_samples({"drive": {"waveform": "samples", "samples": {"file": str(path)}}})
        assert not problems
        return table["drive"]["samples"]["time"]

    assert np.isnan(times("nan,1.0\n0.5,1.0\n1.0,0.0\n")[0])
    assert times("1st_time,2nd_force\n0.5,1.0\n1.0,0.0\n") == [0.5, 1.0]


@pytest.mark.parametrize("header", ["", "time,force\n"])
def test_a_table_of_text_is_read_up_to_the_line_that_is_too_much(tmp_path, monkeypatch, header):
    """A table of text with one sample more than allowed is refused, with a line of names or without."""
    # A table of the real limit takes seconds to read.
    monkeypatch.setattr(samples, "MOST_SAMPLES", MOST)
    path = tmp_path / "samples.csv"
    path.write_text(header + "0.5,1.0\n" * (MOST + 1), encoding="utf-8")
    assert f"at most {MOST} rows" in refusal(file=str(path))

    path.write_text(header + "# a comment\n\n" + "0.5,1.0\n" * MOST, encoding="utf-8")
    table, problems = with_samples({"drive": {"waveform": "samples", "samples": {"file": str(path)}}})
    assert not problems
    assert len(table["drive"]["samples"]["value"]) == MOST
