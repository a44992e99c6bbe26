"""Files of results in whose place another program's lie: a sentence and exit code 2."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.faults.scenarios import SCENARIOS, prepare, words_of

CONTENTS: dict[str, Any] = {
    "numbers": np.arange(3),
    "link to itself": h5py.SoftLink("/a"),
    "link to nowhere": h5py.SoftLink("/b"),
    "empty": h5py.Empty("f8"),
    "type": np.dtype("f8"),
    "records": np.zeros(3, [("x", "f8"), ("n", "i4")]),
}


def put_foreign(path: Path, contents: str) -> None:
    """Write an HDF5 file that holds ``contents`` under the name a, and nothing else."""
    path.parent.mkdir(exist_ok=True)
    with h5py.File(path, "w") as file:
        file["a"] = CONTENTS[contents]


@pytest.mark.parametrize("contents", CONTENTS)
@pytest.mark.parametrize("name", ["run", "optimum", "branch-r1", "law", "prediction", "design", "ensemble", "analysis"])
def test_pictures_of_a_foreign_file_are_refused(in_process, tmp_path, name, contents):
    put_foreign(tmp_path / "out" / f"{name}.h5", contents)
    ended = in_process("plot", tmp_path / "out")
    assert ended.returncode == 2
    assert "of vipetsc" in ended.stderr or "cannot be opened" in ended.stderr or "holds no run.h5" in ended.stderr
    exported = in_process("export", tmp_path / "out")
    assert exported.returncode in (0, 2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "name"), [("design", "design.h5"), ("nfrc", "branch-*.h5"), ("optimise", "optimum.h5"), ("law", "law.h5")]
)
def test_a_command_does_not_go_on_with_a_foreign_file(in_process, tmp_path, verb, name):
    scenario = SCENARIOS[verb]
    case = prepare(scenario, tmp_path)
    out = tmp_path / "out"
    words = words_of(scenario.words, case, out)
    assert in_process(*words).returncode == 0
    (path,) = sorted(out.glob(name))[:1]
    for contents in CONTENTS:
        path.unlink()
        put_foreign(path, contents)
        ended = in_process(*words)
        assert path.name in ended.stderr
        # A file that was cut off is made again where that takes no more than what is asked for.
        assert ("made again" if ended.returncode == 0 else "--force begins anew") in ended.stderr
        assert ended.returncode in (0, 2), contents
    assert in_process(*words, "--force").returncode == 0
