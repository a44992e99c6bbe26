"""The manual's pages: built without a warning, and read in a browser."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import vipetsc
from tests.cli.browser import NEEDED, SCREENS, browsing
from vipetsc.cli.verbs.reference_verbs import KEYS, parts

ROOT = Path(vipetsc.__file__).parents[1]
CHAPTERS = {path.stem for path in (ROOT / "vipetsc/manual").glob("*.md")}
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(
        not (find_spec("furo") and find_spec("sphinx-mathjax-offline")),
        reason="no Sphinx with furo and MathJax; scripts/test installs them",
    ),
]


def build(folder: Path, *options: str) -> subprocess.CompletedProcess:
    """Build the manual's pages into a folder."""
    command = [sys.executable, ROOT / "scripts/manual_pages.py", folder, *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture(scope="module")
def pages(tmp_path_factory) -> Path:
    """Build all chapters, and the interface of one package."""
    folder = tmp_path_factory.mktemp("manual")
    # The interface of all packages takes three times as long.
    ended = build(folder, "--python", "vipetsc.contact")
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return folder


def test_every_chapter_has_a_page_and_the_interface_its_signatures(pages):
    """Every chapter has a page, and the page of a package has its functions with their docstrings."""
    assert {*CHAPTERS, KEYS, "start", "vipetsc.contact"} <= {path.stem for path in pages.glob("*.html")}
    page = (pages / "vipetsc.contact.html").read_text(encoding="utf-8")
    assert 'id="vipetsc.contact.law.contact_force"' in page
    assert "Return force on the host in N and dissipated power in W of site" in page


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """Open one browser for all sizes of its window."""
    with browsing(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


# Elements beyond the window's right edge, except those in a box that scrolls by itself.
WIDE = """
const scrolls = e => e && (getComputedStyle(e).overflowX === 'auto' || scrolls(e.parentElement.closest('article *')));
return (window.MathJax ? MathJax.startup.promise : Promise.resolve()).then(() =>
    [...document.querySelectorAll('article *')].filter(e => e.getBoundingClientRect().right > innerWidth + 1
        && !scrolls(e)).map(e => e.tagName + e.textContent.slice(0, 40)));
"""


@NEEDED
@SCREENS
def test_pages_fit_a_phone_and_a_desk(pages, browser, width, height):
    """Pages are no wider than the window; their pictures, links and scripts work, and all files are local."""
    session = browser.open(pages / "index.html", width, height)
    for name in ("index", "theory", "files", KEYS, "features", "vipetsc.contact"):
        browser.show(session, pages / f"{name}.html")
        found = browser.measure(session)
        assert found["page"] <= width, name
        assert found["broken"] == [], name
        assert found["dead"] == [], name
        assert found["errors"] == [], name
        assert browser.ask(session, WIDE) == [], name
        assert [url for url in found["linked"] if not url.startswith("file:")] == []


# Formulas that MathJax has not set (``raw``) or set with an error (``wrong``), the beginnings of formulas and of blocks
# of code that are cut at the right edge (``cut``), and the number of formulas that are set (``set``).
CUT = """
return (window.MathJax ? MathJax.startup.promise : Promise.resolve()).then(() => ({
    raw: [...document.querySelectorAll('.math')].filter(e => !e.querySelector('mjx-container svg')).map(
        e => e.textContent),
    wrong: [...document.querySelectorAll('mjx-container [data-mjx-error], mjx-container [fill="red"]')].map(
        e => e.textContent),
    cut: [...document.querySelectorAll('div.math, .highlight pre')].filter(e => e.scrollWidth > e.clientWidth + 1).map(
        e => e.textContent.slice(0, 60)),
    set: document.querySelectorAll('mjx-container svg').length,
}));
"""


@NEEDED
def test_formulas_are_set_and_nothing_is_cut_on_a_desk(pages, browser):
    """MathJax sets every formula, and a window of 1200 pixels cuts no formula and no block of code beside formulas."""
    session = browser.open(pages / "index.html", 1200, 900)
    formulas = {}
    for page in sorted(pages.glob("*.html")):
        if 'class="math' not in page.read_text(encoding="utf-8"):
            continue
        browser.show(session, page)
        found = browser.ask(session, CUT)
        assert found["raw"] == [], page.name
        assert found["wrong"] == [], page.name
        assert found["cut"] == [], page.name
        formulas[page.stem] = found["set"]
    assert formulas["theory"] > 60
    assert formulas["measures"] > 40
    assert formulas["engines"] > 15


def test_the_manual_has_four_parts_and_every_chapter_is_in_one(pages):
    """The margin lists tutorials, how-to, theory and reference; every chapter is in exactly one of these parts."""
    page = (pages / "index.html").read_text(encoding="utf-8")
    captions = re.findall(r'class="caption-text">([^<]+)<', page)
    assert captions == ["Tutorials", "How to", "Theory", "Reference"]
    listed = [name for names in parts().values() for name in names]
    assert len(listed) == len(set(listed))
    assert set(listed) == CHAPTERS - {"index"} | {KEYS}


def test_terms_lead_to_the_glossary(pages):
    """A term in a chapter is a link to its entry in the glossary, with the chapter's own wording."""
    page = (pages / "theory.html").read_text(encoding="utf-8")
    assert 'href="glossary.html#term-ibtet"' in page
    assert "contact sites" in page
