"""The verb nnm as a user types it: files, exit codes, refusal, resumption."""

from __future__ import annotations

import h5py
import pytest

from tests.conftest import assert_same_bits, datasets, modified

CASE = """
[lattice]
preset = "four-band"
reading = "printed"
[contacts]
law = "bilinear"
modulus = 1e8
[nnm]
modes = [2]
energy = [0.0, 1.0]
locate_grazing = false
"""


@pytest.fixture
def case(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(CASE)
    return path


@pytest.mark.slow
@pytest.mark.usefixtures("plain_pictures")
def test_a_branch_leaves_its_files_and_its_picture_and_is_not_computed_twice(in_process, case, tmp_path):
    """The same command writes nothing or repairs a damaged file; another case replaces the branch only with --force."""
    out = tmp_path / "out"
    done = in_process("nnm", case, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "fold-energy: 2" in done.stdout
    # A table that grows with the branch goes to stderr.
    assert "Newton" in done.stderr
    names = {str(p.relative_to(out)) for p in out.rglob("*") if p.is_file()}
    assert names == {
        "case.toml",
        "branch-out-of-phase.h5",
        "branch-out-of-phase.csv",
        "figures/branch-out-of-phase.png",
    }

    written = modified(out)
    second = in_process("nnm", case, "--out", out)
    assert second.returncode == 0
    # The first call has one line more, which names the pictures that it has drawn.
    assert second.stdout == done.stdout.rpartition("  /")[0].rpartition("\n")[0] + "\n"
    assert modified(out) == written

    # The damaged file is not HDF5.
    (out / "branch-out-of-phase.h5").write_text("cut")
    assert in_process("nnm", case, "--out", out).returncode == 0
    assert modified(out).keys() == written.keys()

    shorter = ("--set", "nnm.energy=[0.0, 0.5]")
    refused = in_process("nnm", case, "--out", out, *shorter)
    assert refused.returncode == 2
    assert "--force" in refused.stderr
    assert in_process("nnm", case, "--out", out, *shorter, "--force").returncode == 0
    assert modified(out).keys() == written.keys()


def test_resumed_branch_is_the_uninterrupted_one(in_process, case, tmp_path):
    """A branch of 20 points that is resumed to 48 has the same bits as one that was followed to 48 at once."""
    whole = tmp_path / "whole"
    parts = tmp_path / "parts"
    assert in_process("nnm", case, "--out", whole, "--set", "nnm.points=48").returncode == 0
    assert in_process("nnm", case, "--out", parts, "--set", "nnm.points=20").returncode == 0
    assert in_process("nnm", case, "--out", parts, "--set", "nnm.points=48", "--resume").returncode == 0

    expected = datasets(whole / "branch-out-of-phase.h5")
    assert_same_bits(datasets(parts / "branch-out-of-phase.h5"), expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [("nnm.modes=[7]", "2 modes"), ("nnm.map=third", "nnm.map"), ("nmn.map=1", "did you mean nnm")],
)
def test_bad_cases_write_nothing(in_process, case, tmp_path, change, message):
    """A wrong key or value is refused with a hint and exit code 2, and no folder is created."""
    done = in_process("nnm", case, "--out", tmp_path / "out", "--set", change)
    assert done.returncode == 2
    assert message in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.mpirun
def test_failure_is_reported_with_its_knob(vipetsc, case, tmp_path):
    """A branch whose steps become too short ends with exit code 1 and the key to change; its points are in the file."""
    out = tmp_path / "out"

    # With this smallest step the branch cannot pass its fold.
    done = vipetsc(2, "nnm", case, "--out", out, "--set", "nnm.smallest_step=1e-3")

    assert done.returncode == 1
    assert "change nnm.smallest_step" in done.stdout
    assert len((out / "branch-out-of-phase.csv").read_text().splitlines()) > 5


def test_a_file_that_is_no_branch_is_refused(in_process, tmp_path):
    """An HDF5 file of another kind under a branch's name is refused with exit code 2 and without a traceback."""
    with h5py.File(tmp_path / "branch-x.h5", "w") as file:
        file["energy"] = [1.0]

    done = in_process("plot", tmp_path)
    assert done.returncode == 2
    assert "is not a branch" in done.stderr
    assert "Traceback" not in done.stderr


def test_branches_and_runs_never_share_a_folder(in_process, tmp_path):
    """A verb with --force replaces results of its own kind only."""
    run = tmp_path / "run"
    branches = tmp_path / "branches"
    for folder, evidence in ((run, "run.h5"), (branches, "branch-mode-1.h5")):
        folder.mkdir()
        (folder / "case.toml").write_text("")
        (folder / evidence).write_text("results")

    for arguments in (("nnm", "runs/examples/nnm-cubic.toml", "--out", run), ("run", "--out", branches)):
        ended = in_process(*arguments, "--force")
        assert ended.returncode == 2
        assert "do not belong" in ended.stderr

    assert (run / "run.h5").read_text() == "results"
    assert (branches / "branch-mode-1.h5").read_text() == "results"
