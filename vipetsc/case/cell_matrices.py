"""A cell from matrices, as finite-element programs and reductions write them: read once, and translated into springs.

With the rows K_ij of a symmetric stiffness, K u is the force of springs: one of the stiffness -K_ij between each two
degrees of freedom, and one of sum_j K_ij from each of them to the ground. Some are negative, and all of them together
are the matrix. So are the couplings to the next cell, and the dashpots of a damping matrix. Engines, bands and studies
therefore know masses and springs alone.

The masses must be a diagonal matrix, since contacts, drives and points act on the displacements of single masses, of
which the acceleration is a force over a mass. Coordinates in which a full matrix is diagonal are sums of displacements,
also of other cells where it couples these.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile

import numpy as np
import scipy

from vipetsc.case.reading import MISSING
from vipetsc.case.section import Problem
from vipetsc.io.names import file_hash, resolved_path

KEY = "lattice.cell.matrices"
# Every step goes over all springs, and every result lists them: so many take some MB of text.
MOST_SPRINGS = 20_000
# Differences that are rounding, relative to the sizes that the diagonal allows: programs write six to sixteen digits.
SYMMETRIC = 1e-6
ROUNDING = 1e-12
NAMES = ("M", "K", "C", "K_next", "C_next")
FILLED = {"masses", "springs", "grounding", "from_matrices"}  # keys of a cell that matrices fill in


class MatrixError(ValueError):
    """Matrices that make no cell; the message says why, and what to do."""


class BoundaryError(MatrixError):
    """Rows on boundaries that are none of the matrices'."""


class _Assembled(NamedTuple):
    """A matrix ``inside`` the cell (dof, dof), what its neighbours add included, and its coupling to the ``next`` one.

    A row of ``next`` (dof, dof) is that of the cell, a column that of the next cell.
    """

    inside: np.ndarray
    next: np.ndarray


def with_matrices(table: dict[str, Any]) -> tuple[dict[str, Any], list[Problem]]:
    """Return ``table`` with the masses, springs and dashpots of the cell whose matrices it names, and problems with it.

    ``from_matrices`` takes the place of the names: results are read where the files are gone. Names that are given for
    such a cell, by a sweep for instance, replace the matrices that it was made of.
    """
    lattice = table.get("lattice")
    # Types are not checked yet.
    cell = lattice.get("cell") if isinstance(lattice, dict) else None
    if not isinstance(cell, dict) or not isinstance(lattice, dict):
        return table, []
    if "boundary" in cell and "matrices" not in cell:
        return table, [Problem("lattice.cell.boundary", cell["boundary"], "belongs to matrices; give these, too")]
    names = cell.get("matrices")
    if isinstance(names, str):
        names = [names]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return table, []

    earlier = cell.get("from_matrices")
    if isinstance(earlier, dict):
        cell = {"boundary": earlier.get("boundary")} | {k: v for k, v in cell.items() if k not in FILLED}
    if FILLED & cell.keys():
        return table, [Problem(KEY, cell["matrices"], "give it or masses, springs and grounding, not both")]
    try:
        files = [resolved_path(name) for name in names]
        filled = _translated(_read(files), cell.get("boundary"))
        digests = [file_hash(file) for file in files]
    except FileNotFoundError as error:
        return table, [Problem(KEY, error.filename or cell["matrices"], MISSING)]
    except BoundaryError as error:
        return table, [Problem("lattice.cell.boundary", cell["boundary"], str(error))]
    except MatrixError as error:
        return table, [Problem(KEY, cell["matrices"], str(error))]
    # ValueError: of NumPy and SciPy, for files that are none of theirs.
    except (OSError, ValueError, TypeError, EOFError, BadZipFile) as error:
        return table, [Problem(KEY, cell["matrices"], f"{error}; give an NPZ file, or a list of MatrixMarket files")]

    source: dict[str, Any] = {"files": [str(file) for file in files], "sha256": digests}
    if cell.get("boundary") is not None:
        source["boundary"] = cell["boundary"]
    cell = {key: value for key, value in cell.items() if key not in ("matrices", "boundary")}
    return table | {"lattice": lattice | {"cell": cell | filled | {"from_matrices": source}}}, []


