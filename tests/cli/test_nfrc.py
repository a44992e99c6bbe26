"""The verb nfrc as a user types it: files, exit codes, refusal, a curve that cannot go on."""

from __future__ import annotations

import pytest

from tests.conftest import modified

CASE = """
[lattice]
preset = "four-band"
[contacts]
sites = [100]
clearance = 1.8e-3
restitution = 1.0
[nfrc]
range = [0.97, 1.01]
harmonics = 5
"""

pytestmark = pytest.mark.parallel(1)


def test_files_picture_refusal_and_a_curve_that_cannot_go_on(in_process, tmp_path):
    case, out = tmp_path / "small.toml", tmp_path / "out"
    case.write_text(CASE)
    done = in_process("nfrc", case, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "folds              1.00" in done.stdout and "reached the end of nfrc.range" in done.stdout
    names = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    stem = "branch-r1-1023.27"
    assert names == {"case.toml", f"{stem}.h5", f"{stem}.csv", f"figures/{stem}.png"}
    header = (out / f"{stem}.csv").read_text().splitlines()[0].split(",")
    assert header[:3] == ["frequency", "amplitude", "largest"] and header[-1] == "kind"
    written = modified(out)
    assert in_process("nfrc", case, "--out", out).returncode == 0
    assert modified(out) == written  # complete: nothing is made again
    assert in_process("plot", out).returncode == 0
    other = in_process("nfrc", case, "--out", out, "--set", "nfrc.harmonics=7")
    assert other.returncode == 2 and "--force" in other.stderr
    bad = in_process("nfrc", case, "--out", tmp_path / "none", "--set", "nfrc.range=[2.0, 1.0]")
    assert bad.returncode == 2 and "nfrc.range" in bad.stderr and not (tmp_path / "none").exists()
    stuck = in_process("nfrc", case, "--out", tmp_path / "stuck", "--set", "nfrc.smallest_step=0.005")
    assert stuck.returncode == 1
    assert "last good point" in stuck.stderr and "nfrc.smallest_step" in stuck.stderr
    assert (tmp_path / "stuck" / f"{stem}.h5").exists() and (tmp_path / "stuck/figures" / f"{stem}.png").exists()
