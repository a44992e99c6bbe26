"""Compiled kernels are kept until any of their sources changes."""

from __future__ import annotations

import os
from pathlib import Path

import vipetsc
from vipetsc.compiled import kernel_cache


def test_the_folder_follows_the_sources_that_numba_compiles(tmp_path):
    (tmp_path / "sub").mkdir()
    kernel, caller, other = tmp_path / "kernel.py", tmp_path / "sub" / "caller.py", tmp_path / "other.py"
    kernel.write_text("from numba import njit\n")
    caller.write_text("from numba import njit\nimport kernel\n")
    other.write_text("import numpy\n")
    first = kernel_cache(tmp_path)
    other.write_text("import scipy\n")
    assert kernel_cache(tmp_path) == first
    kernel.write_text("from numba import njit  # changed\n")
    second = kernel_cache(tmp_path)
    assert second != first
    kernel.write_text("from numba import njit\n")
    caller.rename(tmp_path / "caller.py")
    assert kernel_cache(tmp_path) not in (first, second)


def test_numba_is_told():
    own = str(kernel_cache(Path(vipetsc.__file__).parent))
    assert os.environ["NUMBA_CACHE_DIR"] == own or "kernels-" not in os.environ["NUMBA_CACHE_DIR"]
