"""The manual as pages: its chapters, every key of a case file, and the Python interface from the docstrings.

    python scripts/manual_pages.py [FOLDER] [--python PACKAGE ...]

Everything becomes Markdown in ``FOLDER/source``, which Sphinx reads through MyST; warnings are errors. The interface is
read from the sources, not imported, so that neither PETSc nor compiled kernels are needed. Docstrings are Markdown as
they stand: indented formulas are code.

Formulas are LaTeX, which MathJax sets in the reader's browser. The pages contain one file of MathJax that needs no
other, from the package sphinx-mathjax-offline, so that they can be read without a network. As an extension of Sphinx,
that package would add all of MathJax, 24 MB. There are two alternatives: pictures of formulas (sphinx.ext.imgmath) need
LaTeX where pages are built, and neither scale nor follow a dark theme; KaTeX needs sixty files of fonts.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import shutil
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.util.docutils import docutils_namespace

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

import vipetsc
from vipetsc.cli.verbs.reference_verbs import KEYS, chapter, parts

PACKAGE = ROOT / "vipetsc"
CHAPTERS = PACKAGE / "manual"
GALLERY = CHAPTERS / "gallery"
NOTEBOOKS = CHAPTERS / "notebooks"
# Names of the pages that are no chapters: the README, and the Python interface.
START = "start"
API = "api"
MATHJAX = "tex-svg.js"  # the version that draws letters as curves, and so needs no fonts
STYLE = "manual.css"
CONFIGURATION = {
    "project": "vipetsc",
    "release": vipetsc.__version__,
    "html_title": f"vipetsc {vipetsc.__version__}",
    "extensions": ["myst_parser"],
    "html_theme": "furo",
    "highlight_language": "none",  # indented formulas in docstrings are no code to highlight
    "myst_enable_extensions": ["amsmath", "colon_fence", "dollarmath"],
    "mathjax_path": MATHJAX,
    "html_css_files": [STYLE],
    "myst_heading_anchors": 3,
    "suppress_warnings": ["ref.python"],  # a name in a signature that two modules have
    "smartquotes": False,  # w' is a velocity
    "html_use_index": False,
    "html_copy_source": False,
    "html_show_sphinx": False,
    "html_show_copyright": False,
}
Named = ast.ClassDef | ast.FunctionDef


def write_sources(folder: Path, packages: list[str]) -> None:
    """Write all pages to ``folder`` as Markdown, with their pictures.

    The interface has pages of ``packages`` only, or of all packages if the list is empty.
    """
    (folder / GALLERY.name).mkdir(parents=True)

    # The README is the first tutorial, and the interface the last of the reference.
    listed = parts()
    listed["Tutorials"] = [START, *listed["Tutorials"]]
    listed["Reference"] = [*listed["Reference"], API]
    index = (CHAPTERS / "index.md").read_text(encoding="utf-8")
    tables = "".join(contents(title, names) for title, names in listed.items())
    put(folder / "index.md", index + tables, CHAPTERS)
    start = (ROOT / "README.md").read_text(encoding="utf-8")
    # In a table of contents the title tells the page's purpose, which the package's name would not.
    put(folder / f"{START}.md", start.replace("# vipetsc", "# Get going", 1), ROOT)
    put(folder / f"{KEYS}.md", chapter(KEYS), CHAPTERS)
    for name in (path.stem for path in CHAPTERS.glob("*.md") if path.stem != "index"):
        text = (CHAPTERS / f"{name}.md").read_text(encoding="utf-8")
        if name == GALLERY.name:
            text += contents("", re.findall(r"\]\((gallery/[\w-]+)\.md\)", text))
        if name == NOTEBOOKS.name:
            text += contents("", [f"notebook-{path.stem}" for path in sorted(NOTEBOOKS.glob("*.ipynb"))], hidden=False)
        put(folder / f"{name}.md", text, CHAPTERS)
    for path in NOTEBOOKS.glob("*.ipynb"):
        put(folder / f"notebook-{path.stem}.md", notebook_page(path), CHAPTERS)
    for path in GALLERY.glob("*.md"):
        text = path.read_text(encoding="utf-8")
        put(folder / GALLERY.name / path.name, text + case_files(text), GALLERY)

    folders = sorted(path.parent for path in PACKAGE.rglob("__init__.py"))
    pages = {dotted(path): interface(path) for path in folders if not packages or dotted(path) in packages}
    put(folder / f"{API}.md", "# The Python interface\n" + contents("", list(pages), hidden=False), CHAPTERS)
    for name, text in pages.items():
        put(folder / f"{name}.md", text, CHAPTERS)


def contents(caption: str, names: list[str], hidden: bool = True) -> str:
    """Return a table of contents with the pages ``names``; if ``hidden``, it is in the margin alone."""
    options = ":maxdepth: 1\n"
    if hidden:
        options = ":hidden:\n"
    if caption:
        options = f":caption: {caption}\n{options}"
    return f"\n```{{toctree}}\n{options}\n" + "\n".join(names) + "\n```\n"


def case_files(text: str) -> str:
    """Return the case files that commands in ``text`` name, as sections of a page."""
    blocks = []
    for name in dict.fromkeys(re.findall(r"\bruns/[\w/-]+\.toml", text)):
        path = ROOT / name
        if path.exists():
            blocks.append(f"\n## {name}\n\n```toml\n{path.read_text(encoding='utf-8')}```\n")
    return "".join(blocks)


def notebook_page(path: Path) -> str:
    """Return the cells of a notebook as a page: text, blocks of code, and the pictures that cells draw."""
    parts = []
    for number, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(text)
            continue

        parts.append(f"```python\n{text}\n```")
        picture = f"pictures/notebook-{path.stem}-{number}.png"
        if (CHAPTERS / picture).exists():
            parts.append(f"![the picture of this cell]({picture})")
    return "\n\n".join(parts) + "\n"


def put(path: Path, text: str, home: Path) -> None:
    """Write a page to ``path``; links in ``text``, relative to the folder ``home``, are changed to those of pages.

    Pictures are copied to the folder of the page. Raises OSError for a link to a file that is not there.
    """
    up = "../" if home == GALLERY else ""

    def link(match: re.Match[str]) -> str:
        target = (home / match[1]).resolve()
        if target == ROOT / "README.md":
            return f"]({up}{START}.md{match[2] or ''})"
        if target.suffix == ".md":
            return f"]({up}{target.relative_to(CHAPTERS)}{match[2] or ''})"
        shutil.copy(target, path.parent / target.name)
        return f"]({target.name})"

    path.write_text(re.sub(r"\]\((?!https?:|#)([^)#\s]+)(#[^)\s]*)?\)", link, text), encoding="utf-8")


def add_static(folder: Path) -> None:
    """Copy MathJax and the style of code, which pages load, to ``_static`` in ``folder``.

    Raises ModuleNotFoundError without the package that has MathJax.
    """
    package = find_spec("sphinx-mathjax-offline")
    if package is None or package.origin is None:
        raise ModuleNotFoundError("pages with formulas need the package sphinx-mathjax-offline (the extra manual)")
    static = folder / "_static"
    static.mkdir(exist_ok=True)
    shutil.copy(Path(package.origin).parent / "static/mathjax" / MATHJAX, static)
    shutil.copy(Path(__file__).parent / STYLE, static)


def dotted(path: Path) -> str:
    """Return the name of a folder or module as it is imported."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def interface(package: Path) -> str:
    """Return the page of a folder: the docstrings of its modules and of their public names."""
    lines = [f"# {dotted(package)}", ""]
    first = package / "__init__.py"
    for path in [first, *sorted(set(package.glob("*.py")) - {first})]:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        module = dotted(package)
        if path != first:
            module = dotted(path)
            lines += [f"## {module}", ""]
        # After an empty directive of the module, names that follow belong to it, and links can lead to it.
        lines += [f":::{{py:module}} {module}", ":::", ""]
        lines += [prose(tree), ""]
        for node in public(tree):
            lines += [*described(node), ""]
    return "\n".join(lines) + "\n"


