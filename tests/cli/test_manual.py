"""The manual's pages: built without a warning, and read in a browser."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import vipetsc
from tests.cli.browser import NEEDED, SCREENS, browsing

ROOT = Path(vipetsc.__file__).parents[1]
CHAPTERS = {path.stem for path in (ROOT / "vipetsc/manual").glob("*.md")}
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(not find_spec("furo"), reason="no Sphinx with furo; scripts/test installs it"),
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
    assert {*CHAPTERS, "start", "case-keys", "vipetsc.contact"} <= {path.stem for path in pages.glob("*.html")}
    page = (pages / "vipetsc.contact.html").read_text(encoding="utf-8")
    assert 'id="vipetsc.contact.law.contact_force"' in page
    assert "Force on the host in N and dissipated power in W" in page


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """Open one browser for all sizes of its window."""
    with browsing(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


# Elements beyond the window's right edge, but for those that scroll by themselves.
WIDE = """
return [...document.querySelectorAll('article *')].filter(e => e.getBoundingClientRect().right > innerWidth + 1
    && !e.closest('.table-wrapper, .highlight')).map(e => e.tagName + e.textContent.slice(0, 40));
"""


@NEEDED
@SCREENS
def test_pages_fit_a_phone_and_a_desk(pages, browser, width, height):
    """Pages are no wider than the window, and no picture, link or script of them fails or leads outside."""
    session = browser.open(pages / "index.html", width, height)
    for name in ("index", "start", "measures", "files", "case-keys", "performance", "paper", "vipetsc.contact"):
        browser.show(session, pages / f"{name}.html")
        found = browser.measure(session)
        assert found["page"] <= width, name
        assert found["broken"] == [], name
        assert found["dead"] == [], name
        assert found["errors"] == [], name
        assert browser.ask(session, WIDE) == [], name
        assert [url for url in found["linked"] if not url.startswith("file:")] == []
