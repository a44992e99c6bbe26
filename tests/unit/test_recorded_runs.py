"""Records of the runs of a study, and the ring on which runs with one site take place."""

from types import SimpleNamespace

from mpi4py import MPI

import pytest

import vipetsc
from vipetsc.case.law import LawCase
from vipetsc.io.records import RecordFile
from vipetsc.parallel import StopRequest
from vipetsc.studies.recorded_runs import RecordedRuns, RecordPaths
from vipetsc.studies.ring import Ring


def recorded_runs(folder) -> RecordedRuns:
    """Return the runs recorded in a folder, by this rank alone."""
    return RecordedRuns("some-runs", folder, MPI.COMM_SELF, StopRequest())


def append(path, key, value):
    """Append the record of one run to a file."""
    file = RecordFile(path)
    file.append({"key": key, "vipetsc_version": vipetsc.__version__, "value": value})
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
