"""Reading the matrices a, b, c of a plant of several axes from an .npz or .mat file."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, Final

import numpy as np

from rthyb_rt.errors import InputError

KEYS: Final = ("a", "b", "c")
MAX_BYTES: Final = 10 * 10**6


def read(path: Path, where: str) -> dict[str, list[list[float]]]:
    """Return the three matrices as rows.

    Args:
        path: path of the file.
        where: location, for messages, that names the file.

    Raises:
        InputError: the file is not readable, lacks a matrix, or one is not a matrix of numbers.
    """
    if path.suffix not in (".npz", ".mat"):
        raise InputError(f"found {path.name}; a plant must be an .npz or .mat file", where)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path} is larger than {MAX_BYTES // 10**6} MB", where)
        values = _of_npz(path) if path.suffix == ".npz" else _of_mat(path, where)
    except FileNotFoundError:
        raise InputError(
            f"found {path}; no such file; a relative path is relative to the folder of the rig "
            "file",
            where,
        ) from None
    except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError) as error:
        raise InputError(f"{path} cannot be read ({error})", where) from error
    found: dict[str, list[list[float]]] = {}
    for key in KEYS:
        if key not in values:
            raise InputError(
                f"{path} has no {key}; found {', '.join(sorted(values)) or 'nothing'}; a plant has "
                "a, b and c: s' = a s + b u, x = c s",
                where,
            )
        matrix = np.asarray(values[key])
        if matrix.ndim != 2 or not np.issubdtype(matrix.dtype, np.number):
            raise InputError(
                f"{path}: {key} has the shape {matrix.shape} of {matrix.dtype}; must be a matrix "
                "of numbers",
                where,
            )
        if np.iscomplexobj(matrix):
            raise InputError(f"{path}: {key} is complex; must be real", where)
        found[key] = [[float(v) for v in row] for row in matrix]
    return found


def _of_npz(path: Path) -> dict[str, Any]:
    with np.load(path, allow_pickle=False) as stored:
        return {key: stored[key] for key in stored.files}


def _of_mat(path: Path, where: str) -> dict[str, Any]:
    try:
        from scipy.io import loadmat
    except ImportError as error:
        raise InputError(
            'SciPy is not installed, and .mat files need it: pip install "rthyb-rt[structures]"; '
            "or write an .npz",
            where,
        ) from error
    return {key: value for key, value in loadmat(path).items() if not key.startswith("__")}
