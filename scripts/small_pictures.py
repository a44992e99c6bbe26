"""Pictures of the manual: PNGs of few colours and a bounded width, which the package's users download."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

# What a palette holds, less one. With 64 colours a picture has a third fewer bytes, and colours off by 35 of 255 rather
# than by 20.
COLOURS = 255


def save_small(image: Image.Image, target: Path, width: int, most: int) -> None:
    """Save ``image`` to ``target`` as a PNG, at most ``width`` pixels wide; raises ValueError beyond ``most`` bytes."""
    image = image.convert("RGB")
    narrow = min(width, image.width)
    height = round(image.height * narrow / image.width)
    image = image.resize((narrow, height), Image.Resampling.LANCZOS)

    # By coverage rare colours stay, those of lines and of the ends of scales: halving the set of pixels by its median
    # (Pillow's default) leaves colours off by up to 117 of 255, and half as many bytes more.
    few = image.quantize(COLOURS, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(target, optimize=True)
    if target.stat().st_size > most:
        raise ValueError(f"{target}: {target.stat().st_size} bytes, more than {most}")
