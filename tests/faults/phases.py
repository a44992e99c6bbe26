"""The phases of the verbs: the events ``vipetsc.<phase>`` that the source raises with ``sys.audit``."""

from __future__ import annotations

import ast
from pathlib import Path

import vipetsc

PREFIX = "vipetsc."


def phases() -> set[str]:
    """Return the names of all phases in the source.

    Raises ValueError for a phase whose name is no plain string.
    """
    found = set()
    for path in Path(vipetsc.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "sys.audit":
                # A name that is composed at run time cannot be found here, and no fault would be tested there.
                if not (node.args and isinstance(node.args[0], ast.Constant)):
                    raise ValueError(f"{path}:{node.lineno}: the name of a phase has to be a plain string")
                found.add(str(node.args[0].value).removeprefix(PREFIX))
    return found
