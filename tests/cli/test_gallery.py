"""The gallery: a page a study, whose commands are those of cases that are there; each runs in small."""

import re
import shutil
import sys

import pytest

import vipetsc
from tests.cli.test_guide import ROOT
from vipetsc.case.verb_cases import load_every
from vipetsc.cli.main import main

sys.path.insert(0, str(ROOT / "scripts"))
import gallery

MOST_PNG = 1_000_000  # bytes of all
PAGES = gallery.pages()
SMALL = {
    "run": ["time.end=0.01", "time.sample_interval=0.0005", "time.engine=propagator", "output.figures=false"],
    "nnm": ["nnm.points=2", "nnm.start_frequency=[1420.0]", "nnm.orbits_at=[]"],
}
SETS = {verb: [word for text in texts for word in ("--set", text)] for verb, texts in SMALL.items()}


def test_every_study_has_a_page_a_command_and_small_pictures():
    assert 6 <= len(PAGES) <= 10
    assert set(PAGES.values()) == set(gallery.INDEX.with_suffix("").glob("*.md"))
    shown = {name: gallery.pictures(page) for name, page in PAGES.items()}
    assert all(map(gallery.commands, PAGES.values())) and all(shown.values())
    every = {path for paths in shown.values() for path in paths}
    assert all(path.stat().st_size <= gallery.MOST[path.suffix] for path in every)
    assert sum(path.stat().st_size for path in every if path.suffix == ".png") <= MOST_PNG
    assert {path for path in (ROOT / "runs/gallery").iterdir() if path.suffix != ".toml"} == every
    named = {name for page in PAGES.values() for name in re.findall(r"runs/gallery/[\w-]+\.toml", page.read_text())}
    assert {f"runs/gallery/{path.name}" for path in (ROOT / "runs/gallery").glob("*.toml")} == named


def test_every_case_is_valid_and_some_run_in_small(tmp_path, monkeypatch):
    """In the order of the pages: one begins with a file that another leaves."""
    shutil.copytree(ROOT / "runs", tmp_path / "runs", ignore=shutil.ignore_patterns("*.h5", "*.png"))
    monkeypatch.chdir(tmp_path)
    for words in (words for page in PAGES.values() for words in gallery.commands(page)):
        ranks, words = words[: words.index("python")], words[words.index("python") :]
        assert ranks in ([], ["mpirun", "-n", "2"])
        assert words[:3] == ["python", "-m", vipetsc.__name__]
        verb, *words = words[3:]
        begun = words[0] == "runs/breather.toml" or "breather-run" in words[0]
        if verb in SMALL and (begun or "gate.toml" in words[0]):
            first = ["--set", "initial.orbit=1"] if "breather-run" in words[0] else []
            assert main([verb, *words, *SETS[verb], *first, "--quiet"]) == 0, words
        elif verb != "plot":
            sets = [words[i + 1] for i, word in enumerate(words) if word == "--set"]
            assert load_every(words[0], sets), words


@pytest.mark.parametrize("width", [300, 1800])
def test_a_picture_is_made_small(width, tmp_path):
    from PIL import Image

    Image.effect_noise((width, 200), 5).convert("RGB").save(tmp_path / "a.png")
    gallery.make_small(tmp_path / "a.png", tmp_path / "b.png")
    assert Image.open(tmp_path / "b.png").size == (min(width, 900), 200 if width < 900 else 100)
    Image.effect_noise((900, 900), 90).convert("RGB").save(tmp_path / "a.png")
    with pytest.raises(ValueError, match="bytes"):
        gallery.make_small(tmp_path / "a.png", tmp_path / "b.png")
