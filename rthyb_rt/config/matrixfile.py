"""Reading the matrices of a structure: .npz, .mat, Matrix Market, CSV.

An .npz or .mat file contains the arrays ``M`` and ``K``, and optionally ``C``, (n, n), dense or
sparse as SciPy stores them; ``labels``, n strings; ``influence``, n numbers, or n rows with a
column for each of ``directions``. Units are SI. Sparse .npz matrices: ``M_row``, ``M_column``,
``M_value``.
"""

from __future__ import annotations

import base64
import io
import itertools
import re
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.config.fields import nearest, written
from rthyb_rt.config.structures import MatrixFile, MatrixFiles
from rthyb_rt.core.sparse import SPARSE_MAX, Symmetric
from rthyb_rt.errors import InputError

Floats = NDArray[np.float64]

SYMMETRY: Final = 1e-6
"""Relative to the largest entry of two rows: rounding in finite-element output."""
MAX_BYTES: Final = 500 * 10**6
MOST_ENTRY: Final = 1e18
"""Largest entry that the core accepts: no quantity in SI units comes near it."""
MOST_INFLUENCE: Final = 1e6
"""Far beyond a lever arm in any unit: a larger number is another quantity, or a mistake."""
_NAMES: Final = {"mass": "M", "stiffness": "K", "damping": "C"}


