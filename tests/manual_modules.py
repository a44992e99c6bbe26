"""The users' modules that the manual's chapter *extend* shows, written as files."""

from __future__ import annotations

import re
from pathlib import Path

import vipetsc

CHAPTER = Path(vipetsc.__file__).parent / "manual/extend.md"
MODULE = re.compile(r"file\s+`(\w+\.py)`:\n\n```python\n(.*?)^```$", flags=re.M | re.S)


def write_modules(folder: Path, chapter: Path = CHAPTER) -> list[str]:
    """Write every module that the chapter shows into ``folder``; returns their names."""
    modules = MODULE.findall(chapter.read_text(encoding="utf-8"))
    assert len(modules) == 5
    for name, text in modules:
        (folder / name).write_text(text, encoding="utf-8")
    return [name for name, _ in modules]
