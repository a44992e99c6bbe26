"""The verb nnm as a user types it: files, exit codes, refusal, resumption."""

from __future__ import annotations

import pytest

FOLDED = """
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
    path.write_text(FOLDED)
    return path


@pytest.mark.slow
@pytest.mark.usefixtures("plain_pictures")
def test_a_branch_leaves_its_files_and_its_picture(in_process, case, tmp_path):
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