@dataclass(frozen=True, eq=False)
class MatrixData:
    """Content of a file of matrices.

    Attributes:
        mass_kg, stiffness_n_per_m, damping_n_s_per_m: (n, n) each; damping None: not given.
        labels: labels of the degrees of freedom, (n,).
        influence: displacements for a unit displacement of the ground, (n,), one for each
            direction.
    """

    mass_kg: Symmetric
    stiffness_n_per_m: Symmetric
    damping_n_s_per_m: Symmetric | None
    labels: tuple[str, ...]
    influence: Mapping[str, Floats]

    @property
    def size(self) -> int:
        """The number of degrees of freedom."""
        return self.mass_kg.size

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the content as the arrays of an .npz file."""
        found: dict[str, NDArray[Any]] = {
            "labels": np.array(self.labels),
            "size": np.array(self.size),
        }
        if self.influence:
            found["directions"] = np.array(list(self.influence))
            found["influence"] = np.array(list(self.influence.values())).T
        for name, one in (
            ("M", self.mass_kg), ("K", self.stiffness_n_per_m), ("C", self.damping_n_s_per_m),
        ):  # fmt: skip
            if one is not None:
                found |= {
                    f"{name}_row": one.row, f"{name}_column": one.column, f"{name}_value": one.value
                }  # fmt: skip
        return found

    def packed(self) -> str:
        """Return the content as text, for the recording of a test."""
        held = io.BytesIO()
        np.savez(held, **self.arrays())  # type: ignore[arg-type]
        return base64.b64encode(zlib.compress(held.getvalue(), 9)).decode()


def unpacked(text: str) -> MatrixData:
    """Return the content of text from `MatrixData.packed`.

    Raises:
        InputError: the text is not valid.
    """
    where = "numerical.matrices.data"
    try:
        raw = zlib.decompress(base64.b64decode(text, validate=True))
        with np.load(io.BytesIO(raw), allow_pickle=False) as stored:
            return check_arrays(dict(stored), where)
    except (ValueError, OSError, zlib.error) as error:
        raise InputError(
            f"found text that was not written by this program ({error}); remove the key and give "
            "file instead", where,
        ) from error  # fmt: skip


def read(given: MatrixFile, folder: Path) -> MatrixData:
    """Return the matrices that a test file names.

    Args:
        given: the table of the test file.
        folder: folder to which relative paths refer.

    Raises:
        InputError: a file is missing or not readable, or does not describe a structure; with file,
            place and value.
    """
    if given.files is not None:
        return _of_parts(given.files, folder)
    path = folder / str(given.file)
    readers = {".npz": _npz, ".mat": _mat}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(
            f"file type {written(path.suffix)} is not supported here; a .npz or .mat file holds "
            "all matrices; with Matrix Market (.mtx) or CSV (.csv), give one file per matrix, "
            'files = { mass = "M.mtx", stiffness = "K.mtx" }',
            str(path),
        )
    _check_there(path)
    return check_arrays(reader(path), str(path))


def _check_there(path: Path) -> None:
    if not path.is_file():
        raise InputError(
            "no such file; a relative path is relative to the folder of the test file", str(path)
        )
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise InputError(f"has {size / 1e6:.0f} MB; at most {MAX_BYTES / 1e6:.0f} MB", str(path))


def _npz(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            whole = zipfile.is_zipfile(file)
        if not whole:  # NumPy would advise to load it with pickle, which runs what is in it
            raise InputError(
                "cannot be read as .npz: not an .npz file, or incomplete; write it with "
                "numpy.savez",
                str(path),
            )
        with np.load(path, allow_pickle=False) as stored:
            return dict(stored)
    except ValueError as error:
        raise InputError(
            f"cannot be read as .npz ({error}); store numbers as numbers and labels as text, not "
            "as arrays of Python objects",
            str(path),
        ) from error
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, KeyError, MemoryError) as error:
        raise InputError(f"cannot be read as .npz ({error})", str(path)) from error


def _mat(path: Path) -> dict[str, Any]:
    try:
        from scipy.io import loadmat
        from scipy.io.matlab import MatReadError
    except ImportError:
        raise InputError(
            'SciPy is needed to read .mat files: pip install "rthyb-rt[structures]"', str(path)
        ) from None
    try:
        return {k: v for k, v in loadmat(path).items() if not k.startswith("__")}
    except (
        NotImplementedError, ValueError, OSError, TypeError, MatReadError, KeyError, IndexError
    ) as error:  # fmt: skip
        if _is_hdf5(path):
            raise InputError(
                "is an HDF5 file, as MATLAB writes it with '-v7.3'; files up to version 7 can be "
                "read: save it with save(name, 'M', 'K', '-v7')",
                str(path),
            ) from None
        raise InputError(
            f"cannot be read as a MATLAB file ({error}); save it with save(name, 'M', 'K', '-v7')",
            str(path),
        ) from error


def _is_hdf5(path: Path) -> bool:
    """Return whether a file is HDF5; MATLAB writes 512 bytes of its own in front of it."""
    with path.open("rb") as file:
        begin = file.read(520)
    return _HDF5 in (begin[:8], begin[512:520]) or begin.startswith(b"MATLAB 7.3")


_HDF5: Final = b"\x89HDF\r\n\x1a\n"
_GZIP_AT_BEST: Final = 1032
"""Bytes that gzip makes of one."""


def _of_parts(files: MatrixFiles, folder: Path) -> MatrixData:
    """Read a file for each matrix."""
    arrays: dict[str, Any] = {}
    places: dict[str, str] = {}
    for key, name in _NAMES.items():
        given = getattr(files, key)
        if given is not None:
            arrays[name] = _one_matrix(folder / given)
            places[name] = str(folder / given)
    if files.labels is not None:
        path = folder / files.labels
        _check_there(path)
        try:
            lines = path.read_text(encoding="utf-8-sig").replace(",", "\n").splitlines()
        except UnicodeDecodeError as error:
            raise InputError(
                f"is not text in UTF-8 ({error.reason} at byte {error.start}); save it as UTF-8",
                str(path),
            ) from error
        arrays["labels"] = np.array([line.strip() for line in lines if line.strip()])
        places["labels"] = str(path)
    if files.influence is not None:
        arrays["influence"] = _one_matrix(folder / files.influence)
        places["influence"] = str(folder / files.influence)
    return check_arrays(arrays, str(folder), places)


def _one_matrix(path: Path) -> Any:
    _check_there(path)
    try:
        if path.suffix.lower() == ".csv":
            return _csv(path)
        if path.suffix.lower() in (".mtx", ".gz"):
            return _matrix_market(path)
    except ImportError:
        raise InputError(
            'SciPy is needed to read Matrix Market: pip install "rthyb-rt[structures]"', str(path)
        ) from None
    except (ValueError, OverflowError, OSError, EOFError, zlib.error) as error:
        raise InputError(
            f"cannot be read as Matrix Market ({error}{_quoted_line(path, str(error))}); in "
            "coordinate form each line holds row, column and value, both counted from 1",
            str(path),
        ) from error
    raise InputError(
        f"found a file of type {written(path.suffix)}; a single matrix is read from .mtx or .csv",
        str(path),
    )


def _matrix_market(path: Path) -> Any:
    """Return a matrix, dense or sparse; memory is reserved only for what the file can hold."""
    from scipy.io import mminfo, mmread

    rows, columns, entries, *_ = mminfo(path)
    if max(rows, columns) > SPARSE_MAX:
        raise InputError(
            f"found {rows} rows and {columns} columns in its line of sizes; at most {SPARSE_MAX} "
            "degrees of freedom are accepted",
            str(path),
        )
    if entries > path.stat().st_size * (_GZIP_AT_BEST if path.suffix.lower() == ".gz" else 1):
        raise InputError(
            f"found {entries} entries in its line of sizes, more than the file can hold; it is "
            "incomplete, or this number is wrong",
            str(path),
        )
    return mmread(path)


def _quoted_line(path: Path, message: str) -> str:
    """Return the line of a text file that a message of its reader names, in words."""
    match = re.search(r"line (\d+)", message.lower())
    if match is None or path.suffix.lower() == ".gz":
        return ""
    with path.open(encoding="utf-8", errors="replace") as file:
        line = next(itertools.islice(file, int(match[1]) - 1, None), "").strip()
    return f": {written(line[:60])}"


def _csv(path: Path) -> Floats:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of an empty file, which is refused below
            found = np.loadtxt(path, delimiter=",", ndmin=2, encoding="utf-8-sig")
    except ValueError as error:
        raise InputError(
            _csv_fault(path) or f"cannot be read as CSV ({error})", str(path)
        ) from None
    if not found.size:
        raise InputError("has no numbers; a row of the matrix per line is needed", str(path))
    return found


def _csv_fault(path: Path) -> str | None:
    """Return what makes a CSV file no matrix: line, column and text; None if nothing is found."""
    width, first = 0, 0
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    for number, line in enumerate(text.splitlines(), 1):
        cells = line.partition("#")[0].split(",")
        if cells == [""] or not "".join(cells).strip():
            continue
        for column, cell in enumerate(cells, 1):
            if not _is_number(cell):
                return (
                    f"found {written(cell.strip()[:40])} in line {number}, column {column}; must "
                    "be a number. A CSV file holds the numbers only, without headings: a row of "
                    "the matrix per line, commas between the numbers, a point as the decimal sign"
                )
        width, first = (len(cells), number) if width == 0 else (width, first)
        if len(cells) != width:
            return (
                f"found {len(cells)} numbers in line {number} and {width} in line {first}; every "
                "row must have the same number"
            )
    return None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


# ---- what the arrays mean -----------------------------------------------------------------------


def check_arrays(
    arrays: Mapping[str, Any], where: str, places: Mapping[str, str] | None = None
) -> MatrixData:
    """Return the structure that arrays describe, as in an .npz file.

    Args:
        arrays: the arrays by name.
        where: name of the file for messages.
        places: file of each array, if each has its own.

    Raises:
        InputError: the arrays are invalid; with file, place, value and what is allowed.
    """
    files = places or {}

    def place(name: str) -> str:
        return f"{files.get(name, where)}: {name}"

    found: dict[str, Symmetric] = {}
    for name in ("M", "K", "C"):
        matrix = _matrix(arrays, name, place(name))
        if matrix is not None:
            found[name] = _checked(matrix, place(name))
    missing = [name for name in ("M", "K") if name not in found]
    if missing:
        there = ", ".join(sorted(arrays)) or "nothing"
        near = nearest(missing[0], list(arrays))
        raise InputError(
            f"has no {' and no '.join(missing)}{near}; it must have M (masses, kg) and K "
            f"(stiffnesses, N/m), square and equal in size; found: {there}",
            where,
        )
    n = found["M"].size
    for name, one in found.items():
        if one.size != n:
            raise InputError(
                f"{name} has {one.size} rows and M {n}; all must have the same size",
                files.get(name, where),
            )
    if not 1 <= n <= SPARSE_MAX:
        raise InputError(f"found {n} degrees of freedom; must be 1 to {SPARSE_MAX}", where)
    labels = _labels(arrays.get("labels"), n, place("labels"))
    _check_masses(found["M"], labels, place("M"))
    influence = _influence(arrays, labels, place)
    return MatrixData(found["M"], found["K"], found.get("C"), labels, influence)


def _matrix(arrays: Mapping[str, Any], name: str, where: str) -> Any:
    import scipy.sparse

    if f"{name}_value" in arrays:
        n, (row, column, value) = _entries(arrays, name, where)
        upper = scipy.sparse.coo_matrix((value, (row, column)), shape=(n, n))
        return upper + scipy.sparse.triu(upper, 1).T
    if name not in arrays:
        return None
    value = arrays[name]
    if scipy.sparse.issparse(value):
        _check_places(value, where)
        return value
    array = np.asarray(value)
    if array.dtype.kind not in "fiub" or array.ndim != 2:
        raise InputError(
            f"found an array of {array.dtype} and shape {array.shape}; must be a square matrix of "
            "real numbers", where,
        )  # fmt: skip
    return scipy.sparse.coo_matrix(array.astype(np.float64))


def _entries(
    arrays: Mapping[str, Any], name: str, where: str
) -> tuple[int, tuple[NDArray[Any], ...]]:
    """Return the size of a sparse matrix in an .npz file, and row, column and value of its entries.

    Raises:
        InputError: an array is missing or of another kind, or an index is not one of the matrix.
    """
    keys = ["size", *(f"{name}_{part}" for part in ("row", "column", "value"))]
    missing = [key for key in keys if key not in arrays]
    if missing:
        raise InputError(
            f"has {name}_value but no {' and no '.join(missing)}; a sparse matrix is stored as "
            f"{', '.join(keys[1:])}, with size", where,
        )  # fmt: skip
    size, row, column = (_whole_numbers(np.asarray(arrays[key]), key, where) for key in keys[:3])
    value = np.asarray(arrays[keys[3]]).ravel()
    if value.dtype.kind not in "fiub" or size.size != 1:
        what = f"{keys[3]} of {value.dtype}" if size.size == 1 else f"size with {size.size} numbers"
        raise InputError(f"found {what}; must be real numbers, and size a single one", where)
    n = int(size[0])
    if not 1 <= n <= SPARSE_MAX:
        raise InputError(f"found size = {n}; must be 1 to {SPARSE_MAX}", where)
    if not row.size == column.size == value.size:
        raise InputError(
            f"found {row.size} rows, {column.size} columns and {value.size} values; there must be "
            "one of each for every entry", where,
        )  # fmt: skip
    for key, places in ((keys[1], row), (keys[2], column)):
        bad = np.flatnonzero((places < 0) | (places >= n))
        if bad.size:
            raise InputError(
                f"found {key} = {places[bad[0]]} for entry {bad[0] + 1}; must be 0 to {n - 1}: "
                "rows and columns are counted from 0",
                where,
            )
    below = np.flatnonzero(row > column)
    if below.size:
        i, j = row[below[0]], column[below[0]]
        raise InputError(
            f"found row {i}, column {j} for entry {below[0] + 1}, below the diagonal; store the "
            "upper triangle only (row <= column), the rest follows from symmetry", where,
        )  # fmt: skip
    return n, (row, column, value)


def _whole_numbers(given: NDArray[Any], key: str, where: str) -> NDArray[np.int64]:
    whole = given.dtype.kind in "iu" or (
        given.dtype.kind == "f" and bool(np.all(np.abs(given) < 2**53) and np.all(given % 1 == 0))
    )
    if not whole:
        raise InputError(f"found {key} of {given.dtype}; must be whole numbers", where)
    return given.astype(np.int64).ravel()


def _check_places(matrix: Any, where: str) -> None:
    """Reject a sparse matrix of a MATLAB file whose places are not all in it, as in a damaged one.

    SciPy does not look at them before it computes.
    """
    n, columns = matrix.shape
    if matrix.format == "csc":
        bad = np.flatnonzero((matrix.indices < 0) | (matrix.indices >= n))
        if bad.size:
            column = int(np.searchsorted(matrix.indptr, bad[0], side="right"))
            raise InputError(
                f"found an entry in row {matrix.indices[bad[0]] + 1} of column {column}; the "
                f"matrix has {n} rows and {columns} columns. The file is damaged: save it again",
                where,
            )
    try:
        matrix.tocoo()
    except ValueError as error:
        raise InputError(
            f"is not a sparse matrix ({error}). The file is damaged: save it again", where
        ) from error


def _checked(matrix: Any, where: str) -> Symmetric:
    import scipy.sparse

    rows, columns = matrix.shape
    if rows != columns or rows == 0:
        raise InputError(f"has {rows} rows and {columns} columns; must be square", where)
    coo = scipy.sparse.coo_matrix(matrix)
    if coo.data.dtype.kind == "c":
        raise InputError("has complex numbers; must be real", where)
    bad = np.flatnonzero(~(np.abs(coo.data) <= MOST_ENTRY))
    if bad.size:
        i, j, value = coo.row[bad[0]], coo.col[bad[0]], coo.data[bad[0]]
        what = (
            f"must be from {-MOST_ENTRY:g} to {MOST_ENTRY:g}, in kg, N/m or N s/m: check the units "
            "and the exponent"
            if np.isfinite(value)
            else "every number must be finite"
        )
        raise InputError(f"found {value} in row {i + 1}, column {j + 1}; {what}", where)
    csr = coo.tocsr().astype(np.float64)
    apart = abs(csr - csr.T).tocoo()
    largest = abs(csr).max(axis=1).toarray().ravel()
    allowed = SYMMETRY * np.maximum(largest[apart.row], largest[apart.col])
    wrong = np.flatnonzero(apart.data > allowed)
    if wrong.size:
        worst = wrong[np.argmax(apart.data[wrong])]
        i, j = int(apart.row[worst]), int(apart.col[worst])
        raise InputError(
            f"found {csr[i, j]:g} in row {i + 1}, column {j + 1} and {csr[j, i]:g} in row {j + 1}, "
            f"column {i + 1}; the matrix must be symmetric: the two must be equal",
            where,
        )
    return Symmetric.of(0.5 * (csr + csr.T))


def _check_masses(mass: Symmetric, labels: tuple[str, ...], where: str) -> None:
    diagonal = np.zeros(mass.size)
    on = mass.row == mass.column
    diagonal[mass.row[on]] = mass.value[on]
    bad = np.flatnonzero(diagonal < 0.0)
    if bad.size:
        at = bad[0]
        raise InputError(
            f"found a mass of {diagonal[at]:g} kg at {written(labels[at])} (row {at + 1}); must be "
            "0 or more",
            where,
        )
    coupled = np.flatnonzero(~on & ((diagonal[mass.row] == 0.0) | (diagonal[mass.column] == 0.0)))
    if coupled.size:
        k = coupled[0]
        raise InputError(
            f"found {mass.value[k]:g} in row {mass.row[k] + 1}, column {mass.column[k] + 1} "
            "beside a mass of 0 on the diagonal; a degree of freedom without mass must have "
            "zeros in its row and column",
            where,
        )
    if not np.any(diagonal > 0.0):
        raise InputError("found no mass; at least one degree of freedom must have mass", where)


def _labels(given: Any, n: int, where: str) -> tuple[str, ...]:
    if given is None:
        return tuple(str(i + 1) for i in range(n))
    return _names(given, n, "labels", where)


def _names(given: Any, n: int, what: str, where: str) -> tuple[str, ...]:
    """Return n different names from an array of text, or a cell or character array of MATLAB.

    Raises:
        InputError: another number of names, an empty one, or one that occurs twice.
    """
    names = tuple(_text(one) for one in np.asarray(given, dtype=object).ravel())
    if len(names) != n or not all(names):
        raise InputError(f"found {len(names)} {what}; must be {n}, none empty", where)
    if len(set(names)) < n:
        seen: set[str] = set()
        twice = next(one for one in names if one in seen or seen.add(one))  # type: ignore[func-returns-value]
        raise InputError(f"found {written(twice)} twice; must be different", where)
    return names


def _text(one: Any) -> str:
    """Return one name: cells of MATLAB are arrays of one string; its character arrays are padded.

    SciPy returns a cell of an empty string as an array without elements.
    """
    if isinstance(one, np.ndarray):
        one = one.ravel()[0] if one.size else ""
    return str(one).strip()


def _influence(
    arrays: Mapping[str, Any], labels: tuple[str, ...], place: Callable[[str], str]
) -> dict[str, Floats]:
    if "influence" not in arrays:
        return {}
    n, where = len(labels), place("influence")
    given = arrays["influence"]
    given = given.toarray() if hasattr(given, "toarray") else np.asarray(given)
    if given.dtype.kind not in "fiub":
        raise InputError(f"found {given.dtype}; must be numbers", where)
    values = given.astype(np.float64)
    values = values if values.ndim == 2 else values.reshape(-1, 1)
    in_a_row = values.shape[0] != n and values.shape[1] == n
    if in_a_row:
        values = values.T
    if values.shape[0] != n:
        raise InputError(f"has the shape {given.shape}; must have {n} rows", where)
    bad = np.argwhere(~(np.abs(values) <= MOST_INFLUENCE))
    if bad.size:
        at, direction = bad[0]
        row, column = (direction, at) if in_a_row else (at, direction)
        raise InputError(
            f"found {values[at, direction]:g} at {written(labels[at])} (row {row + 1}, column "
            f"{column + 1}); must be from {-MOST_INFLUENCE:g} to {MOST_INFLUENCE:g}: the "
            "displacement for a unit displacement of the ground",
            where,
        )
    given, count = arrays.get("directions"), values.shape[1]
    directions = (
        tuple(str(i + 1) for i in range(count))
        if given is None
        else _names(given, count, "directions", place("directions"))
    )
    return {name: values[:, i].copy() for i, name in enumerate(directions)}
