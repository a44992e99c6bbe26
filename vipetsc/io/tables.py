"""Tables of text, as loggers, oscilloscopes and spreadsheets write them.

Columns are separated by semicolons, tabs, commas or blanks; fields may be quoted, and rows may end with a separator.
Decimals have points, or commas where no field has a point; exponents are written with E or, as in Fortran, with D.
Lines that begin with # or % are comments. Before the numbers there may be lines of text, such as names and units; names
may also stand in the last comment above the numbers.
``read_columns`` takes single columns from such a table, or from datasets of an HDF5 file.
"""

import csv
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import h5py

MARKS = "#%"
COMMENTS = (*MARKS,)
NUMBER_BEGINS = re.compile(r"""["']?([-+.\d]|nan|inf)""", re.IGNORECASE)
WITH_DECIMAL_COMMA = re.compile(r"[-+]?\d+(,\d+)?([eEdD][-+]?\d+)?")


# Lines of a table of text. Fields are split in Python: a million lines of two columns take 1.6 s and 300 MB.
MOST_ROWS = 1_000_000
MOST_NUMBERS = 100_000_000  # of a dataset: 0.8 GB
HDF5 = (".h5", ".hdf5", ".nc")


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
    read = _lines(path, most_rows)
    lines = [(line, text) for line, text in read if not text.startswith(COMMENTS)]
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
    if not names:
        comments = [text.lstrip(MARKS).strip() for line, text in read if line < rows[0].line]
        names = _commented_names([_fields(text, separator) for text in comments], width)
    return TextTable(names, _numbers(rows))


def _commented_names(comments: list[list[str]], width: int) -> list[str]:
    """Return the last of the ``comments``, as fields, that is text in ``width`` fields, as NumPy writes names."""
    names: list[str] = []
    for fields in comments:
        if len(fields) == width and not any(map(is_number, _with_points(fields))):
            names = fields
    return names


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
    """Return the lines of a file that are not empty, each with its number; of a long file the first.

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
            if not text.strip():
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


class ColumnError(ValueError):
    """A file whose columns cannot be read: the ``key`` and the ``place`` of a column, or none, and the ``remedy``."""

    def __init__(self, remedy: str, key: str = "", place: int | str = "") -> None:
        super().__init__(remedy)
        self.remedy = remedy
        self.key = key
        self.place = place


def read_columns(path: Path, places: Mapping[str, int | str], most_rows: int = MOST_ROWS) -> dict[str, np.ndarray]:
    """Return the columns (row,) of a table of text or an HDF5 file at their ``places``, by the same keys.

    A place is the number of a column, from 1, or its name; of HDF5 it is a dataset of one dimension, or with "[3]"
    behind its name the third column of one of two. Raises ColumnError.
    """
    if not is_hdf5(path):
        try:
            table = read_table(path, most_rows)
        except (OSError, TableError) as error:
            raise ColumnError(str(error)) from None
        return {key: table.values[:, _index_of(place, table, key)] for key, place in places.items()}

    import h5py

    columns = {}
    try:
        with h5py.File(path) as file:
            for key, place in places.items():
                columns[key] = _hdf5_column(file, key, place)
    except (OSError, TypeError) as error:
        raise ColumnError(f"is not an HDF5 file of numbers ({error})") from None
    return columns


def is_hdf5(path: Path) -> bool:
    """Return whether the file at ``path`` is HDF5, by its name or its content."""
    import h5py

    return path.suffix.lower() in HDF5 or h5py.is_hdf5(path)


def column_names(path: Path, most_rows: int = MOST_ROWS) -> list[str]:
    """Return the names of the columns of a table of text, [] where it has none, or of an HDF5 file's datasets.

    Those of one dimension count, in their order. Raises ColumnError.
    """
    import h5py

    try:
        if not is_hdf5(path):
            return read_table(path, most_rows).names
        names: list[str] = []
        with h5py.File(path) as file:
            file.visititems(
                lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) and item.ndim == 1 else None
            )
        return names
    except (OSError, TableError) as error:
        raise ColumnError(str(error)) from None


def _index_of(place: int | str, table: TextTable, key: str) -> int:
    """Return the column, from 0, of a ``place`` in a ``table``; raises ColumnError where there is none."""
    if isinstance(place, int):
        if 1 <= place <= table.values.shape[1]:
            return place - 1
        raise ColumnError(f"the table has the columns 1 to {table.values.shape[1]}", key, place)
    if place in table.names:
        return table.names.index(place)
    remedy = f"there are {', '.join(table.names)}"
    if not table.names:
        remedy = f"the table has no line of {table.values.shape[1]} names; give a number from 1"
    raise ColumnError(f"no column of that name; {remedy}", key, place)


def _hdf5_column(file: "h5py.File", key: str, place: int | str) -> np.ndarray:
    """Return the numbers at a ``place``: a dataset of one dimension, or, with "[3]" behind it, a column of two."""
    name = str(place)
    column: int | None = None
    match = re.fullmatch(r"(.+?)\[(\d+)\]", name)
    if match:
        name = match[1]
        column = int(match[2])
    dimensions = 1 + (column is not None)

    import h5py

    dataset = file.get(name)
    if not isinstance(dataset, h5py.Dataset):
        raise ColumnError(f"the file has no dataset {name}", key, place)
    if dataset.dtype.kind not in "biuf":
        raise ColumnError(f"the dataset {name} is not one of real numbers", key, place)
    if dataset.size > MOST_NUMBERS:
        remedy = f"the dataset has {dataset.size} numbers; at most {MOST_NUMBERS} are possible"
        raise ColumnError(remedy, key, place)
    if dataset.ndim != dimensions:
        shape = " x ".join(map(str, dataset.shape))
        remedy = f'is an array of {shape}; write "{name}[1]" for the first column of two dimensions'
        raise ColumnError(remedy, key, place)
    if column is None:
        return np.asarray(dataset[:], float)
    if not 1 <= column <= dataset.shape[1]:
        raise ColumnError(f"the dataset has the columns 1 to {dataset.shape[1]}", key, place)
    return np.asarray(dataset[:, column - 1], float)
