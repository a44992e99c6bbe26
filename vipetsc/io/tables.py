"""Tables of text, as loggers, oscilloscopes and spreadsheets write them.

Columns are separated by semicolons, tabs, commas or blanks; fields may be quoted, and rows may end with a separator.
Decimals have points, or commas where no field has a point; exponents are written with E or, as in Fortran, with D.
Lines that begin with # or % are comments. Before the numbers there may be lines of text, such as names and units.
"""

import csv
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

COMMENTS = ("#", "%")
NUMBER_BEGINS = re.compile(r"""["']?([-+.\d]|nan|inf)""", re.IGNORECASE)
WITH_DECIMAL_COMMA = re.compile(r"[-+]?\d+(,\d+)?([eEdD][-+]?\d+)?")


class TableError(ValueError):
    """A file that is not a table of numbers; the message names the line and the field."""


class TextTable(NamedTuple):
    """Numbers ``values`` (row, column), and the ``names`` of the columns, [] where the file has none."""

    names: list[str]
    values: np.ndarray


class Row(NamedTuple):
    """The ``fields`` of a ``line`` of the file, counted from 1."""

    line: int
    fields: list[str]


def read_table(path: Path, most_rows: int) -> TextTable:
    """Return the table in the file ``path``, which has at most ``most_rows`` rows of numbers.

    Raises OSError for a file that cannot be read, and TableError for one that holds something else.
    """
    lines = _lines(path, most_rows)
    first = next((text for _, text in lines if NUMBER_BEGINS.match(text)), "")
    separator = _separator(first)
    rows = [Row(line, _fields(text, separator)) for line, text in lines]

    # Text before the numbers. A line that is partly text is a mistake in a row of numbers.
    begin = next((i for i, row in enumerate(rows) if any(map(is_number, _with_points(row.fields)))), len(rows))
    above = rows[:begin]
    rows = rows[begin:]
    if not rows:
        raise TableError("has no line of numbers")
    if len(rows) > most_rows:
        raise TableError(f"has too many lines; at most {most_rows} rows of numbers are possible")

    width = len(rows[0].fields)
    for row in rows:
        if len(row.fields) != width:
            expected = f"line {rows[0].line} has {width}"
            raise TableError(f"line {row.line} has another number of fields, {len(row.fields)}; {expected}")
    names = next((row.fields for row in above if len(row.fields) == width), [])
    return TextTable(names, _numbers(rows))


def is_number(field: str) -> bool:
    """Return whether a ``field`` of a table of text is a number, as "nan" is."""
    return number_of(field) is not None


def number_of(field: str) -> float | None:
    """Return the number that a ``field`` of a table of text is; None for other text."""
    try:
        return float(field)
    except ValueError:
        pass
    # Double precision in Fortran: 1.5D-3.
    try:
        return float(re.sub(r"(?<=[\d.])[dD](?=[-+\d])", "e", field))
    except ValueError:
        return None


def _lines(path: Path, most_rows: int) -> list[tuple[int, str]]:
    """Return the lines of a file that are neither empty nor comments, each with its number; of a long file the first.

    As many as tell that there are more than ``most_rows`` rows of numbers.
    """
    with path.open("rb") as file:
        start = file.read(2)
    # Some spreadsheets write UTF-16; others, on Windows, UTF-8 with a byte order mark.
    encoding = "utf-8-sig"
    if start in (b"\xff\xfe", b"\xfe\xff"):
        encoding = "utf-16"
    try:
        return [*_read_lines(path, most_rows, encoding)]
    except UnicodeDecodeError:
        # Letters such as the micro sign in a line of units, in the encoding of western Europe.
        lines = [*_read_lines(path, most_rows, "latin-1")]
    if any("\0" in text for _, text in lines):
        raise TableError("is not a table of text")
    return lines


def _read_lines(path: Path, most_rows: int, encoding: str) -> Iterator[tuple[int, str]]:
    """Yield the lines of ``_lines`` from a file in this ``encoding``."""
    count = 0
    with path.open(encoding=encoding) as file:
        for number, line in enumerate(file, 1):
            # Blanks alone at the end: an empty field behind a tab is a field.
            text = line.strip(" \r\n")
            if not text.strip() or text.startswith(COMMENTS):
                continue
            yield number, text
            count += bool(NUMBER_BEGINS.match(text))
            if count > most_rows:
                return


def _separator(line: str) -> str | None:
    """Return what separates the fields of a ``line`` of numbers; None for blanks."""
    for mark in (";", "\t"):
        if mark in line:
            return mark
    # Commas may also be those of decimals, between blanks.
    fields = line.split()
    if "," not in line or (len(fields) > 1 and all(map(WITH_DECIMAL_COMMA.fullmatch, fields))):
        return None
    return ","


def _fields(line: str, separator: str | None) -> list[str]:
    """Return the fields of a ``line``, without quotes, and without an empty one behind the last separator."""
    if separator is None:
        fields = [field.strip("\"'") for field in line.split()]
    else:
        # Quotes may enclose a separator.
        (fields,) = csv.reader([line], delimiter=separator, skipinitialspace=True)
        fields = [field.strip().strip("'") for field in fields]
    if len(fields) > 1 and not fields[-1]:
        fields.pop()
    return fields


def _with_points(fields: list[str]) -> list[str]:
    """Return ``fields`` with points in place of decimal commas."""
    return [field.replace(",", ".") for field in fields]


def _numbers(rows: list[Row]) -> np.ndarray:
    """Return the numbers (row, column) in ``rows`` of equal length; raises TableError."""
    fields = [row.fields for row in rows]
    has_point = any("." in field for row in fields for field in row)
    if not has_point:
        fields = [_with_points(row) for row in fields]
    try:
        return np.array(fields, float)
    except ValueError:
        pass

    # A field is not a number as NumPy reads it: it has a D, or is a mistake.
    values = np.empty((len(fields), len(fields[0])))
    for i, row in enumerate(fields):
        for k, field in enumerate(row):
            number = number_of(field)
            if number is None:
                what = f"line {rows[i].line}, field {k + 1}: {rows[i].fields[k]!r}"
                raise TableError(f"{what} is not a number; begin lines of text with #")
            values[i, k] = number
    return values
