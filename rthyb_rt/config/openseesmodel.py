"""The matrices of a user's OpenSees model, by openseespy: mass, damping, stiffness, labels."""

from __future__ import annotations

import contextlib
import io
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.config.matrixfile import MatrixData, check_arrays
from rthyb_rt.errors import InputError

DIRECTIONS: Final[dict[tuple[int, int], tuple[str, ...]]] = {
    (1, 1): ("x",),
    (2, 2): ("x", "y"),
    (2, 3): ("x", "y", "rz"),
    (3, 3): ("x", "y", "z"),
    (3, 6): ("x", "y", "z", "rx", "ry", "rz"),
}
"""Names of a node's degrees of freedom, by the model's ``ndm`` and ``ndf``."""
_SCALE: Final = 1e12
"""Masses and dampings are printed together with the stiffness, so that OpenSees' own solver does
not fail for lack of mass, and multiplied by this factor so that no digits are lost."""


def opensees() -> Any:
    """Return ``openseespy.opensees``.

    Raises:
        InputError: it is not installed, or cannot be loaded.
    """
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            import openseespy.opensees as found
    except ModuleNotFoundError:
        raise InputError(
            'openseespy is not installed; pip install "rthyb-rt[opensees]"', "import-opensees"
        ) from None
    except (ImportError, RuntimeError) as error:
        raise InputError(
            f"openseespy cannot be loaded ({_cause(error)}); on Debian install libblas3 and "
            "liblapack3",
            "import-opensees",
        ) from error
    return found


def _cause(error: BaseException) -> str:
    while error.__cause__ or error.__context__:
        error = error.__cause__ or error.__context__ or error
    return str(error)


def read(model: Path) -> MatrixData:
    """Run a user's script and return the matrices of the model that it builds.

    Args:
        model: a Python file that builds the model with openseespy, without running an analysis.

    Raises:
        InputError: the file does not exist, fails, or builds no model; or an error of
            `matrixfile.check_arrays`.
    """
    if not model.is_file():
        raise InputError("no such file; give the Python file that builds the model", str(model))
    ops = opensees()
    ops.wipe()
    try:
        with _working_in(model.parent):
            runpy.run_path(str(model.resolve()), run_name="__main__")
        return _of_model(ops, str(model))
    except InputError:
        raise
    except SystemExit as error:
        raise InputError(f"the script ended with exit({error.code})", str(model)) from None
    except Exception as error:
        # A user's script may raise anything.
        last = f"{type(error).__name__}: {error}"
        raise InputError(f"the script failed ({last})", f"{model}:{_line(error, model)}") from error
    finally:
        ops.wipe()


@contextlib.contextmanager
def _working_in(folder: Path) -> Iterator[None]:
    """Run a script in its own folder, so that it finds the files there."""
    import os
    import sys

    before = Path.cwd()
    os.chdir(folder)
    sys.path.insert(0, str(folder.resolve()))
    try:
        yield
    finally:
        sys.path.remove(str(folder.resolve()))
        os.chdir(before)


def _line(error: BaseException, model: Path) -> int:
    line, trace = 1, error.__traceback__
    while trace is not None:
        if Path(trace.tb_frame.f_code.co_filename) == model.resolve():
            line = trace.tb_lineno
        trace = trace.tb_next
    return line


def _of_model(ops: Any, where: str) -> MatrixData:
    tags = [int(tag) for tag in ops.getNodeTags() or ()]
    if not tags:
        raise InputError("leaves no model: no nodes exist when it ends", where)
    k = _matrix(ops, (0.0, 0.0, 1.0), where)
    places, n = _places(ops, tags, where), len(k)
    arrays: dict[str, NDArray[Any]] = {"K": k}
    for name, which in (("M", (_SCALE, 0.0, 1.0)), ("C", (0.0, _SCALE, 1.0))):
        arrays[name] = (_matrix(ops, which, where) - k) / _SCALE
    if sorted(places) != list(range(n)):
        raise InputError(
            f"has {n} equations for {len(places)} degrees of freedom: constraints couple some of "
            "them; condense those in the script, or remove the constraint",
            where,
        )
    labels = [places[i] for i in range(n)]
    ways = sorted({label.rpartition(".")[2] for label in labels} & {"x", "y", "z"})
    arrays["labels"] = np.array(labels)
    arrays["directions"] = np.array(ways)
    arrays["influence"] = np.array(
        [[1.0 if label.endswith(f".{way}") else 0.0 for way in ways] for label in labels]
    )
    if not np.any(arrays["C"]):
        del arrays["C"]
    return check_arrays(arrays, where)


def _matrix(ops: Any, which: tuple[float, float, float], where: str) -> NDArray[np.float64]:
    """Return a term of the effective matrix, (n, n)."""
    ops.wipeAnalysis()
    ops.constraints("Transformation")
    ops.numberer("Plain")
    ops.system("FullGeneral")  # the others print nothing
    ops.algorithm("Linear")
    ops.integrator("GimmeMCK", *which)
    ops.analysis("Transient")
    ops.analyze(1, 0.0)  # assembles, even if it cannot solve
    values = np.array(ops.printA("-ret"), dtype=np.float64)
    n = round(np.sqrt(values.size))
    if n == 0 or n * n != values.size:
        raise InputError("leaves a model without any free degree of freedom", where)
    return values.reshape(n, n)


def _places(ops: Any, tags: list[int], where: str) -> dict[int, str]:
    """Return the labels of the equations in their order.

    OpenSees lists the equations of a constrained node (``equalDOF``, ``rigidDiaphragm``) in another
    order: first its own, without the constrained ones, then those of the node that it follows,
    which that node labels.
    """
    found: dict[int, str] = {}
    constrained = {int(tag) for tag in ops.getConstrainedNodes() or ()}
    for tag in tags:
        dofs = [int(one) for one in ops.nodeDOFs(tag)]
        dimensions = len(ops.nodeCoord(tag))
        names = DIRECTIONS.get((dimensions, len(dofs))) or tuple(
            str(i + 1) for i in range(len(dofs))
        )
        if tag in constrained:
            follow = {int(dof) for dof in ops.getConstrainedDOFs(tag)}
            names = tuple(name for i, name in enumerate(names) if i + 1 not in follow)
            dofs = dofs[: len(names)]
        for name, equation in zip(names, dofs, strict=True):
            if equation >= 0:
                found[equation] = f"{tag}.{name}"
    if not found:
        raise InputError("leaves a model without any free degree of freedom", where)
    return found
