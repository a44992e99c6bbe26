"""Pictures in the report: lines keep all pixels, maps are made smaller."""

import io

import numpy as np
import pytest
from PIL import Image

from vipetsc.paper.report import WIDTH, small


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
