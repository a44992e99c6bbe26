"""The verb nfrc as a user types it: a curve whose continuation fails."""

from __future__ import annotations

import pytest

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

pytestmark = [pytest.mark.parallel(1), pytest.mark.usefixtures("plain_pictures")]


# A curve is named by its restitution and by the quantity that is fixed along it, here the frequency in rad/s.
STEM = "branch-r1-1023.27"


@pytest.fixture
def case(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(CASE)
    return path


def test_a_curve_that_cannot_go_on_keeps_its_points(in_process, case, tmp_path):
    """A smallest step that is too long for a fold ends the curve with exit code 1; its points and picture remain."""
    out = tmp_path / "stuck"

    ended = in_process("nfrc", case, "--out", out, "--set", "nfrc.smallest_step=0.005")

    assert ended.returncode == 1
    assert "last good point" in ended.stderr
    assert "nfrc.smallest_step" in ended.stderr
    assert "approach_floor" not in ended.stderr
    assert (out / f"{STEM}.h5").exists()
    assert (out / "figures" / f"{STEM}.png").exists()
