"""Shared helpers of all Python interfaces of the core: enumerations, error messages, arrays."""

from __future__ import annotations

import platform
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.pending import raise_pending
from rthyb_rt.core.sizes import WINDOW_MAX
from rthyb_rt.errors import RthybError

FloatArray = npt.NDArray[np.float64]
RecordArray = npt.NDArray[np.void]


def members(enum: str, prefix: str) -> dict[str, int]:
    """Return an enumeration of ``rthyb.h`` by value, its names without their common prefix."""
    found: dict[str, int] = ffi.typeof(f"enum {enum}").relements
    own = {k.removeprefix(prefix): v for k, v in found.items() if k.startswith(prefix)}
    return dict(sorted(own.items(), key=lambda item: item[1]))


def words(enum: str, prefix: str) -> dict[str, int]:
    """Return the same in lower case, without the member that gives the count."""
    own = {name.lower(): value for name, value in members(enum, prefix).items()}
    return {name: value for name, value in own.items() if name not in ("count", "kinds")}


def options(enum: str, prefix: str) -> dict[str, int]:
    """Return the same as written in files, with hyphens."""
    return {name.replace("_", "-"): value for name, value in words(enum, prefix).items()}


STATUS: Final = words("rthyb_status", "RTHYB_S_")

_REFUSED: Final[dict[int, str]] = {
    lib.RTHYB_E_PERIOD: "the sampling period must be above 0 s and at most 1 s, and the same "
    "for all parts; every cut-off frequency must be below half the sample rate",
    lib.RTHYB_E_WEIGHTS: "W1 and W2 are outside the stable region |W1| > 1, |W2| < |W1 + 1|",
    lib.RTHYB_E_ESTIMATOR: "a setting of the delay estimator is out of range",
    lib.RTHYB_E_WINDOW: f"the window T0 must be from 1 to {WINDOW_MAX} samples",
    lib.RTHYB_E_STIFFNESS: "the force compensation needs an elastic stiffness k_e > 0 and a "
    "noise >= 0",
    lib.RTHYB_E_MOTION: "the mass must be above 0 and the damping at least 0, and every "
    "number must be finite",
    lib.RTHYB_E_SERVO: "a setting of the actuator model is out of range, or its oil column is too "
    "stiff for its mass and substeps",
    lib.RTHYB_E_ELEMENT: "an element has an unknown kind, the wrong number of parameters, or "
    "a parameter out of range",
    lib.RTHYB_E_SENSOR: "the noise, resolution, offset or range of a sensor is out of range",
    lib.RTHYB_E_LAW: "there is no such control law, or it cannot work with its settings",
    lib.RTHYB_E_KINEMATICS: "the axes do not determine every coordinate of the interface: "
    "there must be as many coordinates as axes, each named once; no pin may be at its own base, "
    "and no two axes may lie on one line",
    lib.RTHYB_E_PLANT: "a size of the virtual plant with several axes is out of range, or one "
    "of its numbers is not finite",
    lib.RTHYB_E_LIMIT: "every limit must be finite and at least 0, and every starting value "
    "finite and plausible",
}


class CoreError(RthybError, ValueError):
    """The core rejected a setting; the message says which."""


class LibraryMissing(CoreError):
    """A package that the structure needs is not installed; the message says how to install it."""


def status_names(code: int) -> list[str]:
    """Return the names of the status bits set in ``code``."""
    return [name for name, bit in STATUS.items() if code & bit]


def version() -> str:
    """Return the version of the compiled core."""
    return text_of(lib.rthyb_version())


def build_facts() -> dict[str, str]:
    """Return what bit-identical replay depends on: source hash, compiler, architecture."""
    return {
        "core_version": version(),
        "core_sources": text_of(lib.rthyb_source_hash()),
        "compiler": text_of(lib.rthyb_compiler()),
        "architecture": platform.machine(),
    }


# ---- conversions -------------------------------------------------------------------------------


def text_of(c_string: Any) -> str:
    raw: bytes = ffi.string(c_string)
    return raw.decode()


def check(error: int) -> None:
    raise_pending()
    if error:
        raise CoreError(_REFUSED.get(error, f"the core rejected its settings (error {error})"))


def doubles(values: npt.ArrayLike) -> FloatArray:
    return np.ascontiguousarray(np.atleast_1d(np.asarray(values, dtype=np.float64)))


def doubles_like(values: npt.ArrayLike, model: FloatArray) -> FloatArray:
    return np.ascontiguousarray(np.broadcast_to(np.asarray(values, np.float64), model.shape))


def require_one_length(first: FloatArray, *others: FloatArray) -> None:
    for other in others:
        if other.shape != first.shape:
            raise CoreError(
                f"found arrays of shapes {first.shape} and {other.shape}; they must have the "
                "same length"
            )


def reading(array: FloatArray) -> Any:
    return ffi.from_buffer("double[]", array)


def writing(array: FloatArray) -> Any:
    return ffi.from_buffer("double[]", array, require_writable=True)


def numbers_of(struct: Any, skip: tuple[str, ...] = ()) -> dict[str, float | int]:
    """Return the scalar fields of a struct; each array element gets an indexed name."""
    numbers: dict[str, float | int] = {}
    for name, description in ffi.typeof(struct[0]).fields:
        if name in skip:
            continue
        value = getattr(struct, name)
        if description.type.kind == "array":
            numbers.update({f"{name}[{i}]": v for i, v in enumerate(value)})
        else:
            numbers[name] = value
    return numbers
