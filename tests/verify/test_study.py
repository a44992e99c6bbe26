"""The contract of every study with one result file: it is computed once, continued, and mended where it was cut off."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import datasets, search_table
from tests.identified import identify_table, lattice_table, measured_table
from tests.one_site import law_case, prediction_case
from vipetsc.case.design import DesignCase
from vipetsc.case.identify import IdentifyCase
from vipetsc.case.optimise import OptimiseCase
from vipetsc.io.folder import FolderError
from vipetsc.paper import cell_search
from vipetsc.parallel import StoppedError, StopRequest
from vipetsc.studies import identification, one_site, optimum_search, prediction
from vipetsc.studies.study import Study

pytestmark = pytest.mark.slow


def design_case(folder: Path) -> DesignCase:
    """A search over four cells."""
    few = {"first": 0.2, "last": 0.5, "count": 2}
    return DesignCase.from_table({"design": {"lambda": few, "eta": few, "wavenumbers": 5}})


def identify_case(folder: Path) -> IdentifyCase:
    """The restitution of one lattice from a short record."""
    table = lattice_table(time={"end": 0.009})
    unknowns = [{"quantity": "restitution", "bounds": [0.2, 1.0]}]
    return IdentifyCase.from_table(identify_table(table, measured_table(folder, table, noise=0.01), unknowns=unknowns))


@dataclass(frozen=True)
class Example:
    """A study, and a small case of it, whose data are written to a folder."""

    study: Study[Any]
    case: Callable[[Path], Any]


FEW = {"points": 16, "simulate": False, "amplitudes": [5.0, 30.0]}
EXAMPLES = {
    "law": Example(one_site.STUDY, lambda folder: law_case(law={"largest": 1.2, "samples": 1, "tolerance": 0.5})),
    "predict": Example(
        prediction.STUDY,
        lambda folder: prediction_case(predict={"points": 16, "simulate": False, "amplitudes": [5.0, 30.0]}),
    ),
    "optimise": Example(
        optimum_search.STUDY, lambda folder: OptimiseCase.from_table(search_table(12, [4], optimise={"budget": 3}))
    ),
    "identify": Example(identification.STUDY, identify_case),
    "design": Example(cell_search.STUDY, design_case),
}
# A design search takes seconds, and records nothing on its way.
WITH_RECORDS = [name for name in EXAMPLES if name != "design"]


def run(name: str, tmp_path: Path, **how: Any) -> Path:
    """Run the example called ``name`` in a folder, which is returned."""
    example = EXAMPLES[name]
    example.study.run(example.case(tmp_path), tmp_path / "out", MPI.COMM_SELF, **how)
    return tmp_path / "out"


def records_in(folder: Path) -> dict[str, bytes]:
    """The contents of the files of records in ``folder``, by name."""
    return {path.name: path.read_bytes() for path in folder.glob("*.jsonl")}


def assert_same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    """Assert that two results have the same variables, to the bit."""
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_result_that_was_cut_off_is_computed_again_from_its_records(name, tmp_path, caplog):
    """A file that is shorter than it was is replaced by the same one; no run is made again, and a warning says so."""
    folder = run(name, tmp_path)
    path = folder / EXAMPLES[name].study.file
    expected = datasets(path)
    records = records_in(folder)
    assert bool(records) == (name in WITH_RECORDS)

    os.truncate(path, path.stat().st_size // 2)
    run(name, tmp_path)
    assert_same(datasets(path), expected)
    assert records_in(folder) == records
    assert "computed again" in caplog.text


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_result_that_is_there_is_kept(name, tmp_path, caplog):
    """A second call of the same case changes nothing, and --resume requires a first one."""
    with pytest.raises(FolderError):
        run(name, tmp_path, resume=True)
    folder = run(name, tmp_path)
    path = folder / EXAMPLES[name].study.file
    before = path.stat().st_mtime_ns
    run(name, tmp_path, resume=True)
    assert path.stat().st_mtime_ns == before
    assert "computed again" not in caplog.text


@pytest.mark.parametrize("name", WITH_RECORDS)
def test_a_study_that_is_stopped_leaves_no_result_and_goes_on(name, tmp_path):
    """A request to stop ends a study without its file; the next call writes it."""
    stop = StopRequest()
    stop.requested = True
    with pytest.raises(StoppedError):
        run(name, tmp_path, stop=stop)
    assert not (tmp_path / "out" / EXAMPLES[name].study.file).exists()
    run(name, tmp_path)
    assert (tmp_path / "out" / EXAMPLES[name].study.file).exists()
