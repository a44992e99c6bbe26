"""What the report's page tells under the pointer: values of maps by their colours, points on logarithmic axes."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from tests.cli.browser import NEEDED, browsing
from vipetsc.figures import panels
from vipetsc.figures.style import new_figure, rc_style, save
from vipetsc.paper.paper_figures import PaperFigure
from vipetsc.paper.report import ReportContents, write_report

CELLS = 100
ENERGY = np.geomspace(1e-7, 1e-1, CELLS)  # six decades, of which a map shows five
POINTS = [1.0, 1e4], [10.0, 1e3]


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """A page with one picture, a map with a white line and two points, in a browser: its axes, what is told where."""
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
    one = PaperFigure("fig99", "Fig. 99", "A map and two points", "", (), ())
    versions, cpu = {"date": ""}, {"steps": {}}
    contents = ReportContents(
        note="", claims=[], pictures=[(one, [picture])], statistics={}, versions=versions, cpu=cpu
    )
    write_report(folder / "report.html", contents)
    with browsing(folder) as browser:
        session = browser.open(folder / "report.html", 1280, 500)  # which scrolls
        image = "const i = document.querySelector('figure img');"
        box = image + "i.scrollIntoView({block: 'center'}); const b = i.getBoundingClientRect();"
        mark = "const m = document.querySelector('.mark');"
        found = "m.hidden ? [] : [parseFloat(m.style.left) / i.offsetWidth, parseFloat(m.style.top) / i.offsetHeight]"

        def read_off(panel: dict, x: float, y: float) -> tuple[str, list[float]]:
            """What stands below the picture with the pointer at (x, y), 0 to 1, of a panel; where the mark is."""
            west, north, east, south = panel["box"]
            left, top, width, height = browser.ask(session, box + "return [b.left, b.top, b.width, b.height];")
            across = west + x * (east - west)
            up = south + y * (north - south)
            browser.drag(session, (left + across * width, top + up * height))
            text = browser.ask(session, "return document.querySelector('figure output').textContent;")
            return text, browser.ask(session, f"{image}{mark} return {found};")

        yield axes, read_off
        assert browser.measure(session)["errors"] == []


@NEEDED
def test_a_map_tells_the_value_of_its_colour(shown):
    (area, _), read_off = shown
    for x in (0.3, 0.42, 0.6, 0.77, 0.93):
        text, mark = read_off(area, x, 0.2)
        value = float(re.search(r"; Energy \(J\) ≈ (\S+)$", text)[1])
        assert value == pytest.approx(np.interp(x * CELLS - 0.5, np.arange(CELLS), ENERGY), rel=0.2), text
        assert mark == []
    assert read_off(area, 0.05, 0.2)[0].endswith("Energy (J) ≤ 0.000001")
    assert "Energy (J) ≥" in read_off(area, 0.995, 0.2)[0]
    assert "Energy" not in read_off(area, 0.6, 0.51)[0]  # the white line


@NEEDED
def test_logarithmic_axes_are_read_by_decades(shown):
    (_, panel), read_off = shown
    text, mark = read_off(panel, 0.5, 0.9)  # away from the points: the place itself
    place = [float(number) for number in re.findall(r": ([\d.e+]+)", text)]
    assert place == pytest.approx([100, 10**4.5], rel=0.05) and mark == [], text
    west, north, east, south = panel["box"]
    for x, y in zip(*POINTS, strict=True):
        across, up = (np.log10(x) + 1) / 6, np.log10(y) / 5
        text, mark = read_off(panel, across + 0.01, up)
        assert "two points" in text and f"N): {x:g};" in text and text.endswith(f": {y:g}")
        assert mark == pytest.approx([west + across * (east - west), south + up * (north - south)], abs=0.002)
