"""Records of the runs of a study, and the ring on which runs with one site take place."""

from types import SimpleNamespace

from mpi4py import MPI

import pytest

from vipetsc.case.law import LawCase
from vipetsc.io.records import RecordFile
from vipetsc.parallel import StopRequest
from vipetsc.sources import hash_of, source_key
from vipetsc.studies.recorded_runs import RecordedRuns, RecordPaths
from vipetsc.studies.ring import Ring


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


def test_a_key_of_two_parts_is_found_again(tmp_path):
    """JSON turns a tuple into a list; the record is still found under the tuple and not computed twice."""
    key = ("site", 1.5)
    recorded_runs(tmp_path).make([key], lambda key: {"value": 1})

    runs = recorded_runs(tmp_path).read()
    runs.make([key], lambda key: pytest.fail("it is there"))

    assert runs.records[key]["value"] == 1


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


def test_the_ring_is_endless_and_has_one_site_or_none():
    """Runs with and without a site differ in the site alone: same ring, same drive, same time."""
    table = {"lattice": {"cells": 40}, "contacts": {"sites": [9, 12], "clearance": [1e-3, 2e-3]}}
    asked = []

    def run_in_memory(case):
        asked.append(case)
        return None, None

    ring = Ring(LawCase.from_table(table), SimpleNamespace(run_in_memory=run_in_memory))
    ring.run_to_end(2.0, with_site=True)
    ring.run_at_site(1.0, with_site=False)

    setting = ring.setting
    for run in asked:
        assert run.lattice.ends == "periodic"
        assert run.lattice.cells == setting.cells > 40
        assert run.drive.cell == 1
        assert run.time.end == pytest.approx(setting.end)

    with_site, without = asked
    assert with_site.contacts.sites == [setting.site + 1]
    assert with_site.contacts.clearance == [setting.clearance]
    assert with_site.drive.amplitude == 2.0
    assert without.contacts.sites == []
    assert without.output.window == [setting.site + 1, setting.site + 1]
