"""Arrays that take long to compute and follow from little, kept between runs in the user's cache.

A file in that folder is named by a hash of what its arrays follow from. Several processes may read and write there at
once: files are complete or absent, and what cannot be read is computed.
"""

import hashlib
import os
import platform
import zlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np
import scipy

import vipetsc
from vipetsc.io.atomic import Arrays, remove_abandoned, save_arrays
from vipetsc.process import cache_folder

# Bytes of all files together; those that were not used for the longest time go first. The modes of the built-in
# lattice take 12 MB, so that those of some twenty such lattices are kept.
LARGEST = 2**28
CHECKSUM = "checksum"


def kept_arrays(kind: str, content: Iterable[bytes], compute: Callable[[], Arrays]) -> dict[str, np.ndarray]:
    """The arrays that ``compute`` gives, from an earlier call with the same ``content`` if they are still kept.

    Arrays from other hosts and from other versions of this package, numpy and SciPy are not used: their last digits may
    differ. A cache that cannot be read or written is no error.

    Parameters
    ----------
    kind
        A word for what the arrays are, with which the file's name begins.
    content
        Everything that the arrays follow from, as bytes.
    compute
        Returns the arrays by name; called only if they are not kept. Shapes and bits are the same either way.
    """
    versions = f"{kind} {vipetsc.__version__} {np.__version__} {scipy.__version__} {platform.node()}"
    digest = hashlib.sha256(versions.encode())
    # A hash of each part's hash, which has one length: two contents that differ only in where one part ends and the
    # next begins are told apart.
    for part in content:
        digest.update(hashlib.sha256(part).digest())

    path = cache_folder() / f"{kind}-{digest.hexdigest()[:32]}.npy"
    arrays = _read(path)
    if arrays is None:
        arrays = dict(compute())
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            save_arrays(path, arrays | {CHECKSUM: _checksum(arrays)})
            remove_abandoned(path.parent)
            _remove_oldest(path.parent)
    return arrays


def _read(path: Path) -> dict[str, np.ndarray] | None:
    """The arrays in a file; None if it is absent or damaged."""
    try:
        # Read whole rather than mapped: the checksums need all values, and another process may remove the file.
        record = np.load(path)
        arrays = {name: record[name] for name in record.dtype.names or ()}
        # The time of the file says when it was used last, for ``_remove_oldest``.
        os.utime(path)
        checksum = arrays.pop(CHECKSUM)
    # For a damaged header numpy raises ValueError, EOFError or SyntaxError; a file without checksums is a KeyError.
    except (OSError, ValueError, EOFError, SyntaxError, KeyError):
        return None
    if not np.array_equal(checksum, _checksum(arrays)):
        return None
    return arrays


def _checksum(arrays: Arrays) -> np.ndarray:
    """The CRC-32 of each of ``arrays`` (array,) with its name, type and shape, which the header of the file has."""
    checksums = []
    for name, values in arrays.items():
        about = f"{name} {values.dtype.descr} {values.shape}".encode()
        checksums.append(zlib.crc32(np.ascontiguousarray(values).data, zlib.crc32(about)))
    return np.array(checksums)


def _remove_oldest(folder: Path) -> None:
    """Remove the files that were not used for the longest time until the others take ``LARGEST`` bytes at most."""
    total = 0
    entries = [(path, path.stat()) for path in folder.glob("*.npy")]
    for path, status in sorted(entries, key=lambda entry: entry[1].st_mtime, reverse=True):
        total += status.st_size
        if total > LARGEST:
            path.unlink(missing_ok=True)