def _read(files: list[Path]) -> dict[str, np.ndarray]:
    """Return the matrices in one NPZ file by their names, or M, K and perhaps C in MatrixMarket files of one each."""
    if len(files) == 1:
        # Arrays outside an archive have no names, and text is no archive: NumPy says so.
        archive = np.load(files[0], allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise MatrixError("is one array, and no archive of M and K by their names")
        with archive:
            arrays: dict[str, Any] = {name: _array(archive, name) for name in archive.files}
        if not {"M", "K"} <= arrays.keys() <= {*NAMES}:
            raise MatrixError(f"has {', '.join(arrays)}; it needs M and K, and may have {', '.join(NAMES[2:])}")
    elif len(files) in (2, 3):
        arrays = {name: scipy.io.mmread(file) for name, file in zip("MKC", files, strict=False)}
    else:
        raise MatrixError("give one NPZ file, or the MatrixMarket files of M, K and, if there is damping, C")

    matrices = {}
    for name, matrix in arrays.items():
        if scipy.sparse.issparse(matrix):
            matrix = matrix.toarray()
        is_real = np.asarray(matrix).dtype.kind in "biuf"
        if not is_real or np.ndim(matrix) != 2 or np.shape(matrix) != arrays["M"].shape[::-1]:
            raise MatrixError(f"{name} is {matrix.dtype}, {np.shape(matrix)}; all must be real, square and of one size")
        matrices[name] = np.asarray(matrix, float)
        if not np.all(np.isfinite(matrices[name])):
            raise MatrixError(f"{name} has entries that are not numbers")
    for name in ("M", "K", "C"):
        if name in matrices:
            matrices[name] = _symmetric(name, matrices[name])
    return matrices


def _array(archive: Mapping[str, Any], name: str) -> np.ndarray:
    """Return the array ``name`` of an archive; raises MatrixError for one of objects, as sparse matrices are."""
    try:
        return np.asarray(archive[name])
    except ValueError as error:
        raise MatrixError(f"{name} is stored as an object: store its full matrix, as {name}.toarray() is") from error


def _symmetric(name: str, matrix: np.ndarray) -> np.ndarray:
    """Return the symmetric part of a ``matrix``; raises MatrixError where it is not all of it."""
    differs = np.argwhere(np.abs(matrix - matrix.T) > SYMMETRIC * _sizes(matrix))
    if len(differs):
        i, j = differs[0]
        values = f"{matrix[i, j]:.6g} and {matrix[j, i]:.6g}"
        raise MatrixError(f"{name} is not symmetric: rows {i + 1} and {j + 1} have {values}; write the whole matrix")
    return (matrix + matrix.T) / 2


def _translated(matrices: dict[str, np.ndarray], boundary: Any) -> dict[str, Any]:
    """Return the keys ``masses``, ``springs`` and ``grounding`` of the cell of these ``matrices``."""
    size = len(matrices["M"])
    left, right = _boundaries(boundary, size)
    if right and {"K_next", "C_next"} & matrices.keys():
        raise MatrixError(
            "has K_next, the coupling to the next cell, which lattice.cell.boundary describes too; remove one"
        )

    none = np.zeros((size, size))
    mass = _assembled(matrices["M"], none, left, right)
    stiffness = _assembled(matrices["K"], matrices.get("K_next", none), left, right)
    damping = _assembled(matrices.get("C", none), matrices.get("C_next", none), left, right)
    if _is_diagonal(stiffness) and not _is_diagonal(mass):
        raise MatrixError("K is diagonal, and M is not: name the files of M, K and C in this order")
    masses = _masses(mass)

    # Within the cell each pair once, to the next cell all.
    springs: list[dict[str, Any]] = []
    for stiffnesses, dampings, next_cell in (
        (np.triu(stiffness.inside, 1), np.triu(damping.inside, 1), False),
        (stiffness.next, damping.next, True),
    ):
        values = np.where(_significant(stiffnesses, stiffness), stiffnesses, 0.0)
        dashpots = np.where(_significant(dampings, damping), dampings, 0.0)
        for i, j in np.argwhere((values != 0) | (dashpots != 0)).tolist():
            spring = {"start": i + 1, "end": j + 1, "stiffness": -float(values[i, j]), "next_cell": next_cell}
            if dashpots[i, j]:
                spring["damping"] = -float(dashpots[i, j])
            springs.append(spring)
    springs += [{"start": 0, "end": i, "stiffness": value} for i, value in enumerate(_to_ground(stiffness), 1) if value]

    if len(springs) > MOST_SPRINGS:
        raise MatrixError(f"has {len(springs)} couplings, of at most {MOST_SPRINGS}; reduce the degrees of freedom")
    for spring in springs:
        if spring["stiffness"] == 0:
            raise MatrixError(
                f"C couples {spring['start']} and {spring['end']}, which K does not; add K there, or remove C"
            )
    filled: dict[str, Any] = {"masses": masses, "springs": springs}
    grounding = _to_ground(damping)
    if any(grounding):
        filled["grounding"] = grounding
    return filled


def _boundaries(boundary: Any, size: int) -> tuple[list[int], list[int]]:
    """Return rows (from 0) of matrices of that ``size`` on the left and the right boundary; [] if none are given."""
    if boundary is None:
        return [], []
    remedy = f"give two lists of equal length, of rows from 1 to {size}, each row once"
    if not (isinstance(boundary, list) and len(boundary) == 2 and all(isinstance(side, list) for side in boundary)):
        raise BoundaryError(remedy)
    rows = [row for side in boundary for row in side]
    if not all(type(row) is int and 1 <= row <= size for row in rows):
        raise BoundaryError(remedy)
    if not boundary[0] or len(boundary[0]) != len(boundary[1]) or len({*rows}) != len(rows):
        raise BoundaryError(remedy)
    left, right = ([row - 1 for row in side] for side in boundary)
    return left, right


def _assembled(matrix: np.ndarray, to_next: np.ndarray, left: list[int], right: list[int]) -> _Assembled:
    """Return a ``matrix`` whose rows ``right`` are rows ``left`` of the next cell, or the cell's and ``to_next``."""
    if not right:
        return _Assembled(matrix, to_next)
    inner = [row for row in range(len(matrix)) if row not in right]
    shared = [inner.index(row) for row in left]
    inside = matrix[np.ix_(inner, inner)].copy()
    inside[np.ix_(shared, shared)] += matrix[np.ix_(right, right)]
    coupling = np.zeros_like(inside)
    coupling[:, shared] = matrix[np.ix_(inner, right)]
    return _Assembled(inside, coupling)


def _masses(mass: _Assembled) -> list[float]:
    """Return the diagonal of the ``mass`` matrix; raises MatrixError if it has other entries, or none there."""
    masses = np.diag(mass.inside)
    if masses.min() <= 0:
        at = int(masses.argmin()) + 1
        raise MatrixError(
            f"M has {masses.min():.6g} for degree of freedom {at}: give it a mass, or remove it by condensation"
        )
    if not _is_diagonal(mass):
        i, j = np.argwhere(_couplings(mass))[0] + 1
        # One that couples with itself does so from cell to cell.
        other = f"{j}"
        if i == j:
            other = f"{j} of the next cell"
        reason = "contacts, drives and points act on single masses"
        remedy = "have the program write lumped masses, rotary inertia included"
        raise MatrixError(f"M couples degrees of freedom {i} and {other}, but {reason}: {remedy}")
    return masses.tolist()


def _couplings(matrix: _Assembled) -> np.ndarray:
    """Return whether each entry (dof, dof) of a ``matrix`` couples two degrees of freedom, or a cell to the next."""
    off_diagonal = matrix.inside - np.diag(np.diag(matrix.inside))
    return np.asarray(_significant(off_diagonal, matrix) | _significant(matrix.next, matrix))


def _is_diagonal(matrix: _Assembled) -> bool:
    """Return whether a ``matrix`` couples nothing."""
    return not _couplings(matrix).any()


def _significant(values: np.ndarray, matrix: _Assembled) -> np.ndarray:
    """Return whether each of the ``values`` (dof, dof) of a ``matrix`` is more than rounding beside its diagonal."""
    return np.asarray(np.abs(values) > ROUNDING * _sizes(matrix.inside))


def _sizes(matrix: np.ndarray) -> np.ndarray:
    """Return what the entries (dof, dof) of a semidefinite ``matrix`` are at most in magnitude, by its diagonal.

    Translations and rotations have different units, so that one size for all would be wrong.
    """
    diagonal = np.sqrt(np.abs(np.diag(matrix)))
    return np.outer(diagonal, diagonal)


def _to_ground(matrix: _Assembled) -> list[float]:
    """Return the sums of the rows (dof,) of a ``matrix`` over all cells: what pulls when all moves alike."""
    blocks = np.concatenate([matrix.inside, matrix.next, matrix.next.T], axis=1)
    sums = blocks.sum(axis=1)
    is_rounding = np.abs(sums) <= ROUNDING * np.abs(blocks).sum(axis=1)
    return np.where(is_rounding, 0.0, sums).tolist()
