"""Chapters of the manual: their names, part by part, and their Markdown."""

import itertools
import re
from importlib.resources import files

from vipetsc.case import keys

# The chapter that no file holds: it is made from the schema of case files.
KEYS = "case-keys"


def parts() -> dict[str, list[str]]:
    """Return the names of the manual's chapters by the title of their part, as its index lists them."""
    sections = re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", chapter("index"), flags=re.M | re.S)
    listed = {title: re.findall(r"^\| \[[^]]*\]\(([\w-]+)\.md\)", text, flags=re.M) for title, text in sections}
    # The index has no link to the chapter without a file.
    listed["Reference"].append(KEYS)
    return {title: names for title, names in listed.items() if names}


def studies() -> list[str]:
    """Return names of the gallery's pages."""
    return re.findall(r"\]\((gallery/\S+)\.md\)", chapter("gallery"))


def chapter(name: str) -> str:
    """Return the Markdown of the chapter ``name``, from its file or from the schema."""
    if name == KEYS:
        return keys.chapter()
    return (files("vipetsc") / "manual" / f"{name}.md").read_text(encoding="utf-8")


def title(name: str) -> str:
    """Return the title of the chapter ``name``."""
    return chapter(name).partition("\n")[0].removeprefix("# ")


def contents() -> str:
    """Return names and titles of the chapters, part by part, as lines of text."""
    listed = parts()
    width = max(map(len, itertools.chain(*listed.values())))
    lines = []
    for part, names in listed.items():
        lines.append(part)
        for name in names:
            lines.append(f"  {name:<{width}}  {title(name)}")
    return "\n".join(lines)
