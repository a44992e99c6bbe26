"""The layout of figures and the strip of notes below them."""

import numpy as np
from PIL import Image

from vipetsc.figures.style import new_figure, rc_style, save


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
