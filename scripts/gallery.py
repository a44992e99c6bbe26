"""The pictures of the manual's chapter ``gallery``: its commands are run as they stand, its figures made small.

    python scripts/gallery.py [FOLDER]

Works in ``FOLDER``, by default a temporary one. A picture ``runs/gallery/RUN.FIGURE`` of the chapter is
``runs/RUN/figures/FIGURE`` there; what is larger than ``MOST`` is a mistake.
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parents[1]
CHAPTER = ROOT / "vipetsc/manual/gallery.md"
WIDTH, COLOURS = 900, 200
MOST = {".png": 100_000, ".gif": 1_500_000}  # bytes


def commands() -> list[list[str]]:
    """The words of every command of the chapter, in its order."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", CHAPTER.read_text(encoding="utf-8"), flags=re.M | re.S)
    return [shlex.split(line, comments=True) for block in blocks for line in block.splitlines() if line.strip()]


def pictures() -> list[Path]:
    """The pictures of the chapter."""
    links = re.findall(r"!\[[^]]*\]\((\S+)\)", CHAPTER.read_text(encoding="utf-8"))
    return [(CHAPTER.parent / link).resolve() for link in links]


def make_small(source: Path, target: Path) -> None:
    """Copy a picture, a PNG in ``COLOURS``, ``WIDTH`` pixels wide; raises ValueError for one too large."""
    if source.suffix == ".png":
        image = Image.open(source).convert("RGB")
        height = round(image.height * min(WIDTH / image.width, 1))
        image = image.resize((min(WIDTH, image.width), height), Image.Resampling.LANCZOS)
        image.quantize(COLOURS, dither=Image.Dither.NONE).save(target, optimize=True)
    else:
        shutil.copyfile(source, target)
    if target.stat().st_size > MOST[source.suffix]:
        raise ValueError(f"{target}: {target.stat().st_size} bytes")


def main(folder: Path) -> None:
    """Run the commands in ``folder``, and renew the pictures."""
    shutil.copytree(ROOT / "runs", folder / "runs", ignore=shutil.ignore_patterns("*.h5"), dirs_exist_ok=True)
    for words in commands():
        subprocess.run([sys.executable, *words[1:]], cwd=folder, check=True)
    for target in pictures():
        run, figure = target.name.split(".", 1)
        make_small(folder / "runs" / run / "figures" / figure, target)
        print(target.relative_to(ROOT))


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(scratch))
