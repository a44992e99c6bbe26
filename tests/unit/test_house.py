"""Sizes of functions and files; names that say what they hold; the manual."""

import ast
import re
from pathlib import Path

import vipetsc

ROOT = Path(vipetsc.__file__).parent
SOURCES = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in sorted(ROOT.rglob("*.py"))}
MOST_LINES_IN_A_FILE = 400
MOST_STATEMENTS_IN_A_FUNCTION = 50  # blank lines, comments and docstrings do not count
MOST_ARGUMENTS = 7
COMPILED = {"njit", "jit", "cfunc", "kernel", "inlined"}  # decorators of compiled functions
# Words that were a dialect of this package; the field has names for what they held.
DIALECT = {"awake", "again", "loud", "heard", "alike", "letter", "found", "own", "words", "kept", "there"}


def functions():
    for name, text in SOURCES.items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                yield name, node


def statements(function):
    """How many statements a function has without its docstring, those of the functions in it among them."""
    docstring = ast.get_docstring(function) is not None
    return sum(isinstance(node, ast.stmt) for node in ast.walk(function)) - 1 - docstring


def is_compiled(function):
    for decorator in function.decorator_list:
        called = decorator.func if isinstance(decorator, ast.Call) else decorator
        if (called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")) in COMPILED:
            return True
    return False


def test_files_are_short():
    assert {name: text.count("\n") for name, text in SOURCES.items() if text.count("\n") > MOST_LINES_IN_A_FILE} == {}


def test_functions_are_short():
    long = {f"{name}:{f.name}": statements(f) for name, f in functions()}
    assert {name: count for name, count in long.items() if count > MOST_STATEMENTS_IN_A_FUNCTION} == {}


def test_kernels_take_records():
    counts = {f"{name}:{f.name}": len(f.args.args) for name, f in functions() if is_compiled(f)}
    assert len(counts) > 40
    assert {name: count for name, count in counts.items() if count > MOST_ARGUMENTS} == {}


def test_names_are_the_fields():
    names = set()
    for name, text in SOURCES.items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.arg):
                names.add((name, node.arg))
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                names.add((name, node.id))
            elif isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.add((name, node.name))
    assert {(file, name) for file, name in names if name in DIALECT} == set()


def test_no_private_scipy_and_no_print_outside_the_command_line():
    for name, text in SOURCES.items():
        assert not re.search(r"scipy\.\w+(\.\w+)*\._", text), name
        if not name.startswith("cli/"):
            calls = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]
            assert "print" not in {call.func.id for call in calls}, name


def test_every_chapter_is_in_the_index_and_every_link_leads_somewhere():
    manual = ROOT / "manual"
    chapters = {path.name for path in manual.glob("*.md")}
    index = (manual / "index.md").read_text(encoding="utf-8")
    assert set(re.findall(r"\]\((\w[\w-]*\.md)\)", index)) == chapters - {"index.md"}
    for page in [*manual.rglob("*.md"), ROOT.parent / "README.md"]:
        for target in re.findall(r"\]\((?!https:)([^)#]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
    assert (ROOT.parent / "README.md").read_text(encoding="utf-8").count("\n") <= 150


def test_no_two_classes_have_one_name():
    """A name means one thing in the whole package; a private class may repeat one."""
    places = {}
    for file, text in SOURCES.items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(file)

    assert {name: files for name, files in places.items() if len(files) > 1} == {}
