"""Numbers that stay in an HDF5 file until they are used, for variables of xarray."""

from typing import Any

import numpy as np
from xarray.backends import BackendArray, CachingFileManager
from xarray.core import indexing


class StoredArray(BackendArray):
    """The dataset ``name`` of an HDF5 file, of which only what is indexed is read.

    xarray keeps few files open, and closes those that were not used for long: ``files`` opens the file again.
    """

    def __init__(self, files: CachingFileManager, name: str, shape: tuple[int, ...], dtype: np.dtype) -> None:
        self.shape = shape
        self.dtype = dtype
        self._files = files
        self._name = name

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        """Return the values at ``key``, an array or a number."""
        # h5py takes an array of positions along one axis at most.
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER_1VECTOR, self._read)

    def _read(self, key: tuple[Any, ...]) -> Any:
        """Return values at ``key``: for each axis a number, a slice or, along one of them, an array of positions."""
        positions = tuple(part.tolist() if isinstance(part, np.ndarray) else part for part in key)
        with self._files.acquire_context() as file:
            return file[self._name][positions]
