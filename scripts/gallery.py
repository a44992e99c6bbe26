"""Draws the pictures of the manual's gallery again: runs the commands of its pages, and keeps small copies of figures.

    python scripts/gallery.py [--folder FOLDER] [PAGE ...]

The commands of each ``PAGE``, or of all pages if none is given, run in ``FOLDER``, by default a temporary one. The
picture ``RUN.FIGURE`` of a page is a copy of ``runs/RUN/figures/FIGURE`` there. A copy larger than ``MOST`` is refused.
"""

from __future__ import annotations

import argparse
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image
from small_pictures import save_small

ROOT = Path(__file__).parents[1]
INDEX = ROOT / "vipetsc/manual/gallery.md"
# The width of a picture in pixels. Figures of runs have 1400; at 900 they have 60 % of the bytes.
WIDTH = 900
# The gallery is a part of the package that users install: these bounds keep it to a few MB.
MOST = {".png": 125_000, ".gif": 1_500_000}  # bytes


def pages() -> dict[str, Path]:
    """Return the pages of the gallery by name, in the order of its index."""
    names: list[str] = re.findall(r"\]\(gallery/([\w-]+)\.md\)", INDEX.read_text(encoding="utf-8"))
    return {name: INDEX.with_suffix("") / f"{name}.md" for name in names}


def commands(page: Path) -> list[list[str]]:
    """Return the commands in the blocks ``sh`` of a page, in order, each as its words."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    lines = "".join(blocks).splitlines()
    return [shlex.split(line, comments=True) for line in lines if line.strip()]


def pictures(page: Path) -> list[Path]:
    """Return the files of the pictures that a page shows."""
    links = re.findall(r"!\[[^]]*\]\((\S+)\)", page.read_text(encoding="utf-8"))
    return [(page.parent / link).resolve() for link in links]


def make_small(source: Path, target: Path) -> None:
    """Copy a picture, a PNG in few colours and at most ``WIDTH`` pixels wide; raises ValueError if it is too large."""
    most = MOST[source.suffix]
    if source.suffix == ".png":
        save_small(Image.open(source), target, WIDTH, most)
        return

    # A GIF is written in few colours already.
    shutil.copyfile(source, target)
    if target.stat().st_size > most:
        raise ValueError(f"{target}: {target.stat().st_size} bytes, more than {most}")


def make(page: Path, folder: Path) -> None:
    """Run the commands of a page in ``folder``, and renew its pictures."""
    for words in commands(page):
        # Whatever `python` on the path is, the page is run by this interpreter.
        command = [sys.executable if word == "python" else word for word in words]
        # An error ends the script: otherwise pictures of an earlier run would pass for new ones.
        subprocess.run(command, cwd=folder, check=True)
    for target in pictures(page):
        run, figure = target.name.split(".", 1)
        make_small(folder / "runs" / run / "figures" / figure, target)


def main(arguments: list[str] | None = None) -> None:
    """Renew the pictures, and print how long each page took."""
    all_pages = pages()
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("page", nargs="*", default=list(all_pages), help=f"{', '.join(all_pages)}; all if left out")
    parser.add_argument("--folder", type=Path, help="where runs are kept; a temporary one if left out")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.folder or Path(scratch)
        # Commands name case files below runs/. Results there are not copied, so that all are computed.
        shutil.copytree(ROOT / "runs", folder / "runs", ignore=shutil.ignore_patterns("*.h5"), dirs_exist_ok=True)
        for name in options.page:
            begin = time.monotonic()
            make(all_pages[name], folder)
            print(f"{name}: {time.monotonic() - begin:.0f} s", flush=True)


if __name__ == "__main__":
    main()
