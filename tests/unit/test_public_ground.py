"""The package stands on the public interfaces of its libraries, and leaves their state as it is."""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import vipetsc

ROOT = Path(vipetsc.__file__).parent
SOURCES = sorted(ROOT.rglob("*.py"))
# Of numba, what its manual describes for users and for extensions.
OF_NUMBA = {"numba", "numba.types", "numba.extending", "numba.experimental"}
# Documented names of the standard library that begin with an underscore.
DOCUMENTED = {"_exit", "_MEIPASS"}
# Signals, processes and settings by which one part of a program interrupts or tunes another.
TRICKS = {
    *("memfd_create", "forkserver", "fork", "SIGALRM", "SIGIO", "alarm", "setitimer", "sigtimedwait"),
    *("set_threshold", "freeze"),
}


def is_private(name: str) -> bool:
    """Whether a dotted ``name`` has a part with one leading underscore."""
    return any(part.startswith("_") and not part.endswith("__") and part not in DOCUMENTED for part in name.split("."))


def is_foreign(module: str) -> bool:
    """Whether a ``module`` is not the package's own."""
    return module.split(".")[0] not in ("vipetsc", "__future__")


def imported(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Yield the local name and the full dotted name of all that a file imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.asname or alias.name.split(".")[0], alias.name
        elif isinstance(node, ast.ImportFrom):
            for alias in node.names:
                yield alias.asname or alias.name, f"{node.module}.{alias.name}"


def chain(node: ast.expr) -> list[str]:
    """Return the names of ``a.b.c``; nothing of any other expression."""
    if isinstance(node, ast.Name):
        return [node.id]
    if isinstance(node, ast.Attribute) and chain(node.value):
        return [*chain(node.value), node.attr]
    return []


def assigned(tree: ast.AST) -> Iterator[ast.expr]:
    """Yield what a file assigns to or deletes, also by ``setattr``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign | ast.Delete):
            yield from node.targets
        elif isinstance(node, ast.AugAssign | ast.AnnAssign):
            yield node.target
        elif isinstance(node, ast.Call) and chain(node.func) in (["setattr"], ["delattr"]):
            yield ast.Attribute(node.args[0], "")


def broken_rules(text: str) -> list[str]:
    """Return what the source ``text`` does that it must not, as short descriptions."""
    tree = ast.parse(text)
    names = dict(imported(tree))
    foreign = {local: name for local, name in names.items() if is_foreign(name)}
    others = {local for local, name in foreign.items() if name.split(".")[0] not in sys.stdlib_module_names}
    own_classes = {node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
    found = []

    for name in foreign.values():
        if is_private(name):
            found.append(f"imports {name}")
        if name.split(".")[0] == "llvmlite":
            found.append(f"imports {name}")
        if name.split(".")[0] == "numba" and name.rpartition(".")[0] not in OF_NUMBA and name not in OF_NUMBA:
            found.append(f"imports {name}")

    for target in assigned(tree):
        words = chain(target)
        if len(words) > 1 and words[0] in others:
            found.append(f"assigns to {'.'.join(words)}")

    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            words = chain(node)
            if words and words[0] in foreign and is_private(".".join(words[1:])):
                found.append(f"uses {'.'.join(words)}")
            if node.attr in TRICKS:
                found.append(f"uses {node.attr}")
        if isinstance(node, ast.Name | ast.alias) and (getattr(node, "id", "") or getattr(node, "name", "")) in TRICKS:
            found.append("uses a trick")
        if isinstance(node, ast.Call) and chain(node.func)[-1:] in (["register_model"], ["register_default"]):
            words = chain(node.args[0])
            if words[0] not in own_classes:
                found.append(f"registers a model of {'.'.join(words)}")
    return found


def test_no_file_uses_what_is_private_to_a_library():
    broken = {path: broken_rules(path.read_text(encoding="utf-8")) for path in SOURCES}
    assert {path: rules for path, rules in broken.items() if rules} == {}


@pytest.mark.parametrize(
    "text",
    [
        "import numpy._core",
        "from matplotlib import _api",
        "from matplotlib._api import check",
        "from numba.core import types",
        "import numba.np.arrayobj",
        "from llvmlite import ir",
        "import numpy as np\nnp.linalg._umath_linalg",
        "import matplotlib.axis as axis\naxis.Axis._update_ticks",
        "import matplotlib.axis as axis\naxis.Axis.draw = None",
        "from matplotlib.axis import Axis\nAxis.draw = None",
        "from matplotlib.axis import Axis\nsetattr(Axis, name, None)",
        "import numba\nnumba.config.CACHE_DIR = 'x'",
        "from numba import extending, types\n@extending.register_model(types.NamedTuple)\nclass A: pass",
        "import os\nos.memfd_create('x')",
        "import signal\nsignal.signal(signal.SIGALRM, f)",
        "from os import fork",
        "import gc\ngc.freeze()",
    ],
)
def test_the_rules_find_what_they_forbid(text):
    assert broken_rules(text)


def class_members(path: Path) -> Iterator[tuple[str, set[str]]]:
    """Yield the top-level classes of a file, each with the names that its body defines."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef):
            functions = {item.name for item in node.body if isinstance(item, ast.FunctionDef)}
            values = {ast.unparse(target) for item in node.body for target in getattr(item, "targets", [])}
            yield node.name, functions | values


def test_no_class_replaces_what_is_private_to_its_base():
    """A method that a library's class has for itself may change or go with each version."""
    replaced = []
    for path in SOURCES:
        module = ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__")
        for name, members in class_members(path):
            private = [member for member in members if is_private(member)]
            if not private or module.endswith("__main__"):
                continue
            bases = getattr(importlib.import_module(module), name).__mro__[1:]
            foreign = [base for base in bases if is_foreign(base.__module__) and base is not object]
            replaced += [
                f"{name}.{member} of {base.__name__}" for member in private for base in foreign if member in vars(base)
            ]
    assert replaced == []
