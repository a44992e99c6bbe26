"""Record of finished figures, claims and report, of their inputs and their cost: ``made.json``."""

import json
from pathlib import Path
from typing import Any

from vipetsc.io.atomic import write_text
from vipetsc.paper.plan import read_json

RECORD = "made.json"
FORMATS = ("png", "pdf", "json")
# What files of each kind end with: one that was cut off does not.
LAST = {".png": b"IEND", ".pdf": b"%%EOF", ".json": b"]", ".html": b"</html>"}

BuildRecord = dict[str, Any]
"""Hashes of inputs of "claims" and "report", of "figures" by id with the stems of their pictures.

"cpu": CPU time in s of all ranks that "steps" by name, "figures", "claims" and "report" took.
"""


def read_record(root: Path) -> BuildRecord:
    """Content of ``made.json``, or an empty record, after which everything is computed again."""
    empty = {"figures": {}, "cpu": {"steps": {}, "figures": 0.0, "claims": 0.0, "report": 0.0}}
    return empty | (read_json(root / RECORD) or {})


def write_record(root: Path, record: BuildRecord) -> None:
    """Write ``record`` to ``made.json`` unless the file holds it already."""
    if record != read_record(root):
        write_text(root / RECORD, json.dumps(record, indent=1) + "\n")


def is_whole(path: Path) -> bool:
    """Whether a picture or page is there to its end."""
    if not path.exists():
        return False
    with path.open("rb") as file:
        # The end alone: a file that was cut off lacks its last bytes.
        file.seek(max(path.stat().st_size - 32, 0))
        return LAST[path.suffix] in file.read()


def is_drawn(root: Path, stem: str) -> bool:
    """Whether a picture is there in every format."""
    return all(is_whole(root / "figures" / f"{stem}.{kind}") for kind in FORMATS)
