"""Ticks that are placed once give matplotlib's own pixels, with fewer placements, and move where axes change."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from matplotlib.axis import Axis, Tick
from matplotlib.figure import Figure

from vipetsc.figures.kept_ticks import kept_ticks
from vipetsc.figures.style import new_figure, rc_style

pytestmark = pytest.mark.parallel(1)


def page() -> Figure:
    """Return a figure with a map and its colour bar, logarithmic axes, twin axes, small numbers and titles."""
    figure = new_figure(4.0, 3.0)
    left, middle, right = figure.subplots(1, 3)
    image = left.imshow(np.arange(12.0).reshape(3, 4))
    figure.colorbar(image, ax=left)
    middle.loglog([1e-7, 1e4], [1.0, 2e9])
    middle.twinx().plot([0.0, 1.0], [0.0, 3e-5])
    right.plot([0.0, 1e-6], [0.0, 1e7])
    for axes in (left, middle, right):
        axes.set(title="a title", xlabel="across", ylabel="up")
    return figure


def pixels(figure: Figure) -> np.ndarray:
    figure.canvas.draw()
    return np.array(figure.canvas.buffer_rgba())


@pytest.fixture
def placements(monkeypatch) -> Counter[str]:
    """Return counts of how often ticks are placed and their labels are measured."""
    counts: Counter[str] = Counter()
    for name in ("_update_ticks", "_get_ticklabel_bboxes"):
        own = getattr(Axis, name)

        def counted(axis, *arguments, own=own, name=name):
            counts[name] += 1
            return own(axis, *arguments)

        monkeypatch.setattr(Axis, name, counted)
    return counts


def test_a_picture_has_the_same_pixels_from_fewer_placements(placements):
    with rc_style():
        expected = pixels(page())
        of_matplotlib = placements.copy()
        placements.clear()
        figure = page()
        with kept_ticks(figure):
            drawn = pixels(figure)
    np.testing.assert_array_equal(drawn, expected)
    assert all(2 * placements[name] < of_matplotlib[name] for name in of_matplotlib)


@pytest.mark.parametrize("change", ["limits", "frame", "resolution"])
def test_ticks_are_placed_anew_where_something_moves(change):
    """After a change of limits, frame or resolution the pixels are those of matplotlib without kept ticks."""

    def changed(figure: Figure) -> np.ndarray:
        pixels(figure)
        figure.set_layout_engine("none")
        axes = figure.get_axes()[2]
        if change == "limits":
            axes.set_xlim(0.0, 3e-9)
        elif change == "frame":
            axes.set_position([0.75, 0.6, 0.1, 0.2])
        else:
            figure.set_dpi(150)
        return pixels(figure)

    with rc_style():
        expected = changed(page())
        figure = page()
        with kept_ticks(figure):
            drawn = changed(figure)
    np.testing.assert_array_equal(drawn, expected)


def test_further_ticks_are_copies_of_the_first_one(monkeypatch):
    """Ticks look like the first one of their axis, which alone is made by matplotlib; those of polar axes all are."""

    def unlike_the_others() -> Figure:
        figure = new_figure(4.0, 2.0)
        figure.add_subplot(1, 2, 1).set(xscale="log", xlim=(1.0, 1e4))
        figure.add_subplot(1, 2, 2, projection="polar")
        first, *_ = figure.get_axes()[0].xaxis.majorTicks
        first.label1.set_color("red")
        first.tick1line.set_markersize(9)
        return figure

    made: Counter[str] = Counter()
    make = Tick.__init__

    def counted(tick, axes, *arguments, **keywords):
        made[axes.name] += 1
        make(tick, axes, *arguments, **keywords)

    monkeypatch.setattr(Tick, "__init__", counted)
    figure = unlike_the_others()
    made.clear()
    expected = pixels(figure)
    of_matplotlib = made.copy()

    figure = unlike_the_others()
    made.clear()
    with kept_ticks(figure):
        drawn = pixels(figure)
    np.testing.assert_array_equal(drawn, expected)
    # No more than the first major and the first minor tick of each axis.
    assert made["rectilinear"] <= 4 < of_matplotlib["rectilinear"]
    assert made["polar"] == of_matplotlib["polar"] > 0


def test_nothing_is_left_behind():
    """After the context axes have matplotlib's own methods."""
    figure = page()
    axis = figure.get_axes()[0].xaxis
    attributes = {*vars(axis)}
    with kept_ticks(figure):
        assert "_update_ticks" in vars(axis)
    assert {*vars(axis)} == attributes