def public(tree: ast.Module | ast.ClassDef) -> Iterator[Named]:
    """Yield classes and functions of a module, or methods of a class, with a docstring and no leading underscore."""
    seen = set()
    for node in tree.body:
        if isinstance(node, Named) and not node.name.startswith("_") and ast.get_docstring(node):
            # The setter of a property has the name of its getter, which comes first.
            if node.name not in seen:
                yield node
            seen.add(node.name)


def described(node: Named, depth: int = 6) -> Iterator[str]:
    """Yield the lines of the directive of a name: its signature, its docstring and, of a class, the methods within it.

    ``depth`` is the number of colons that open the directive, fewer for one within another.
    """
    inner: list[str] = []
    signature = node.name
    if isinstance(node, ast.ClassDef):
        kind = "class"
        for method in public(node):
            inner += ["", *described(method, depth - 1)]
    elif {ast.unparse(decorator) for decorator in node.decorator_list} & {"property", "cached_property"}:
        kind = "property"
    else:
        # Members of a class stand one level below it.
        kind = "method"
        if depth == 6:
            kind = "function"
        signature += f"({ast.unparse(node.args)})"
        if node.returns:
            signature += f" -> {ast.unparse(node.returns)}"

    yield f"{':' * depth}{{py:{kind}}} {signature}"
    yield prose(node)
    yield from inner
    yield ":" * depth


def prose(node: Named | ast.Module) -> str:
    """Return the docstring of ``node`` as Markdown, in which no character is taken for a heading, a tag or a table."""
    # Headings become bold words: as headings they would enter the page's table of contents.
    text = re.sub(r"(?m)^(.+)\n-{3,}$", r"**\1**\n", ast.get_docstring(node) or "")
    text = text.replace("::\n", ":\n")
    # Every second part is what the pattern matched, and is code, which stays.
    parts = re.split(r"(``.*?``|^ {4}.*$)", text, flags=re.M | re.S)
    for i in range(0, len(parts), 2):
        bold_kept = parts[i].replace("**", "\0")
        parts[i] = re.sub(r"([<*|])", r"\\\1", bold_kept)
    return "".join(parts).replace("\0", "**")


def main(arguments: list[str] | None = None) -> int:
    """Build the pages; returns 1 if there was a warning."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT / "runs/manual", help="runs/manual if left out")
    parser.add_argument("--python", nargs="+", default=[], metavar="PACKAGE", help="of the interface only these")
    options = parser.parse_args(arguments)

    folder = options.folder.resolve()
    source = folder / "source"
    # The sources are written anew, because the page of a removed chapter would stay in the index.
    shutil.rmtree(source, ignore_errors=True)
    write_sources(source, options.python)
    add_static(folder)
    with docutils_namespace():
        app = Sphinx(
            source, None, folder, folder / ".doctrees", "html", CONFIGURATION, status=None, warningiserror=True
        )
        app.build()
    print(f"{folder / 'index.html'}: {len(app.env.found_docs)} pages, {app._warncount} warnings")
    return int(app._warncount > 0)


if __name__ == "__main__":
    sys.exit(main())
