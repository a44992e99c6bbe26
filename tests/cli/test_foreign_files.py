"""Files of other programs in the place of results are refused with a sentence and exit code 2."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.faults.scenarios import PLAIN, SCENARIOS, prepare, words_of
from vipetsc.cli.verbs.verb_list import VERBS
from vipetsc.io.errors import ResultFileError, UnreadableFileError

CONTENTS: dict[str, Any] = {"numbers": np.arange(3), "link to itself": h5py.SoftLink("/a"), "type": np.dtype("f8")}


def put_foreign(path: Path, contents: str) -> None:
    """Write an HDF5 file that holds ``contents`` under the name a, and nothing else."""
    path.parent.mkdir(exist_ok=True)
    with h5py.File(path, "w") as file:
        file["a"] = CONTENTS[contents]


@pytest.mark.parametrize("contents", CONTENTS)
@pytest.mark.parametrize("name", ["run", "optimum", "branch-r1", "law", "prediction", "design", "ensemble", "analysis"])
def test_pictures_of_a_foreign_file_are_refused(in_process, tmp_path, name, contents):
    """``plot`` and ``export`` refuse an HDF5 file of another program under a name of results, and write nothing."""
    put_foreign(tmp_path / "out" / f"{name}.h5", contents)
    ended = in_process("plot", tmp_path / "out")
    assert ended.returncode == 2
    assert "of vipetsc" in ended.stderr or "cannot be opened" in ended.stderr or "contains no run.h5" in ended.stderr
    # Files of searches, laws and predictions are called what they are.
    if name in ("optimum", "law", "prediction", "design"):
        assert f"a {name}" in ended.stderr
    exported = in_process("export", tmp_path / "out")
    assert exported.returncode == 2
    assert "of vipetsc" in exported.stderr or "cannot be opened" in exported.stderr
    assert not (tmp_path / "out" / "curves").exists()


def test_a_study_in_whose_place_a_foreign_file_lies_is_refused_or_computed_again(in_process, tmp_path):
    """A study replaces what is no HDF5 file in its own folder, and says so; it does not replace another program's."""
    name = "design"
    scenario = SCENARIOS[name]
    out = tmp_path / "out"
    words = words_of(f"{scenario.words} {PLAIN}", prepare(scenario, tmp_path), out)
    assert in_process(*words).returncode == 0

    (out / f"{name}.h5").write_text("no HDF5")
    ended = in_process(*words)
    assert ended.returncode == 0
    assert f"{name}.h5" in ended.stderr
    assert "computed again" in ended.stderr

    for contents in ("numbers", "link to itself"):
        put_foreign(out / f"{name}.h5", contents)
        ended = in_process(*words)
        assert ended.returncode == 2, contents
        assert f"{name}.h5" in ended.stderr
        assert "--force" in ended.stderr


@pytest.mark.parametrize("kind", [ResultFileError, UnreadableFileError])
def test_a_study_that_cannot_read_earlier_results_says_what_to_do(in_process, monkeypatch, tmp_path, kind):
    """An error of reading earlier results ends with exit code 2 and names --force as the remedy."""

    def study(case: object, work: object) -> None:
        raise kind("law.h5 is of another program")

    monkeypatch.setitem(VERBS, "law", replace(VERBS["law"], study=study))
    case = prepare(SCENARIOS["law"], tmp_path)
    ended = in_process("law", case, "--out", tmp_path / "out")
    assert ended.returncode == 2
    assert ended.stderr.endswith("law.h5 is of another program; move it away, or start again with --force\n")
