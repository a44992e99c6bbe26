"""Where compiled kernels are kept between runs."""

from __future__ import annotations

import hashlib
from pathlib import Path


def kernel_cache(package: Path) -> Path:
    """The cache folder for the kernels of ``package``, named by the hash of all its sources that numba compiles.

    Numba looks at a kernel's own file alone: a kernel that calls a changed one in another file would go on with the
    old code.
    """
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        text = path.read_bytes()
        if b"numba" in text:
            digest.update(str(path.relative_to(package)).encode() + b"\0" + text)
    return package / "__pycache__" / f"kernels-{digest.hexdigest()[:16]}"
