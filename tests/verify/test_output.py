"""Results of runs in a folder or in memory, in chunks of any length, and after writing has failed."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.conftest import StopAt, assert_same_bits, datasets, small_case
from vipetsc.dynamics import recorded_sizes, simulate
from vipetsc.io import chunks
from vipetsc.io.netcdf import open_netcdf, write_netcdf
from vipetsc.io.store import RunMemory

PART = {"output": {"window": [3, 17], "every": 4, "stride": 5}}


@pytest.mark.parametrize("sections", [{}, PART, {"output": {"fields": []}}])
def test_the_length_of_a_chunk_does_not_show(folder, monkeypatch, sections):
    """A run has the same bits with chunks of any length."""
    case = small_case(**sections, time={"end": 0.04})
    simulate(case, folder / "long")

    # Seven divides neither the number of samples nor the strides.
    monkeypatch.setattr(recorded_sizes, "CHUNK_SAMPLES", 7)
    simulate(case, folder / "short")

    assert_same_bits(datasets(folder / "long" / "run.h5"), datasets(folder / "short" / "run.h5"))


@pytest.mark.parametrize("sections", [{}, PART, {"contacts": {"sites": []}}])
def test_a_run_in_memory_is_the_run_of_the_file(folder, sections):
    case = small_case(**sections, time={"end": 0.04})
    result = simulate(case, folder / "run")
    memory = RunMemory()
    assert simulate(case, memory).folder is None
    assert memory.dataset is not None

    # Only a dataset in memory has the state at the end, with all cells.
    held = memory.dataset.drop_vars(["end/displacement", "end/velocity"])
    with open_netcdf(folder / "run" / "run.h5", "run") as run:
        assert held.variables.keys() == run.variables.keys()
        for name, item in run.variables.items():
            assert memory.dataset[name].dims == item.dims, name
            assert memory.dataset[name].attrs == item.attrs, name
            assert memory.dataset[name].values.tobytes() == item.values.tobytes(), name
        assert memory.dataset.attrs.keys() == run.attrs.keys()
        assert json.loads(run.attrs["statistics"]) == result.statistics
    write_netcdf(folder / "saved.h5", held)

    assert_same_bits(datasets(folder / "run" / "run.h5"), datasets(folder / "saved.h5"))


def test_what_cannot_be_put_together_leaves_the_old_file_and_all_chunks(folder, monkeypatch):
    """A full disk at the end of a run leaves the old file and all chunks, from which the run can be completed."""
    path = folder / "run"
    simulate(small_case(time={"end": 0.01}), path)
    before = (path / "run.h5").read_bytes()
    case = small_case(time={"end": 0.02})

    def full_disk(fields, *_):
        fields["velocity"][0] = 1.0
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(chunks, "put_chunks", full_disk)
    monkeypatch.setattr(recorded_sizes, "CHUNK_SAMPLES", 16)
    with pytest.raises(OSError, match=r"run\.h5 could not be written: No space"):
        simulate(case, path, force=True)
    assert (path.with_name("run.old") / "run.h5").read_bytes() == before
    assert {p.name for p in path.iterdir()} == {"case.toml", "parts"}

    monkeypatch.undo()
    assert simulate(case, path, resume=True).complete

    simulate(case, folder / "straight")
    assert_same_bits(datasets(folder / "straight" / "run.h5"), datasets(path / "run.h5"))


def test_chunks_of_other_sources_are_not_continued(folder, monkeypatch):
    """A run that other sources of the program have begun begins again, and its checkpoints are not read."""
    monkeypatch.setattr(recorded_sizes, "CHUNK_SAMPLES", 16)
    case = small_case(time={"end": 0.02})
    assert simulate(case, folder / "run", stop=StopAt(120)).resumable
    parts = folder / "run" / "parts"
    assert any(parts.glob("state-*"))
    for path in parts.iterdir():
        path.write_text("of other sources")

    assert simulate(case, folder / "run").complete
    simulate(case, folder / "straight")
    assert_same_bits(datasets(folder / "straight" / "run.h5"), datasets(folder / "run" / "run.h5"))


def test_contacts_that_still_last_at_the_end_are_logged(folder):
    """A run that ends within a contact logs it, without a separation."""
    simulate(small_case(), folder / "whole")
    whole = datasets(folder / "whole" / "run.h5")
    onset = whole["impacts/onset"]
    separation = whole["impacts/separation"]

    # The run ends at the first sample that lies in a contact.
    interval = small_case().model().sample_interval
    holds_a_sample = np.floor(separation / interval) > np.ceil(onset / interval)
    end = float(np.ceil(onset[holds_a_sample][0] / interval) * interval)
    result = simulate(small_case(time={"end": end}), folder / "cut")

    cut = datasets(folder / "cut" / "run.h5")
    expected = onset <= end
    assert cut["impacts/onset"].tolist() == onset[expected].tolist()
    assert np.isnan(cut["impacts/separation"]).tolist() == (separation[expected] > end).tolist()
    assert np.isnan(cut["impacts/separation"]).any()
    assert result.statistics["episodes"] == expected.sum()
