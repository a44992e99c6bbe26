"""The key of the package's sources, by which results that another state of the program has begun are recognised."""

import hashlib
import os
from functools import cache
from pathlib import Path

import vipetsc

# Rooms that change no number of a result.
WITHOUT_NUMBERS = "cli", "figures", "manual", "examples", "__pycache__"
SUFFIXES = ".py", ".csv", ".toml"


@cache
def source_key() -> str:
    """Return the version with a hash of the sources that results follow from; it takes 13 ms of CPU, once a process."""
    return f"{vipetsc.__version__}+{hash_of(Path(vipetsc.__file__).parent)}"


def hash_of(root: Path) -> str:
    """Return a hash of the files below ``root`` that numbers follow from, with their paths there."""
    digest = hashlib.blake2b(digest_size=8)
    for folder, rooms, names in os.walk(root):
        # In place: os.walk goes on with these.
        rooms[:] = sorted(room for room in rooms if room not in WITHOUT_NUMBERS)
        for name in sorted(names):
            if name.endswith(SUFFIXES):
                path = Path(folder, name)
                digest.update(f"{path.relative_to(root).as_posix()}\0".encode() + path.read_bytes())
    return digest.hexdigest()
