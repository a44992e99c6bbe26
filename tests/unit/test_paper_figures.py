"""Figures of the paper: shared, kept, noted; their names in words; the report's small texts; schematics."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.layout_engine import ConstrainedLayoutEngine

from vipetsc.case import Case
from vipetsc.figures.schematics import lattice_page, reduced_model
from vipetsc.figures.style import NOTE, SCREEN, Drawing, draw_each, new_figure, rc_style, save
from vipetsc.paper.claims.criteria import CLAIMS
from vipetsc.paper.paper_figures import PAPER_FIGURES, describe
from vipetsc.paper.report import numbers, sources


def drawings(count: int, made: list[int]):
    def page(number: int) -> Figure:
        made.append(number)
        return new_figure(1, 1)

    for number in range(count):
        yield Drawing(f"page-{number}", lambda number=number: page(number))


def turned(count: int, turns) -> list[str]:
    """The pictures whose turn it is, none of them drawn."""
    seen: list[str] = []

    def keep(path: Path) -> bool:
        seen.append(path.stem)
        return True

    draw_each(drawings(count, []), Path("nowhere"), ["png"], iter(turns), keep=keep)
    return seen


@given(count=st.integers(0, 12), size=st.integers(1, 5))
def test_ranks_draw_every_picture_once(count, size):
    seen = [stem for rank in range(size) for stem in turned(count, itertools.count(rank, size))]
    assert sorted(seen) == sorted(f"page-{number}" for number in range(count))


@given(count=st.integers(0, 12), owners=st.lists(st.integers(0, 2), min_size=12, max_size=12))
def test_ranks_that_draw_from_one_count_miss_none(count, owners):
    turns = [[number for number, owner in enumerate(owners) if owner == rank] for rank in range(3)]
    seen = [stem for own in turns for stem in turned(count, own)]
    assert sorted(seen) == sorted(f"page-{number}" for number in range(count))


def test_what_is_kept_is_not_drawn_and_not_half(tmp_path):
    made: list[int] = []
    (tmp_path / "page-0.png").write_text("old")
    (tmp_path / "page-1.png").write_text("old")
    (tmp_path / "page-0.pdf").write_text("old")
    written = draw_each(drawings(2, made), tmp_path, ["png", "pdf"], itertools.count(), keep=Path.exists)
    assert made == [1]
    assert [p.name for p in written] == ["page-1.png", "page-1.pdf"]


def test_a_note_stands_below_the_picture_and_moves_nothing(tmp_path):
    with rc_style():
        figure = new_figure(2, 1)
        figure.subplots().plot([0, 1])
        plain, noted = (imread(save(figure, tmp_path / f"{note or 'plain'}.png", note)) for note in ("", "coarse"))
        strip = round(NOTE * SCREEN)
    assert noted.shape[0] == pytest.approx(plain.shape[0] + strip, abs=1)
    assert noted.shape[1] == plain.shape[1]
    assert np.ptp(noted[-strip:, :, :3]) > 0.2
    assert np.abs(noted[: plain.shape[0]] - plain).mean() < 0.01


def test_a_figure_is_laid_out_once_for_all_formats(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(ConstrainedLayoutEngine, "execute", lambda engine, figure: made.append(figure))
    with rc_style():
        figure = new_figure(2, 1)
        figure.subplots().loglog([1, 1e4])
        for name in ("a.png", "a.pdf"):
            save(figure, tmp_path / name)
    assert made == [figure]
    (axes,) = figure.axes
    assert len(axes.yaxis.get_minorticklocs()) <= 2 * 6 + 2


def test_what_a_picture_shows_is_told_as_numbers(tmp_path):
    x = np.array([1.0, 10.0, np.nan, np.nan, 100.0])
    wave = np.linspace(1, 100, 2001), 100 + 50 * np.sin(np.linspace(0, 20, 2001))
    with rc_style():
        figure = new_figure(4, 2)
        left, right, table = figure.subplots(1, 3)
        left.errorbar(x, 2 * x, 0.1 * x, fmt="o-", color="#0072B2", label="measured")
        left.plot([0, 1], [0, 1], transform=left.transAxes)  # is no curve of the data
        left.plot(*wave, label="_many")
        left.scatter([2, 3], [4, 5], c=[0.1, 0.9], label="by colour")
        left.scatter([2], [4], facecolors="none", edgecolors="k")
        left.set(xscale="log", xlabel="Amplitude $A$ (N)", title="")
        mesh = right.pcolormesh(np.eye(3), norm=LogNorm(1e-4, 1), cmap="viridis")
        figure.colorbar(mesh, ax=right, label="Energy $E$ (J)")
        right.plot([0, 2], [0, 2])
        table.axis("off")
        path = save(figure, tmp_path / "plain.json")
        noted = json.loads(save(figure, tmp_path / "noted.json", "coarse").read_text())
    axes, image = json.loads(path.read_text())
    assert axes["x"] | {"low": 0, "high": 0} == {"low": 0, "high": 0, "log": True, "label": "Amplitude A (N)"}
    assert axes["y"]["log"] is False
    curve, many, points = axes["curves"]
    assert points["label"] == "by colour" and points["x"] == [2, 3] and not points["joined"]
    assert many["label"] == "" and len(many["x"]) < 400
    assert np.interp(np.log(wave[0]), np.log(many["x"]), many["y"]) == pytest.approx(wave[1], abs=6)  # it is steep
    assert curve["label"] == "measured" and curve["colour"] == "#0072b2" and curve["joined"]
    assert curve["x"] == [1, 10, None, 100] and curve["y"] == [2, 20, None, 200]
    assert image["curves"] == [] and "map" not in axes and image["map"]["label"] == "Energy E (J)"
    assert image["map"]["colours"][:6] == "440154" and len(image["map"]["colours"]) == 6 * len(image["map"]["values"])
    assert image["map"]["values"] == pytest.approx(np.geomspace(1e-4, 1, len(image["map"]["values"])), rel=1e-3)
    with rc_style():
        figure = new_figure(4, 2)
        _, right = figure.subfigures(1, 2)
        right.supxlabel("time (s)")
        right.subplots().inset_axes((0.5, 0.5, 0.4, 0.4)).plot([0, 1])
        outer, inset = json.loads(save(figure, tmp_path / "parts.json").read_text())
    assert 0.5 < outer["box"][0] < inset["box"][0] < inset["box"][2] < outer["box"][2] <= 1
    assert outer["x"]["label"] == "time (s)" and len(inset["curves"]) == 1
    west, north, east, south = axes["box"]
    assert 0 <= west < east <= image["box"][0] and 0 < north < south < 1
    assert noted[0]["box"][3] == pytest.approx(south * 2 / (2 + NOTE), abs=1e-4)  # of the picture with its strip


def test_every_claim_has_a_figure_that_shows_it():
    shown = {claim for figure in PAPER_FIGURES for claim in figure.claims}
    assert shown == set(CLAIMS)
    assert [figure.label for figure in PAPER_FIGURES] == [f"Fig. {i}" for i in range(1, 13)] + [
        "beside Fig. 12",
        *(f"Fig. A{i}" for i in range(1, 4)),
        *(f"Fig. S{i}" for i in range(1, 9)),
    ]


@pytest.mark.parametrize(
    ("stem", "said"),
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
def test_names_of_files_in_words(stem, said):
    assert describe(stem) == said


def test_small_texts_of_the_report():
    assert numbers({"share": 0.123456, "points": 12, "lost": None}) == ["share = 0.1235", "points = 12"]
    assert sources(["a/x.h5", "a/y.h5", "b/x.h5"]) == "a (2 files), b"


@pytest.mark.parametrize("preset", ["diatomic", "four-band"])
def test_the_lattice_page_shows_every_configuration(preset):
    case = Case.from_table({"name": preset, "lattice": {"preset": preset, "reading": "printed"}})
    with rc_style():
        figure = lattice_page(case, (1, 5))
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert sum(bool(re.search(r"\d contact site", title)) for title in titles) == 2
    strips = [axes for axes in figure.axes if "contact site" in axes.get_title(loc="left")]
    shown = {text.get_text() for text in strips[0].texts}
    assert str(Case.from_table({"lattice": {"preset": preset}, "contacts": {"sites": 1}}).contacts.sites[0]) in shown


def test_the_reduced_model_names_its_numbers():
    with rc_style():
        figure = reduced_model((0.0025, 0.0025), (2e4, 2e3), 10**-2.75)
    text = " ".join(t.get_text() for t in figure.axes[0].texts)
    for words_ in ("20 kN/m", "2 kN/m", "2.5 g", "1.778 mm"):
        assert words_ in text
