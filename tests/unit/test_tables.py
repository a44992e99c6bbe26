"""Tables of text as instruments and spreadsheets write them: one reader for drives and for records."""

from __future__ import annotations

import numpy as np
import pytest

from vipetsc.case.identify import RecordTable, read_measured
from vipetsc.case.samples import with_samples
from vipetsc.io.tables import TableError, read_table

TIMES = [1e-4 * k for k in range(10)]
FORCES = [round(3.7e-4 * k**2, 8) for k in range(10)]
POINTS = [f"{t:.4f},{f:.8f}" for t, f in zip(TIMES, FORCES, strict=True)]
COMMAS = [row.replace(",", ";").replace(".", ",") for row in POINTS]
FORTRAN = [f"{t:.6e} {f:.6e}".replace("e", "D") for t, f in zip(TIMES, FORCES, strict=True)]

TABLES = {
    "names": ["t,F", *POINTS],
    "German": ["t;F", *COMMAS],
    "German, whole numbers first": ["t;F", "0;0", *COMMAS[1:]],
    "German, between blanks": ["t F", *(row.replace(";", "  ") for row in COMMAS)],
    "German, tabs": [row.replace(";", "\t") for row in ["t;F", *COMMAS]],
    "German, quoted between commas": ['"t","F"', *('"' + row.replace(";", '","') + '"' for row in COMMAS)],
    "quoted": ['"t";"F"', *('"' + row.replace(",", '";"') + '"' for row in POINTS)],
    "units": ["t,F", "s,N", *POINTS],
    "units with a micro sign": ["t,F", "\N{MICRO SIGN}s,N", *POINTS],
    "Fortran": ["t F", *FORTRAN],
    "trailing separators": [row + "," for row in ["t,F", *POINTS]],
    "percent": ["% exported by a logger", "t F", *(row.replace(",", " ") for row in POINTS)],
    "names in a comment": ["# of 3 May, by hand", "# t,F", *POINTS],
    "names in a comment, blanks": ["% t F", *(row.replace(",", " ") for row in POINTS)],
    "blank lines": ["# a comment", "t, F", "", *(row.replace(",", " ,  ") for row in POINTS), ""],
    "title": ["Oscilloscope", "t;F", *(row.replace(",", ";") for row in POINTS)],
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
@pytest.mark.parametrize("kind", TABLES)
def test_drives_and_records_read_the_same_tables(tmp_path, kind, encoding):
    """Both front doors give the numbers that were written, whatever wrote them."""
    path = tmp_path / "table.csv"
    path.write_text("\r\n".join(TABLES[kind]), encoding=encoding)

    table, problems = with_samples({"drive": {"waveform": "samples", "samples": {"file": str(path)}}})
    assert not problems
    assert table["drive"]["samples"]["time"] == pytest.approx(TIMES, abs=1e-12)
    assert table["drive"]["samples"]["value"] == pytest.approx(FORCES, abs=1e-7)

    sensor = {"quantity": "velocity", "cell": 1, "column": "F"}
    record = RecordTable.model_validate({"file": str(path), "time": "t", "sensors": [sensor]})
    assert read_measured(record).values[:, 0] == pytest.approx(FORCES, abs=1e-7)


@pytest.mark.parametrize(
    ("rows", "part"),
    [
        (["t,F", *POINTS[:3], "0.0003,l.0"], "line 5, field 2: 'l.0'"),
        (["0.0,O.0", *POINTS[1:]], "line 1, field 2: 'O.0'"),
        (["# made by hand", "", *POINTS[:3], "0.0003,"], "line 6 has another number of fields, 1; line 3 has 2"),
        ([*POINTS[:3], "0.0003,,"], "line 4, field 2: ''"),
        ([*COMMAS[:3], "1.234,5;0"], "field 1: "),
        (["t,F"], "has no line of numbers"),
        ([], "has no line of numbers"),
        (["0,1", "1,2", "2,3", "3,4"], "at most 3 rows"),
    ],
)
def test_what_is_not_a_number_is_named_with_its_line_and_field(tmp_path, rows, part):
    path = tmp_path / "table.csv"
    path.write_text("\n".join(rows), encoding="utf-8")
    with pytest.raises(TableError, match=part):
        read_table(path, most_rows=3 if "at most 3" in part else 1000)


def test_a_file_of_another_kind_is_not_a_table(tmp_path):
    path = tmp_path / "table.csv"
    path.write_bytes(np.random.default_rng(3).bytes(10_000))
    with pytest.raises(TableError):
        read_table(path, 1000)
