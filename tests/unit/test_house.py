"""Rules of the source code: sizes of functions, names, prints, links of the manual, marks of tests."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import vipetsc

ROOT = Path(vipetsc.__file__).parent
SOURCES = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in sorted(ROOT.rglob("*.py"))}
# Blank lines, comments and docstrings do not count.
MOST_STATEMENTS_IN_A_FUNCTION = 50
# Words that this package once used as names in place of the field's terms.
DIALECT = {"awake", "again", "loud", "heard", "alike", "letter", "found", "own", "words", "kept", "there"}
DIALECT |= {"told", "made", "way", "beside", "around", "known", "lot"}


# Parsing the package takes a second, and six tests use the same trees.
@cache
def nodes() -> list[tuple[str, ast.AST]]:
    """Return every node of every syntax tree of the package with its file."""
    return [(file, node) for file, text in SOURCES.items() for node in ast.walk(ast.parse(text))]


def functions() -> Iterator[tuple[str, ast.FunctionDef]]:
    """Yield every function of the package under its name with its file."""
    for file, node in nodes():
        if isinstance(node, ast.FunctionDef):
            yield f"{file}:{node.name}", node


def statements(function: ast.FunctionDef) -> int:
    """Count the statements of a function, with those of functions inside it and without its docstring."""
    count = sum(isinstance(node, ast.stmt) for node in ast.walk(function))
    has_docstring = ast.get_docstring(function) is not None
    # The definition itself is a statement, too.
    return count - 1 - has_docstring


def test_functions_are_short():
    """No function has more than 50 statements."""
    lengths = {name: statements(function) for name, function in functions()}
    assert {name: length for name, length in lengths.items() if length > MOST_STATEMENTS_IN_A_FUNCTION} == {}


def test_names_are_the_fields():
    """No argument, variable, function or class has a name of the package's former dialect."""
    names = set()
    for file, node in nodes():
        if isinstance(node, ast.arg):
            names.add((file, node.arg))
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add((file, node.id))
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add((file, node.name))

    assert {(file, name) for file, name in names if name in DIALECT} == set()


def test_the_command_line_alone_prints():
    """Outside ``cli`` no module calls print: its text would stand in the output of every rank."""
    printing = set()
    for file, node in nodes():
        is_call = isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        if is_call and node.func.id == "print" and not file.startswith("cli/"):
            printing.add(file)

    assert printing == set()


def test_every_chapter_is_in_the_index_and_every_link_leads_somewhere():
    """The index lists every chapter, files that the manual links to exist, and the README stays within 150 lines."""
    manual = ROOT / "manual"
    readme = ROOT.parent / "README.md"
    chapters = {path.name for path in manual.glob("*.md")}
    index = (manual / "index.md").read_text(encoding="utf-8")
    assert set(re.findall(r"\]\((\w[\w-]*\.md)\)", index)) == chapters - {"index.md"}

    for page in [*manual.rglob("*.md"), readme]:
        for target in re.findall(r"\]\((?!https:)([^)#]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"

    assert readme.read_text(encoding="utf-8").count("\n") <= 150


def test_the_chapter_on_the_code_names_files_and_functions_that_are_there():
    """Paths of modules in the chapter exist, and so do the names in the rows of what to change where."""
    chapter = (ROOT / "manual/house.md").read_text(encoding="utf-8")
    paths = re.findall(r"`(\w[\w/]*/\w+\.py)`", chapter)
    assert len(paths) > 20
    assert [path for path in paths if not ((ROOT / path).exists() or (ROOT.parent / path).exists())] == []

    rows = chapter.partition("Where to change something:")[2].partition("\n\nEach")[0]
    names = set(re.findall(r"`(_?[a-z]+(?:_[a-z]+)*|[A-Z]\w+)`", rows))
    assert {"refuses", "with_drawn", "_survey", "LAYOUT"} <= names
    together = "\n".join(SOURCES.values())
    assert [name for name in names if not re.search(rf"(def|class) {name}\b|^ *{name}\b.* = ", together, re.M)] == []


def test_docstrings_of_functions_begin_with_a_verb():
    """What a function does is said in the imperative: "Return the pass bands", not "The pass bands"."""
    nouns = {"The", "A", "An", "Whether", "Problems", "Problem", "Numbers", "Names", "Values", "How", "Why", "What"}
    wrong = []
    for file, node in nodes():
        if not isinstance(node, ast.FunctionDef) or any("property" in ast.unparse(d) for d in node.decorator_list):
            continue
        first = (ast.get_docstring(node) or "Return").split()[0]
        if node.returns is not None and ast.unparse(node.returns) != "None" and first in nouns:
            wrong.append((file, node.name))
    assert wrong == []


def test_no_two_classes_have_one_name():
    """A name means one thing in the whole package; a private class may repeat one."""
    places = defaultdict(list)
    for file, node in nodes():
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            places[node.name].append(file)

    assert {name: files for name, files in places.items() if len(files) > 1} == {}
