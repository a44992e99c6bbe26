"""The layout that measures the text of axes once, against matplotlib's, which measures it in each of two passes."""

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from PIL import Image

from vipetsc.figures.layout import lay_out
from vipetsc.figures.style import new_figure, rc_style, save


@pytest.mark.parametrize("wide", [False, True])
def test_axes_are_placed_as_by_the_layout_that_measures_everything_twice(wide):
    """Axes, those of colour bars too, have the places of matplotlib's layout within a fiftieth of an inch."""

    def pages():
        with rc_style():
            for _ in range(2):
                figure = new_figure(7 if wide else 3.4, 3, "a heading")
                grid = figure.subplots(2, 2, sharex="col", width_ratios=(3, 1))
                image = grid[0, 0].imshow(np.geomspace(1e-7, 1, 12).reshape(3, 4), norm=LogNorm())
                figure.colorbar(image, ax=grid[0], label="energy (J)")
                grid[0, 1].set(title="a title", ylabel="velocity (m/s)", ylim=(-2.5e4, 3e4))
                grid[1, 0].set(xlabel="time (s)", xlim=(0, 0.8125), yscale="log", ylim=(1e-12, 1))
                grid[1, 1].yaxis.tick_right()
                grid[1, 1].set_axis_off()
                yield figure

    ours, theirs = pages()
    lay_out(ours)
    theirs.get_layout_engine().execute(theirs)
    for axes, other in zip(ours.get_axes(), theirs.get_axes(), strict=True):
        inches = np.abs(axes.get_position().get_points() - other.get_position().get_points()) * ours.get_size_inches()
        assert inches.max() < 0.02
        assert "get_tightbbox" not in vars(axes)


def test_a_note_below_a_picture_leaves_the_picture_as_it_is(tmp_path):
    """A note adds a strip below and moves neither axes nor a colour bar, whose frame is smaller than its place."""
    pictures = []
    for note in ("", "a note"):
        with rc_style():
            figure = new_figure(3.4, 2, "a heading")
            axes = figure.subplots()
            figure.colorbar(axes.imshow([[0.0, 1.0]]), ax=axes, label="energy (J)")
            with Image.open(save(figure, tmp_path / "picture.png", note)) as picture:
                pictures.append(np.asarray(picture.convert("RGB")))

    plain, noted = pictures
    assert len(noted) > len(plain)
    # Edges of lines and letters may move by fractions of a pixel.
    differing = np.abs(noted[: len(plain)].astype(int) - plain).max(axis=2) > 64
    assert differing.mean() < 0.01


def test_text_is_measured_again_where_ticks_change(monkeypatch):
    """Text is measured again for axes that the layout shrinks so far that their tick labels have fewer letters."""
    measured = []
    original = Axes.get_tightbbox

    def count(axes, *arguments, **options):
        measured.append(axes)
        return original(axes, *arguments, **options)

    monkeypatch.setattr(Axes, "get_tightbbox", count)
    with rc_style():
        figure = new_figure(3, 2)
        steady, changing = figure.subplots(1, 2)
        steady.set_yticks([1])
        steady.set_xticks([0])
        changing.set_ylabel("a long label\n" * 12)
        lay_out(figure)
    assert measured.count(steady) == 1
    assert measured.count(changing) == 2
