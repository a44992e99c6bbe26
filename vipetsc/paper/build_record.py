"""``made.json``: the inputs of which figures, claims and report of a folder were made, and the CPU time they took."""

import json
from pathlib import Path
from typing import Any

from vipetsc.io.atomic import write_text
from vipetsc.paper.plan import read_json

RECORD = "made.json"
FORMATS = ("png", "pdf")
# Bytes near the end of every whole file of a kind; a file that was cut off lacks them.
LAST = {".png": b"IEND", ".pdf": b"%%EOF", ".html": b"</html>"}

BuildRecord = dict[str, Any]
"""The content of ``made.json``.

"claims" and "report" are hashes of their inputs. "figures" has for each figure, by id, the hash of its "inputs" and the
stems of its "pictures". "cpu" is CPU time in s of all ranks: of the "steps" by name, of "figures", "claims" and
"report".
"""


def read_record(root: Path) -> BuildRecord:
    """Return the content of ``made.json`` in ``root``; without it an empty record, which makes all but steps anew."""
    empty = {"figures": {}, "cpu": {"steps": {}, "figures": 0.0, "claims": 0.0, "report": 0.0}}
    return empty | (read_json(root / RECORD) or {})


def write_record(root: Path, record: BuildRecord) -> None:
    """Write ``record`` to ``made.json`` unless the file holds it already."""
    if record != read_record(root):
        write_text(root / RECORD, json.dumps(record, indent=1) + "\n")


def is_whole(path: Path) -> bool:
    """Return whether the picture or page ``path`` is there and was not cut off."""
    if not path.exists():
        return False
    with path.open("rb") as file:
        # The last bytes alone: pictures are large, and there are a hundred of them.
        file.seek(max(path.stat().st_size - 32, 0))
        return LAST[path.suffix] in file.read()


def is_drawn(root: Path, stem: str) -> bool:
    """Return whether the picture ``stem`` is there, whole, in each of ``FORMATS``."""
    return all(is_whole(root / "figures" / f"{stem}.{kind}") for kind in FORMATS)
