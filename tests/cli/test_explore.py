"""Values that the report's page shows under the pointer: of maps by their colours, of points on logarithmic axes."""

from __future__ import annotations

import base64
import json
import re

import numpy as np
import pytest

from tests.cli.browser import NEEDED, browsing
from vipetsc.figures import panels, style
from vipetsc.figures.style import new_figure, rc_style, save
from vipetsc.paper.paper_figures import PaperFigure
from vipetsc.paper.report import ReportContents, write_report

CELLS = 100
# The energies span six decades; a map shows the upper five.
ENERGY = np.geomspace(1e-7, 1e-1, CELLS)
# Amplitudes in N and entropies of two points.
POINTS = ([1.0, 1e4], [10.0, 1e3])


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """Open a page with a map that has a white line, and with a panel of two points.

    Yields the axes of the picture, and a function that reads the page at a place.
    """
    folder = tmp_path_factory.mktemp("page")
    with rc_style():
        figure = new_figure(7, 3)
        left, right = figure.subplots(1, 2)
        values = np.tile(ENERGY, (50, 1))
        image = panels.draw_map(left, np.arange(CELLS), np.arange(50), values, panels.log_norm(values))
        panels.colour_bar(image, left, "Energy (J)")
        left.axhline(25, color="white", lw=4)
        right.loglog(*POINTS, "o", label="two points")
        right.set(xlim=(0.1, 1e5), ylim=(1, 1e5), xlabel="Amplitude (N)", ylabel="Entropy")
        picture = save(figure, folder / "fig99-both.png")
        axes = json.loads(save(figure, folder / "fig99-both.json").read_text())

    figure = PaperFigure(id="fig99", label="Fig. 99", title="A map and two points", caption="", claims=(), parts=())
    contents = ReportContents(
        note="", claims=[], pictures=[(figure, [picture])], statistics={}, versions={"date": ""}, cpu={"steps": {}}
    )
    write_report(folder / "report.html", contents)

    with browsing(folder) as browser:
        # A window so low that the page scrolls.
        session = browser.open(folder / "report.html", 1280, 500)
        image = "const i = document.querySelector('figure img');"
        box = image + "i.scrollIntoView({block: 'center'}); const b = i.getBoundingClientRect();"
        mark = "const m = document.querySelector('.mark');"
        found = "m.hidden ? [] : [parseFloat(m.style.left) / i.offsetWidth, parseFloat(m.style.top) / i.offsetHeight]"

        def read_off(panel: dict, x: float, y: float) -> tuple[str, list[float]]:
            """Return the text below the picture, and the place of the mark in the picture or an empty list.

            The pointer is at ``x`` from the left and ``y`` from below, from 0 to 1, of ``panel``.
            """
            west, north, east, south = panel["box"]
            left, top, width, height = browser.ask(session, box + "return [b.left, b.top, b.width, b.height];")
            across = west + x * (east - west)
            up = south + y * (north - south)
            browser.drag(session, (left + across * width, top + up * height))
            text = browser.ask(session, "return document.querySelector('figure output').textContent;")
            return text, browser.ask(session, f"{image}{mark} return {found};")

        yield axes, read_off
        assert browser.measure(session)["errors"] == []


@pytest.mark.browser
@NEEDED
def test_a_map_shows_the_value_of_its_colour(shown):
    """The page shows the value that the colour under the pointer stands for, or the bound that it lies beyond."""
    (area, _), read_off = shown
    # The places are middles of cells: a cell is five pixels wide in the picture, and two or three on the screen.
    for x in (0.305, 0.425, 0.605, 0.775, 0.935):
        text, mark = read_off(area, x, 0.2)
        value = float(re.search(r"; Energy \(J\) ≈ (\S+)$", text)[1])
        assert value == pytest.approx(np.interp(x * CELLS - 0.5, np.arange(CELLS), ENERGY), rel=0.2), text
        assert mark == []

    # These places lie below and above the five decades, and on the white line, whose colour stands for no value.
    assert read_off(area, 0.05, 0.2)[0].endswith("Energy (J) ≤ 0.000001")
    assert "Energy (J) ≥" in read_off(area, 0.995, 0.2)[0]
    assert "Energy" not in read_off(area, 0.6, 0.51)[0]


