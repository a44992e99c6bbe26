"""Figures of the paper: division among ranks, kept files, notes, names in words, texts of the report, schematics."""

from __future__ import annotations

import itertools
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from vipetsc.figures.style import Drawing, draw_each, new_figure
from vipetsc.paper.claims.criteria import CLAIMS
from vipetsc.paper.paper_figures import PAPER_FIGURES


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
