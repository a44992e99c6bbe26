"""The gallery: its commands are those of cases that are there, each runs in small, its pictures are small."""

import shutil
import sys

import pytest

import vipetsc
from tests.cli.test_guide import ROOT
from vipetsc.case.every import load_every
from vipetsc.cli.main import main

sys.path.insert(0, str(ROOT / "scripts"))
import gallery

MOST_PNG = 1_000_000  # bytes of all
COMMANDS = gallery.commands()
SMALL = {
    "run": ["time.end=0.01", "time.sample_interval=0.0005", "time.engine=propagator", "output.figures=false"],
    "nnm": ["nnm.points=2", "nnm.start_frequency=[1420.0]", "nnm.orbits_at=[]"],
}
SETS = {verb: [word for text in texts for word in ("--set", text)] for verb, texts in SMALL.items()}


def test_the_chapter_has_its_studies_and_small_pictures():
    assert len({words[4] for words in COMMANDS if words[3] != "plot"}) == 8 + 1  # the breather's branch, and its run
    shown = gallery.pictures()
    assert all(path.stat().st_size <= gallery.MOST[path.suffix] for path in shown)
    assert sum(path.stat().st_size for path in shown if path.suffix == ".png") <= MOST_PNG
    assert {path.name for path in (ROOT / "runs/gallery").iterdir() if path.suffix != ".toml"} == {
        p.name for p in shown
    }


def test_every_case_is_valid_and_those_of_the_gallery_run_in_small(tmp_path, monkeypatch):
    """In the chapter's order: one begins with a file that another leaves."""
    shutil.copytree(ROOT / "runs", tmp_path / "runs", ignore=shutil.ignore_patterns("*.h5", "*.png"))
    monkeypatch.chdir(tmp_path)
    for python, m, package, verb, *words in COMMANDS:
        assert [python, m, package] == ["python", "-m", vipetsc.__name__]
        begun = words[0] == "runs/breather.toml" or "breather-run" in words[0]
        if verb in SMALL and (begun or "gate.toml" in words[0]):
            first = ["--set", "initial.orbit=1"] if "breather-run" in words[0] else []
            assert main([verb, *words, *SETS[verb], *first, "--quiet"]) == 0, words
        elif verb != "plot":
            assert load_every(words[0], words[words.index("--set") + 1 :: 2] if "--set" in words else []), words


@pytest.mark.parametrize("width", [300, 1800])
def test_a_picture_is_made_small(width, tmp_path):
    from PIL import Image

    Image.effect_noise((width, 200), 5).convert("RGB").save(tmp_path / "a.png")
    gallery.make_small(tmp_path / "a.png", tmp_path / "b.png")
    assert Image.open(tmp_path / "b.png").size == (min(width, 900), 200 if width < 900 else 100)
    Image.effect_noise((900, 900), 90).convert("RGB").save(tmp_path / "a.png")
    with pytest.raises(ValueError, match="bytes"):
        gallery.make_small(tmp_path / "a.png", tmp_path / "b.png")
