"""Type what pages of the manual have a reader type, in one process: ``python -m tests.session STEPS.json``.

A step is a pair: ``file`` with a name and a text, ``python`` with a block of code, ``vipetsc`` with the words of a call
of the program, or ``shell`` with a line for bash. To start an interpreter for each takes longer than most of them do.
"""

from __future__ import annotations

import json
import os
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

# Of a process that has MPI the variables would make mpirun take itself for one of its ranks.
ENVIRONMENT = dict(os.environ)


def do(kind: str, text: str, name: str = "block.py") -> None:
    """Do one step; raise SystemExit if it fails."""
    from vipetsc.__main__ import main

    print(f"+ {kind} {name if kind == 'file' else text}", flush=True)
    if kind == "file":
        with Path(name).open("a", encoding="utf-8") as file:
            file.write(text)
    elif kind == "python":
        Path(name).write_text(text, encoding="utf-8")
        runpy.run_path(name, run_name="__main__")
    elif kind == "vipetsc":
        if main(shlex.split(text, comments=True)):
            raise SystemExit(f"failed: {text}")
    else:
        subprocess.run(["bash", "-ec", f". scripts/activate\n{text}"], env=ENVIRONMENT, check=True)


def type_all(steps: list[list[str]]) -> None:
    """Do all steps. Pictures of this process are coarse; those of commands for bash are not."""
    from tests.coarse import coarse_pictures

    coarse_pictures(setattr)
    for step in steps:
        do(*step)


if __name__ == "__main__":
    _, file = sys.argv
    # PETSc would take words of the command line for its options.
    sys.argv = ["vipetsc"]
    type_all(json.loads(Path(file).read_text(encoding="utf-8")))
