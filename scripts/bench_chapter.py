"""Puts the tables and the picture of a bench into the manual's chapter ``measurements``."""

from __future__ import annotations

import shutil
from itertools import groupby
from pathlib import Path

from vipetsc.io.atomic import atomic_write, write_text

MANUAL = Path(__file__).parents[1] / "vipetsc" / "manual"
CHAPTER = MANUAL / "measurements.md"
# The first titles of the table of goals. A bench of some parts has some of the goals; the others stay in the table.
GOALS = "goal|measured"
PICTURES = {"work-precision.png": MANUAL / "pictures" / "bench.png"}


def with_tables(chapter: str, measured: str) -> tuple[str, list[str]]:
    """The ``chapter`` with its tables replaced by those in ``measured`` whose first two columns have the same titles.

    Tables of the chapter that were not measured, goals that were not, and all other text remain. The second value has
    the titles of the tables in ``measured`` for which the chapter has no place.
    """
    found = {_titles(table): table for is_table, table in _blocks(measured) if is_table}
    blocks = []
    placed = set()
    for is_table, block in _blocks(chapter):
        titles = ""
        if is_table:
            # The first two titles recognise a table: later ones, such as a commit, change from bench to bench.
            titles = _titles(block)
        if titles in found:
            placed.add(titles)
            before = block
            block = found[titles]
            # Goals of parts that were not measured remain.
            if titles == GOALS:
                block = _with_goals(before, block)
        blocks.append(block)

    left = [titles for titles in found if titles not in placed]
    return "\n".join(blocks) + "\n", left


def _with_goals(before: str, measured: str) -> str:
    """The table of goals ``before`` with the rows of ``measured``, which replace rows of the same name or come last."""
    # A dictionary keeps the order of its keys when values are replaced.
    rows = {_titles(row, columns=1): row for row in before.splitlines()}
    rows |= {_titles(row, columns=1): row for row in measured.splitlines()}
    return "\n".join(rows.values())


def _blocks(text: str) -> list[tuple[bool, str]]:
    """The text in blocks of whole lines, each with whether it is a table."""
    groups = groupby(text.splitlines(), key=lambda line: line.startswith("|"))
    return [(is_table, "\n".join(lines)) for is_table, lines in groups]


def _titles(table: str, columns: int = 2) -> str:
    """The texts in the first ``columns`` of a table's first line, by which a table, or a single row, is recognised."""
    cells = table.splitlines()[0].split("|")
    return "|".join(cell.strip() for cell in cells[1 : columns + 1])


def write_chapter(measured: str, pictures: list[Path]) -> list[str]:
    """Put the tables in ``measured``, and those of ``pictures`` that the manual shows, into the manual.

    Returns the titles of tables for which the chapter has no place.
    """
    text, left = with_tables(CHAPTER.read_text(encoding="utf-8"), measured)
    write_text(CHAPTER, text)
    for picture in pictures:
        if picture.name in PICTURES:
            with atomic_write(PICTURES[picture.name]) as aside:
                shutil.copyfile(picture, aside)
    return left
