"""What makes pictures fast and small: formulas parsed once, fonts without typesetting tables, encodings."""

import io

import numpy as np
import pytest
from fontTools.subset import Options
from fontTools.ttLib import TTFont
from matplotlib.backends._backend_pdf_ps import get_glyphs_subset
from matplotlib.font_manager import findfont
from matplotlib.mathtext import MathTextParser
from PIL import Image

from vipetsc.figures.kept_formulas import kept_formulas
from vipetsc.figures.pdf_fonts import plain_fonts
from vipetsc.paper.report import WIDTH, small

LETTERS = "Energy (J) fi 0123 πκ"


def test_more_formulas_than_matplotlib_keeps_are_parsed_once():
    before = MathTextParser._parse_cached
    with kept_formulas():
        parser = MathTextParser("path")
        first = [parser.parse(f"$x_{{{number}}}$") for number in range(70)]
        again = [parser.parse(f"$x_{{{number}}}$") for number in range(70)]
        assert all(a is b for a, b in zip(first, again, strict=True))
    assert MathTextParser._parse_cached is before


def test_plain_fonts_have_the_letters_of_whole_ones():
    path = findfont("DejaVu Sans")
    dropped = Options._drop_tables_default
    with plain_fonts():
        plain = TTFont(get_glyphs_subset(path, LETTERS))
    assert Options._drop_tables_default is dropped
    assert not {"GSUB", "GPOS", "GDEF"} & {*plain.keys()}

    whole = TTFont(path)
    for letter in LETTERS:
        name = plain.getBestCmap()[ord(letter)]
        assert plain["hmtx"][name] == whole["hmtx"][name]
        assert (
            plain["glyf"][name].getCoordinates(plain["glyf"])[0] == whole["glyf"][name].getCoordinates(whole["glyf"])[0]
        )


@pytest.mark.parametrize("is_map", [False, True])
def test_a_report_has_lines_with_all_pixels_and_maps_narrower(is_map):
    pixels = np.full((400, 2 * WIDTH, 3), 255, np.uint8)
    if is_map:
        pixels = np.random.default_rng(0).integers(0, 255, pixels.shape, np.uint8)
    else:
        pixels[200] = (0, 114, 178)

    encoded = small(Image.fromarray(pixels))
    shown = Image.open(io.BytesIO(encoded))
    if is_map:
        assert shown.width == WIDTH
    else:
        assert np.array_equal(np.asarray(shown.convert("RGB")), pixels)
