"""Records of the runs of a study, and the ring on which runs with one site take place."""

import errno
import os
import pickle
from pathlib import Path

from mpi4py import MPI

import pytest

from vipetsc.io.atomic import unwritten
from vipetsc.io.errors import is_of_file_system
from vipetsc.io.records import Record, RecordFile
from vipetsc.parallel import StopRequest
from vipetsc.sources import hash_of, source_key
from vipetsc.studies.recorded_runs import Key, RecordedRuns, RecordPaths


def recorded_runs(folder) -> RecordedRuns:
    """Return the runs recorded in a folder, by this rank alone."""
    return RecordedRuns("some-runs", folder, MPI.COMM_SELF, StopRequest())


def append(path, key, value):
    """Append the record of one run to a file."""
    file = RecordFile(path)
    file.append({"key": key, "source": source_key(), "value": value})
    file.close()


def test_a_record_of_a_rank_counts_more_than_the_merged_one(tmp_path):
    """A rank's file is newer than the merged one: its record is read, and merged when the study ends."""
    paths = RecordPaths(tmp_path, "some-runs")
    append(paths.merged, "run", 1)
    append(paths.for_rank(3), "run", 2)

    runs = recorded_runs(tmp_path).read()
    assert runs.records["run"]["value"] == 2

    runs.finish()
    assert paths.existing() == [paths.merged]
    assert recorded_runs(tmp_path).read().records["run"]["value"] == 2


def test_records_of_other_sources_are_not_continued(tmp_path):
    file = RecordFile(RecordPaths(tmp_path, "some-runs").for_rank(0))
    file.append({"key": "run", "source": f"{source_key()}0", "value": 1})
    file.close()
    assert not recorded_runs(tmp_path).read().records


@pytest.mark.parametrize(
    ("path", "counts"),
    [("constants.py", True), ("room/rule.csv", True), ("room/__pycache__/a.py", False), ("figures/style.py", False)],
)
def test_the_key_follows_from_sources_with_numbers(tmp_path, path, counts):
    """A changed or a renamed file changes the hash, unless no number follows from it."""
    (tmp_path / "constants.py").write_text("HALF = 0.5")
    file = tmp_path / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("a = 1")
    first = hash_of(tmp_path)
    assert hash_of(tmp_path) == first

    file.write_text("a = 2")
    second = hash_of(tmp_path)
    file.rename(file.with_name(f"other{file.suffix}"))
    assert len({first, second, hash_of(tmp_path)}) == (3 if counts else 1)


@pytest.mark.parametrize("number", [errno.EIO, errno.EACCES, errno.ESTALE, errno.EMFILE, errno.ENOSPC])
@pytest.mark.parametrize("message", ["", "law.h5 could not be written"])
def test_an_error_of_the_file_system_ends_all_runs_and_is_no_failure_of_one(tmp_path, number, message):
    """The error names the file, and no record counts the run as failed, also where any exception is a failure."""
    failure = OSError(number, message) if message else OSError(number, os.strerror(number), "law.h5")

    def work(key: Key) -> Record:
        raise failure

    runs = RecordedRuns("runs", tmp_path, MPI.COMM_SELF, StopRequest(), failures=(Exception,))
    with pytest.raises(OSError, match=r"^law\.h5 could not") as caught:
        runs.compute(["a"], work)
    assert message or "the same command continues" in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_a_message_about_a_file_has_no_number_also_where_another_error_quotes_it(number):
    """The text is a sentence; a copy, as other ranks get it, is the same."""
    error = pickle.loads(pickle.dumps(unwritten(Path("x.h5"), OSError(number, "bare"))))
    assert str(error).startswith("x.h5 could not be written")
    assert error.errno == number
    assert is_of_file_system(error)
    assert not is_of_file_system(FileNotFoundError(errno.ENOENT, "there is none"))
