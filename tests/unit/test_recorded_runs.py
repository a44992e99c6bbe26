"""Records of runs, by whatever study, and the ring on which one site is run."""

from types import SimpleNamespace

from mpi4py import MPI

import pytest

import vipetsc
from vipetsc.case.law import LawCase
from vipetsc.io.records import RecordFile
from vipetsc.parallel import StopRequest
from vipetsc.studies.recorded_runs import RecordedRuns, RecordPaths
from vipetsc.studies.ring import Ring


def recorded(folder) -> RecordedRuns:
    return RecordedRuns("some-runs", folder, MPI.COMM_SELF, StopRequest())


def append(path, key, value):
    file = RecordFile(path)
    file.append({"key": key, "vipetsc_version": vipetsc.__version__, "value": value})
    file.close()


def test_a_record_of_a_rank_counts_more_than_the_merged_one(tmp_path):
    paths = RecordPaths(tmp_path, "some-runs")
    append(paths.merged, "run", 1)
    append(paths.for_rank(3), "run", 2)
    runs = recorded(tmp_path).read()
    assert runs.records["run"]["value"] == 2
    runs.finish()
    assert paths.existing() == [paths.merged]
    assert recorded(tmp_path).read().records["run"]["value"] == 2


def test_a_key_of_two_parts_is_found_again(tmp_path):
    recorded(tmp_path).make([("site", 1.5)], lambda key: {"value": 1})
    runs = recorded(tmp_path).read()
    runs.make([("site", 1.5)], lambda key: pytest.fail("it is there"))
    assert runs.records["site", 1.5]["value"] == 1


def test_the_ring_is_endless_and_has_one_site_or_none():
    case = LawCase.from_table({"lattice": {"cells": 40}, "contacts": {"sites": [9, 12], "clearance": [1e-3, 2e-3]}})
    asked = []
    ring = Ring(case, SimpleNamespace(run_in_memory=lambda case: (asked.append(case), None)))
    ring.run_to_end(2.0, with_site=True)
    ring.run_at_site(1.0, with_site=False)
    touched, untouched = asked
    for run in asked:
        assert run.lattice.ends == "periodic" and run.lattice.cells == ring.setting.cells > 40
        assert run.drive.cell == 1 and run.time.end == pytest.approx(ring.setting.end)
    assert touched.contacts.sites == [ring.setting.site + 1]
    assert touched.contacts.clearance == [ring.setting.clearance] and touched.drive.amplitude == 2.0
    assert untouched.contacts.sites == [] and untouched.output.window == [ring.setting.site + 1] * 2
