"""Compiled functions of other programs in the same process, and their caches, are left as they are."""

import os
import subprocess
import sys
from pathlib import Path

USERS = """
import sys
from typing import NamedTuple
import numba
import numpy as np

class Record(NamedTuple):
    numbers: np.ndarray
    scale: float

@numba.njit(cache=True)
def inner(record):
    return record.numbers[0] * record.scale + record.numbers[1]

@numba.njit
def outer(record):
    return inner(record) + 1.0

record = Record(np.array([2.0, 3.0]), 5.0)
"""
ALONE = "from users import *; print(inner(record), outer(record), sum(inner.stats.cache_hits.values()))"
BESIDE = f"from vipetsc import simulate; import vipetsc.contact.law; {ALONE}"


def run(text: str, folder: Path) -> list[float]:
    """Return the numbers that a process of its own prints, which runs ``text`` with numba's cache in ``folder``."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONPATH": str(folder)}
    done = subprocess.run([sys.executable, "-c", text], env=environment, capture_output=True, text=True, check=True)
    return [float(word) for word in done.stdout.split()]


def test_a_users_cached_function_works_with_and_without_the_package(tmp_path):
    """A function that takes a named tuple of arrays is cached by one process and called from the cache by the next."""
    (tmp_path / "users.py").write_text(USERS)
    assert run(BESIDE, tmp_path) == [13.0, 14.0, 0.0]
    assert run(ALONE, tmp_path) == [13.0, 14.0, 1.0]
