"""Records come back as they were written; a line that was cut off or damaged is named and costs no other."""

import os
import resource

import pytest

from tests.faults.inject import Injector
from vipetsc.io.records import RecordFile, merge_records, read_records

ROWS = [{"id": f"m{i}", "values": [0.1 * i, 1e-300, float(i)]} for i in range(5)]


def put(path, rows):
    file = RecordFile(path)
    for row in rows:
        file.append(row)
    file.close()


def read(path):
    damaged: list[str] = []
    return [record for record, _ in read_records(path, damaged.append)], damaged


def test_what_is_appended_comes_back_by_line_and_alone(tmp_path):
    path = tmp_path / "a.jsonl"
    put(path, ROWS[:2])
    put(path, ROWS[2:])
    assert read(path) == (ROWS, [])
    assert [line.record() for _, line in read_records(path, print)] == ROWS


@pytest.mark.parametrize("cut", [2, 30])
def test_a_line_that_was_cut_off_costs_no_other(tmp_path, cut):
    path = tmp_path / "a.jsonl"
    put(path, ROWS[:3])
    os.truncate(path, path.stat().st_size - cut)
    assert read(path)[0] == ROWS[:2] and len(read(path)[1]) == 1
    put(path, ROWS[3:])
    rows, damaged = read(path)
    assert rows == [*ROWS[:2], *ROWS[3:]]
    assert damaged == [f"{path}, line 3: cut off or damaged; what it told is made again"]


def test_a_damaged_line_is_left_out(tmp_path):
    path = tmp_path / "a.jsonl"
    put(path, ROWS)
    path.write_bytes(path.read_bytes().replace(b"m3", b"m9"))
    rows, damaged = read(path)
    assert rows == [*ROWS[:3], ROWS[4]] and "line 4" in damaged[0]


def test_lines_are_merged_in_their_order(tmp_path):
    parts = [tmp_path / "b.jsonl", tmp_path / "a.jsonl"]
    put(parts[0], ROWS[:3])
    put(parts[1], ROWS[3:])
    lines = [line for path in parts for _, line in read_records(path, print)]
    merge_records(tmp_path / "all.jsonl", lines[::-1], parts)
    assert read(tmp_path / "all.jsonl") == (ROWS[::-1], []) and not any(path.exists() for path in parts)


def test_a_full_disk_names_the_file(tmp_path):
    injector = Injector()
    injector.arm("append", 2, "full-disk")
    with pytest.raises(OSError, match=r"a\.jsonl could not be written: No space left"):
        put(tmp_path / "a.jsonl", ROWS)
    injector.disarm()
    assert read(tmp_path / "a.jsonl") == (ROWS[:1], [])


def test_a_disk_that_takes_a_part_of_a_line_is_full(tmp_path):
    path = tmp_path / "a.jsonl"
    put(path, ROWS[:1])
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 10, limits[1]))
    try:
        with pytest.raises(OSError, match=r"a\.jsonl could not be written: File too large"):
            put(path, ROWS[1:2])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert read(path)[0] == ROWS[:1] and len(read(path)[1]) == 1
    put(path, ROWS[1:])
    assert read(path)[0] == ROWS
