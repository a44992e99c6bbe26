"""Chapters of the manual: their names, part by part, and their Markdown as text for a terminal."""

import itertools
import re
from importlib import import_module
from importlib.resources import files
from textwrap import indent

from vipetsc.cli.formulas import FormulaError, formula_text

# Characters of a column, on average over all columns but the last. A table with wider ones holds sentences, and is
# printed as a list.
WIDEST = 40
# Chapters that no file holds, and the modules that write them.
WRITTEN = {"case-keys": "vipetsc.case.keys", "features": "vipetsc.cli.feature_table"}
# Blocks of code, and code in a paragraph, in which $ begins no formula.
CODE = re.compile(r"(^```.*?^```$|`(?:[^`\n]|\n(?!\n))+`)", flags=re.M | re.S)


def parts() -> dict[str, list[str]]:
    """Names of the manual's chapters by the title of their part, as the headings and tables of its index list them."""
    sections = re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", chapter("index"), flags=re.M | re.S)
    listed = {title: re.findall(r"^\| \[[^]]*\]\(([\w-]+)\.md\)", text, flags=re.M) for title, text in sections}
    # No file holds these chapters, and no index links to them.
    listed["Reference"] += WRITTEN
    return {title: names for title, names in listed.items() if names}


def studies() -> list[str]:
    """Names of the gallery's pages."""
    return re.findall(r"\]\((gallery/\S+)\.md\)", chapter("gallery"))


def chapter(name: str) -> str:
    """The Markdown of the chapter ``name``, from its file or from the module that writes it."""
    if name in WRITTEN:
        return str(import_module(WRITTEN[name]).chapter())
    return (files("vipetsc") / "manual" / f"{name}.md").read_text(encoding="utf-8")


def title(name: str) -> str:
    """The title of the chapter ``name``."""
    if name in WRITTEN:
        return str(import_module(WRITTEN[name]).TITLE)
    return chapter(name).partition("\n")[0].removeprefix("# ")


def contents() -> str:
    """Names and titles of the chapters, part by part, as lines of text."""
    listed = parts()
    width = max(map(len, itertools.chain(*listed.values())))
    lines = []
    for part, names in listed.items():
        lines.append(part)
        for name in names:
            lines.append(f"  {name:<{width}}  {title(name)}")
    return "\n".join(lines)


def plain(text: str) -> str:
    """Markdown as text for a terminal: links and pictures by their words, formulas in Unicode, tables in columns."""
    # Pictures before links, whose pattern matches those too.
    text = re.sub(r"!\[([^\]]*)\]\([^)]*\)", r"[picture: \1]", text)
    text = re.sub(r"\[([^\]]+)\]\((?!http)(?:\.\./)?(\w[\w/-]*)\.md(?:#[^)]*)?\)", r"\1 (manual \2)", text)
    text = re.sub(r"\{term\}`([^`<]+?)(?: <[^`]*)?`", r"\1", text)

    # The fences of a directive go; what they hold is text.
    text = re.sub(r"(?ms)^```\{\w+\}.*?\n(.*?)^```$", r"\1", text)
    # Every second piece is what the pattern matched, and is code.
    pieces = CODE.split(text)
    for i in range(0, len(pieces), 2):
        pieces[i] = _without_latex(pieces[i])
    return re.sub(r"(?m)(^\|.*\n)+", lambda rows: _columns(rows[0]), "".join(pieces))


def _without_latex(text: str) -> str:
    """A ``text`` that holds no code, with its formulas in Unicode; displayed ones are indented."""
    text = re.sub(r"(?s)\$\$(.+?)\$\$", lambda shown: indent(_formula(shown[1]), " " * 4), text)
    return re.sub(r"(?s)\$([^$]+?)\$", lambda inline: _formula(inline[1]), text)


def _formula(latex: str) -> str:
    """A formula in Unicode; as it stands if it has LaTeX that no table translates."""
    try:
        return formula_text(latex)
    except FormulaError:
        return latex.strip()


def _columns(rows: str) -> str:
    """The ``rows`` of a Markdown table in aligned columns; a table of sentences as a list, an entry for each row."""
    # An escaped bar is text of a cell.
    cells = [[cell.strip() for cell in re.split(r"(?<!\\)\|", row.strip("|"))] for row in rows.splitlines()]
    # Without the line of dashes below the titles.
    cells = [row for row in cells if not all(re.fullmatch(r":?-+:?", cell) for cell in row)]
    # The last column needs no width: nothing stands after it.
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]) - 1)]
    lines = []
    if sum(widths) > WIDEST * len(widths):
        names = cells[0]
        for row in cells[1:]:
            lines.append(f"  {row[0]}")
            lines += [f"      {name}: {cell}" for name, cell in zip(names[1:], row[1:], strict=False) if cell]
        return "\n".join(lines) + "\n"

    for row in cells:
        # Not strict: the last column has no width.
        padded = [f"{cell:<{width}}" for cell, width in zip(row, widths, strict=False)]
        lines.append("  ".join([*padded, row[-1]]).rstrip())
    return "\n".join(lines) + "\n"
