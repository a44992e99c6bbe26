"""Figures of the paper: division among ranks, kept files, notes, names in words, texts of the report, schematics."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.layout_engine import ConstrainedLayoutEngine

from vipetsc.case import Case
from vipetsc.figures.schematics import lattice_page, reduced_model
from vipetsc.figures.style import NOTE, SCREEN, Drawing, draw_each, new_figure, rc_style, save
from vipetsc.paper.claims.criteria import CLAIMS
from vipetsc.paper.paper_figures import PAPER_FIGURES, describe
from vipetsc.paper.report import numbers, sources


def drawings(count: int, drawn: list[int]):
    """Yield drawings of empty pages; drawing one appends its number to ``drawn``."""

    def page(number: int) -> Figure:
        drawn.append(number)
        return new_figure(1, 1)

    for number in range(count):
        yield Drawing(f"page-{number}", lambda number=number: page(number))


def turned(count: int, turns) -> list[str]:
    """Return the names of the pictures that a rank with these ``turns`` takes, without drawing them."""
    seen: list[str] = []

    def keep(path: Path) -> bool:
        seen.append(path.stem)
        return True

    draw_each(drawings(count, []), Path("nowhere"), ["png"], iter(turns), keep=keep)
    return seen


@given(count=st.integers(0, 12), size=st.integers(1, 5))
def test_ranks_draw_every_picture_once(count, size):
    """Ranks that take every ``size``-th picture take each of them once."""
    seen = []
    for rank in range(size):
        seen += turned(count, itertools.count(rank, size))

    assert sorted(seen) == sorted(f"page-{number}" for number in range(count))


@given(count=st.integers(0, 12), owners=st.lists(st.integers(0, 2), min_size=12, max_size=12))
def test_ranks_that_draw_from_one_count_miss_none(count, owners):
    """Three ranks that take numbers from one counter, in any order, take each picture once."""
    seen = []
    for rank in range(3):
        seen += turned(count, [number for number, owner in enumerate(owners) if owner == rank])

    assert sorted(seen) == sorted(f"page-{number}" for number in range(count))


def test_what_is_kept_is_not_drawn_and_not_half(tmp_path):
    """A picture that exists in all formats is kept; one that lacks a format is drawn in all of them."""
    drawn: list[int] = []
    (tmp_path / "page-0.png").write_text("old")
    # The second page lacks its PDF.
    (tmp_path / "page-1.png").write_text("old")
    (tmp_path / "page-0.pdf").write_text("old")

    written = draw_each(drawings(2, drawn), tmp_path, ["png", "pdf"], itertools.count(), keep=Path.exists)

    assert drawn == [1]
    assert [p.name for p in written] == ["page-1.png", "page-1.pdf"]


def test_a_note_stands_below_the_picture_and_moves_nothing(tmp_path):
    """A note adds a strip with text below a picture and leaves the picture as it is."""
    with rc_style():
        figure = new_figure(2, 1)
        figure.subplots().plot([0, 1])
        plain = imread(save(figure, tmp_path / "plain.png"))[..., :3]
        noted = imread(save(figure, tmp_path / "noted.png", "coarse"))[..., :3]

    strip = round(NOTE * SCREEN)
    assert noted.shape[0] == pytest.approx(plain.shape[0] + strip, abs=1)
    assert noted.shape[1] == plain.shape[1]
    # A strip without text has one colour.
    assert np.ptp(noted[-strip:]) > 0.2
    # The mean is compared, since edges may move by fractions of a pixel.
    assert np.abs(noted[: plain.shape[0]] - plain).mean() < 0.01


def test_a_figure_is_laid_out_once_for_all_formats(tmp_path, monkeypatch):
    """The layout, the dearest step, is computed once for a PNG and a PDF, and minor ticks of decades stay few."""
    laid_out = []
    monkeypatch.setattr(ConstrainedLayoutEngine, "execute", lambda engine, figure: laid_out.append(figure))

    with rc_style():
        figure = new_figure(2, 1)
        figure.subplots().loglog([1, 1e4])
        for name in ("a.png", "a.pdf"):
            save(figure, tmp_path / name)

    assert laid_out == [figure]
    (axes,) = figure.axes
    # Without a bound an axis of many decades has hundreds of minor ticks, which take most of a layout's time.
    assert len(axes.yaxis.get_minorticklocs()) <= 2 * 6 + 2


def test_every_claim_has_a_figure_that_shows_it():
    """Figures show all claims, and are those of the paper, its appendix and its supplement, in their order."""
    shown = {claim for figure in PAPER_FIGURES for claim in figure.claims}
    # Every claim has a picture, and every claim that a picture shows exists.
    assert shown == set(CLAIMS)

    paper = [f"Fig. {number}" for number in range(1, 13)]
    appendix = [f"Fig. A{number}" for number in range(1, 4)]
    supplement = [f"Fig. S{number}" for number in range(1, 9)]
    labels = [figure.label for figure in PAPER_FIGURES]
    assert labels == [*paper, "beside Fig. 12", *appendix, *supplement]


@pytest.mark.parametrize(
    ("stem", "words"),
    [
        ("fig05-entropy-calibrated-5pi-9-energy_weighted", "calibrated reading, 5π/9, energy-weighted average"),
        ("fig05-neighbours-entropy-printed-masked", "neighbouring sites, printed reading, masked average"),
        (
            "fig07-transfer-hertz-printed-5-sites-30-cycles-24.33N",
            "Hertz, printed reading, 5 sites, 30 cycles, 24.33 N",
        ),
        ("figS5-phase_regimes-bilinear-calibrated-1-site-30-cycles", "bilinear, calibrated reading, 1 site, 30 cycles"),
        ("fig11-branches-in-phase-printed", "in phase, printed reading"),
        ("figS3-design-cost-maps", ""),
    ],
)
def test_names_of_files_in_words(stem, words):
    """The stem of a picture's file becomes the words of its caption, without its number and title."""
    assert describe(stem) == words


def test_small_texts_of_the_report():
    """Numbers have four digits and no entry for None; files of one folder are counted."""
    assert numbers({"share": 0.123456, "points": 12, "lost": None}) == ["share = 0.1235", "points = 12"]
    assert sources(["a/x.h5", "a/y.h5", "b/x.h5"]) == "a (2 files), b"


@pytest.mark.parametrize("preset", ["diatomic", "four-band"])
def test_the_lattice_page_shows_every_configuration(preset):
    """A page of two configurations has a strip for each, on which the cells of its sites are named."""
    case = Case.from_table({"name": preset, "lattice": {"preset": preset, "reading": "printed"}})
    with rc_style():
        figure = lattice_page(case, (1, 5))

    strips = [axes for axes in figure.axes if re.search(r"\d contact site", axes.get_title(loc="left"))]
    assert len(strips) == 2
    with_one_site = Case.from_table({"lattice": {"preset": preset}, "contacts": {"sites": 1}})
    shown = {text.get_text() for text in strips[0].texts}
    assert str(with_one_site.contacts.sites[0]) in shown


def test_the_reduced_model_names_its_numbers():
    """The picture of the reduced model states its stiffnesses, its mass and its clearance with units."""
    with rc_style():
        figure = reduced_model((0.0025, 0.0025), (2e4, 2e3), 10**-2.75)

    text = " ".join(label.get_text() for label in figure.axes[0].texts)
    for number in ("20 kN/m", "2 kN/m", "2.5 g", "1.778 mm"):
        assert number in text
