"""Pictures of sweeps as a user asks for them: pages of measures, reasons why some are not drawn, exit codes."""

from pathlib import Path

import pytest

from tests.conftest import set_words
from vipetsc.cli.main import main

pytestmark = pytest.mark.usefixtures("plain_pictures")

LATTICE = """
[lattice]
cells = 24
[lattice.cell]
masses = [0.010, 0.004, 0.002]
springs = [
    { start = 1, end = 1, stiffness = 2.0e4, next_cell = true },
    { start = 1, end = 2, stiffness = 6.0e3 },
    { start = 2, end = 3, stiffness = 1.0e3 },
]
contact = [2, 3]
[contacts]
modulus = 1.0e8
radius = 0.005
poisson = 0.3
sites = [8, 12]
clearance = 1.0e-3
"""
BURST = """
[drive]
amplitude = 12.0
cycles = 4
band = 2
at = "max-group-velocity"
[time]
end = 0.05
rtol = 1e-6
[sweep]
measures = ["transfer"]
[sweep.contacts]
clearance = [5e-4, 1e-3, 2e-3]
restitution = [0.3, 0.6, 0.9]
"""
# The pages that a sweep with the measure transfer has by default.
PAGES = ("bands_share", "contact_episodes", "dissipated_fraction", "ibtet", "largest_force", "upper_share_at_end")


def sweep(folder: Path, case: str, *changes: str) -> Path:
    """Simulate a sweep of ``case`` with ``changes``, without pictures; returns the folder of its results."""
    path = folder / "case.toml"
    path.write_text(LATTICE + case)
    out = folder / "out"
    assert main(["sweep", str(path), "--out", str(out), "--quiet", *set_words("output.figures=false", *changes)]) == 0
    return out


@pytest.fixture(scope="module")
def burst(tmp_path_factory) -> Path:
    """The results of a sweep over three clearances and three restitutions."""
    return sweep(tmp_path_factory.mktemp("burst"), BURST)


def drawn(folder: Path) -> set[str]:
    """Return the names of the pictures in a folder, and remove the pictures."""
    paths = list((folder / "figures").glob("*"))
    names = {path.name for path in paths}
    for path in paths:
        # The next test of the same sweep must see only its own pictures.
        path.unlink()
    return names


def test_every_measure_has_a_page_over_the_keys_that_vary(burst):
    """``plot`` draws the default pages, each named by its measure and by the keys that vary."""
    assert main(["plot", str(burst)]) == 0
    keys = "contacts.clearance-contacts.restitution"
    # The bands' parts of the energy also vary with the band, which is then part of the name.
    assert drawn(burst) == {f"{name}-over-{keys}{'-band' * (name == 'bands_share')}.png" for name in PAGES}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("transfer", "--fig transfer: needs members with their fields ([sweep] fields = true)"),
        ("ibtet_backbone", "--fig ibtet_backbone: needs branches of the same law"),
        ("entropy", "no figure 'entropy' of a sweep"),
    ],
)
def test_a_figure_that_cannot_be_drawn_is_refused(burst, name, message, capsys):
    """A figure whose data the sweep lacks, or an unknown one, is refused with the reason, and nothing is drawn."""
    assert main(["plot", str(burst), "--fig", name]) == 2
    assert message in capsys.readouterr().err
    assert drawn(burst) == set()


def test_what_is_zero_for_every_member_is_said_and_drawn_on_request(tmp_path, capsys):
    """A measure that is zero for every member is named instead of drawn; ``--fig`` draws it nevertheless."""
    # With clearances of metres there are no contacts.
    out = sweep(tmp_path, BURST, "sweep.contacts.clearance=[1.0, 2.0, 3.0]")
    assert main(["plot", str(out)]) == 0
    assert (
        "no picture of contact_episodes, dissipated_fraction, largest_force: 0 for every member"
        in capsys.readouterr().err
    )
    assert main(["plot", str(out), "--fig", "contact_episodes"]) == 0
    assert "contact_episodes-over-contacts.clearance-contacts.restitution.png" in drawn(out)
