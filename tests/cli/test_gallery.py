"""The gallery: each study has a page, whose commands name existing cases; some of them are run at a small size."""

import re
import shutil
import sys

import pytest
from PIL import Image

import vipetsc
from tests.cli.test_guide import ROOT
from tests.conftest import set_words
from vipetsc.case.verb_cases import load_every
from vipetsc.cli.main import main

sys.path.insert(0, str(ROOT / "scripts"))
import gallery

# Bytes of all pictures together: every clone of the repository contains them.
MOST_PNG = 1_000_000
PAGES = gallery.pages()
SMALL = {
    "run": ["time.end=0.01", "time.sample_interval=0.0005", "time.engine=propagator", "output.figures=false"],
    "nnm": ["nnm.points=2", "nnm.start_frequency=[1420.0]", "nnm.orbits_at=[]"],
}
SETS = {verb: set_words(*changes) for verb, changes in SMALL.items()}


def test_every_study_has_a_page_a_command_and_small_pictures():
    """Each page has commands and pictures of limited size, and every case and picture is on a page."""
    assert 6 <= len(PAGES) <= 14
    assert set(PAGES.values()) == set(gallery.INDEX.with_suffix("").glob("*.md"))

    shown = {name: gallery.pictures(page) for name, page in PAGES.items()}
    assert all(map(gallery.commands, PAGES.values()))
    assert all(shown.values())
    every = {path for paths in shown.values() for path in paths}
    assert all(path.stat().st_size <= gallery.MOST[path.suffix] for path in every)
    assert sum(path.stat().st_size for path in every if path.suffix == ".png") <= MOST_PNG
    assert set((ROOT / "runs/gallery").iterdir()) == every

    named = set()
    for page in PAGES.values():
        named.update(re.findall(r"runs/examples/gallery/([\w-]+)\.toml", page.read_text()))
    assert {path.stem for path in (ROOT / "vipetsc/examples/gallery").glob("*.toml")} == named


def test_every_case_is_valid_and_some_run_in_small(tmp_path, monkeypatch):
    """Every case in a page's commands is valid; some runs and branches are computed, shortened, in the pages' order."""
    shutil.copytree(ROOT / "runs", tmp_path / "runs", ignore=shutil.ignore_patterns("*.h5", "*.png"))
    monkeypatch.chdir(tmp_path)
    # The order of the pages matters: the run of a breather begins with an orbit of the branch before it.
    commands = [words for page in PAGES.values() for words in gallery.commands(page)]
    for command in commands:
        begin = command.index("python")
        assert command[:begin] in ([], ["mpirun", "-n", "2"])
        assert command[begin : begin + 3] == ["python", "-m", vipetsc.__name__]

        verb, case, *options = command[begin + 3 :]
        if verb in SMALL and any(name in case for name in ("runs/examples/breather.toml", "breather-run", "gate.toml")):
            # The short branch lacks the orbit that the case names: the run begins with its first one.
            first = set_words("initial.orbit=1") if "breather-run" in case else []
            assert main([verb, case, *options, *SETS[verb], *first, "--quiet"]) == 0, command
        elif verb != "plot":
            changes = [options[i + 1] for i, word in enumerate(options) if word == "--set"]
            assert load_every(case, changes), command


@pytest.mark.parametrize(("width", "size"), [(300, (300, 200)), (1800, (900, 100))])
def test_a_picture_is_scaled_down(width, size, tmp_path):
    """A picture is scaled to a width of 900 pixels at most, and refused if its file is still too large."""
    Image.effect_noise((width, 200), 5).convert("RGB").save(tmp_path / "a.png")
    gallery.make_small(tmp_path / "a.png", tmp_path / "b.png")
    assert Image.open(tmp_path / "b.png").size == size

    # Noise of this strength cannot be compressed.
    Image.effect_noise((900, 900), 90).convert("RGB").save(tmp_path / "a.png")
    with pytest.raises(ValueError, match="bytes"):
        gallery.make_small(tmp_path / "a.png", tmp_path / "b.png")
