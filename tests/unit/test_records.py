"""Records are read back as they were written; a truncated or damaged line is named and does not affect others."""

import os
import resource

import pytest

from vipetsc.io.records import RecordFile, merge_records, read_records

# Numbers without a short decimal form, and close to the smallest float, are read back to the bit.
ROWS = [{"id": f"m{i}", "values": [0.1 * i, 1e-300, float(i)]} for i in range(5)]


def append_all(path, rows):
    """Open a file of records, append rows to it, and close it."""
    file = RecordFile(path)
    for row in rows:
        file.append(row)
    file.close()


def read_all(path):
    """Return the records of a file and the messages about damaged lines."""
    damaged: list[str] = []
    return [record for record, _ in read_records(path, damaged.append)], damaged


def test_what_is_appended_comes_back_by_line_and_alone(tmp_path):
    """Records of two sessions are read in their order, and a line can be read alone later."""
    path = tmp_path / "a.jsonl"
    append_all(path, ROWS[:2])
    append_all(path, ROWS[2:])

    assert read_all(path) == (ROWS, [])
    assert [line.record() for _, line in read_records(path, print)] == ROWS


# The cuts in bytes remove the end of the last line, or a part of its checksum as well.
@pytest.mark.parametrize("cut", [2, 30])
def test_a_line_that_was_cut_off_costs_no_other(tmp_path, cut):
    """The line that a kill cut off is left out; records appended after it are whole."""
    path = tmp_path / "a.jsonl"
    append_all(path, ROWS[:3])
    os.truncate(path, path.stat().st_size - cut)

    rows, damaged = read_all(path)
    assert rows == ROWS[:2]
    assert len(damaged) == 1

    append_all(path, ROWS[3:])
    rows, damaged = read_all(path)
    assert rows == [*ROWS[:2], *ROWS[3:]]
    assert damaged == [f"{path}, line 3: truncated or damaged; its results are computed again"]


def test_lines_are_merged_in_their_order(tmp_path):
    """Merged lines stand in the order that is given, and the files they came from are removed."""
    parts = [tmp_path / "b.jsonl", tmp_path / "a.jsonl"]
    append_all(parts[0], ROWS[:3])
    append_all(parts[1], ROWS[3:])
    lines = [line for path in parts for _, line in read_records(path, print)]

    merge_records(tmp_path / "all.jsonl", lines[::-1], parts)

    assert read_all(tmp_path / "all.jsonl") == (ROWS[::-1], [])
    assert not any(path.exists() for path in parts)


def test_a_disk_that_takes_a_part_of_a_line_is_full(tmp_path):
    """A line of which the disk took ten bytes is not read, and the next append begins a new line."""
    path = tmp_path / "a.jsonl"
    append_all(path, ROWS[:1])
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 10, hard))
    try:
        with pytest.raises(OSError, match=r"a\.jsonl could not be written: File too large"):
            append_all(path, ROWS[1:2])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    rows, damaged = read_all(path)
    assert rows == ROWS[:1]
    assert len(damaged) == 1
    append_all(path, ROWS[1:])
    assert read_all(path)[0] == ROWS
