"""Names of files that are not valid text, and case files that are not valid or nested too deeply."""

from __future__ import annotations

import os

TINY = """
[lattice]
preset = "diatomic"
cells = 12
[contacts]
sites = [4]
clearance = 1e-4
[drive]
cycles = 3
[time]
end = 0.02
engine = "propagator"
[output]
figures = false
[sweep.drive]
amplitude = [1.0, 2.0]
"""


def test_a_marker_that_is_no_text_is_another_case(in_process, tmp_path):
    """A folder whose case.toml is not valid text, or not TOML, is refused as that of another case until --force."""
    case = tmp_path / "tiny.toml"
    case.write_text(TINY)
    out = tmp_path / "out"
    assert in_process("run", case, "--out", out).returncode == 0
    (out / "case.toml").write_bytes(b'name = "\xff"\n')
    ended = in_process("run", case, "--out", out)
    assert ended.returncode == 2
    assert "contains another run: name = \ufffd there, tiny here" in ended.stderr
    # These bytes are not TOML.
    (out / "case.toml").write_bytes(b"\x89HDF")
    assert "its case.toml cannot be read" in in_process("run", case, "--out", out).stderr
    assert in_process("run", case, "--out", out, "--force").returncode == 0


def test_samples_in_a_folder_whose_name_is_no_text_are_refused(in_process, tmp_path):
    """Samples in a folder whose name is not valid text are refused, as no result could hold their path."""
    folder = tmp_path / os.fsdecode(b"no\xfftext")
    folder.mkdir()
    (folder / "samples.csv").write_text("0.0 0.0\n0.01 1.0\n0.02 0.0\n")
    (folder / "case.toml").write_text(f'{TINY}\n[drive.samples]\nfile = "samples.csv"\n'.replace("cycles = 3", ""))
    ended = in_process("validate", "case.toml", "--set", "drive.waveform=samples", cwd=folder)
    assert ended.returncode == 2
    assert "drive.samples.file" in ended.stderr and "Traceback" not in ended.stderr