@pytest.mark.browser
@NEEDED
def test_logarithmic_axes_are_read_by_decades(shown):
    """The page shows the values of the point that is nearest to the pointer in the picture, and marks that point."""
    (_, panel), read_off = shown

    west, north, east, south = panel["box"]
    # The pointer is near each point, and then farther from it but still nearer to it than to the other one.
    first, second = zip(*POINTS, strict=True)
    beyond = 0.2
    for (x, y), shift in ((first, 0.01), (first, beyond), (second, 0.01), (second, -beyond)):
        across = (np.log10(x) + 1) / 6
        up = np.log10(y) / 5
        text, mark = read_off(panel, across + shift, up)
        assert "two points" in text
        assert f"N): {x:g};" in text
        assert text.endswith(f": {y:g}")
        assert mark == pytest.approx([west + across * (east - west), south + up * (north - south)], abs=0.002)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """Write a page with a figure whose panels have equal titles; yield its path and a browser."""
    folder = tmp_path_factory.mktemp("panels")
    with rc_style():
        figure = new_figure(7, 3)
        for axes, label in zip(figure.subplots(1, 3), ("Entropy", "Entropy", "Transfer"), strict=True):
            axes.plot(*POINTS)
            axes.set(title="5 sites", xlabel="Amplitude (N)", ylabel=label)
        picture = save(figure, folder / "fig99-panels.png")
        save(figure, folder / "fig99-panels.json")

    paper_figure = PaperFigure(id="fig99", label="Fig. 99", title="Three panels", caption="", claims=(), parts=())
    contents = ReportContents(
        note="",
        claims=[],
        pictures=[(paper_figure, [picture])],
        statistics={},
        versions={"date": ""},
        cpu={"steps": {}},
    )
    write_report(folder / "report.html", contents)
    with browsing(folder) as browser:
        yield folder / "report.html", browser


@pytest.mark.browser
@NEEDED
def test_panels_have_full_names_of_their_own(page):
    """Panels with equal titles are numbered in the list of panels; on a wide page the index is left of the text."""
    path, browser = page
    session = browser.open(path, 1280, 900)
    names = browser.ask(session, "return [...document.querySelectorAll('option')].map(o => o.textContent).slice(1);")
    assert names == [
        "5 sites: Entropy over Amplitude (N) (1)",
        "5 sites: Entropy over Amplitude (N) (2)",
        "5 sites: Transfer over Amplitude (N)",
    ]
    index = "const n = document.querySelector('nav').getBoundingClientRect(), m = document.querySelector('main');"
    assert browser.ask(session, index + "return n.right <= m.getBoundingClientRect().left;")
    assert "Three panels" in browser.ask(session, "return document.querySelector('nav').textContent;")


@pytest.mark.browser
@NEEDED
def test_a_tap_on_a_phone_shows_the_picture_on_the_whole_screen(page):
    """A tap opens the picture in a dialog of the screen's width, at twice that width or more; another tap closes it."""
    path, browser = page
    session = browser.open(path, 390, 844)
    # Before the tap no image of the page lacks its picture.
    assert browser.measure(session)["broken"] == []
    tap = "document.querySelector('figure img').dispatchEvent(new PointerEvent('click', {pointerType: 'touch'}));"
    look = "const d = document.querySelector('dialog'), l = d.querySelector('img');"
    shown = browser.ask(session, tap + look + "return [d.open, l.offsetWidth, d.clientWidth, innerWidth];")
    assert shown[0]
    assert shown[1] >= 2 * shown[2] == 2 * shown[3]
    # The button comes after the picture in the dialog: on a dark page the picture has a filter, and would cover it.
    assert browser.ask(session, look + "return d.firstElementChild === l && d.lastElementChild.textContent;") == "close"
    assert not browser.ask(session, look + "l.click(); return d.open;")
    assert browser.measure(session)["errors"] == []


@pytest.mark.browser
@NEEDED
def test_a_full_report_is_printed_on_less_than_forty_pages(page, tmp_path, monkeypatch):
    """A report of 74 pictures takes at most 32 pages, which leaves eight pages for the claims of a full report.

    A printed picture takes at most a quarter of a page.
    """
    _, browser = page
    # Pictures have 770 pixels, wider than a printed page: only the style sheet makes them smaller. More pixels would
    # take long to encode.
    monkeypatch.setattr(style, "SCREEN", 110)
    with rc_style():
        figure = new_figure(7, 5)
        figure.subplots().plot(*POINTS)
        picture = save(figure, tmp_path / "fig99-high.png")
    caption = "In a few words. " * 20
    figures = [
        PaperFigure(id=f"fig{k}", label=f"Fig. {k}", title="A high picture", caption=caption, claims=(), parts=())
        for k in range(37)
    ]
    contents = ReportContents(
        note="",
        claims=[],
        pictures=[(figure, [picture, picture]) for figure in figures],
        statistics={},
        versions={"date": ""},
        cpu={"steps": {}},
    )
    write_report(tmp_path / "report.html", contents)
    session = browser.open(tmp_path / "report.html", 1280, 900)
    printed = base64.b64decode(browser.call(f"{session}/print", {}))
    pages = len(re.findall(rb"/Type\s*/Page\b", printed))
    assert 1 < pages <= 32
