"""A user-defined numerical part in a shared library (``csrc/rthyb_library.h``), and its trial.

A library is asked for its description when it is loaded. Whether it does anything that is not
allowed in real time is found by a trial in a separate process, so that a crash does not end this
one.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import re
import signal
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.library import CoreError
from rthyb_rt.core.own_interfaces import (
    IN_ORDER,
    Places,
    Stiffness,
    fill_setup,
    interfaces_of_plain,
    plain_interfaces,
    rows_of,
)
from rthyb_rt.core.settings import fill_part
from rthyb_rt.core.sizes import PERIOD_S

LIBRARY_VERSION: Final[int] = lib.RTHYB_LIBRARY_VERSION
FIRST_VERSION: Final[int] = lib.RTHYB_LIBRARY_VERSION_FIRST
RESPONSES_MAX: Final[int] = lib.RTHYB_RESPONSES_MAX
PREFIX: Final = "rthyb_part_"
REQUIRED: Final = ("version", "interfaces", "state_bytes", "init", "answer")
OPTIONAL: Final = ("names", "advance", "freeze", "report", "save", "restore")
_CALLS: Final = ("init", "answer", "advance", "freeze", "report", "save", "restore")
_NAME: Final = re.compile(r"[A-Za-z]\w{0,63}")
_RESPONSE: Final = re.compile(r"([a-z]\w{0,31})(?:\[([^\[\]\s]{1,16})\])?")

Values = tuple[tuple[str, float], ...]
"""Names with their numbers, in the order of the file."""


@dataclass(frozen=True)
class Recorded:
    """A value that a part reports: a channel of the recording."""

    name: str
    unit: str


@dataclass(frozen=True)
class Library:
    """A library that was loaded.

    Attributes:
        path: where it is.
        sha256: of the file.
        functions: address of each function, by its name without the prefix.
        interfaces: number of forces that it receives and of displacements that it returns.
        parameters: names of its parameters, in its own order.
        responses: the values that it reports.
    """

    path: str
    sha256: str
    functions: Mapping[str, int]
    interfaces: int
    parameters: tuple[str, ...]
    responses: tuple[Recorded, ...]

    def call(self, name: str, ctype: str) -> Any:
        """Return a C pointer to a function, NULL if the library does not have it."""
        return ffi.cast(ctype, self.functions.get(name, 0))


def hash_of(path: Path) -> str:
    """Return the SHA-256 of a file.

    Raises:
        CoreError: it cannot be read.
    """
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise CoreError(f"{path} cannot be read ({error.strerror or error})") from error


def check_meant(path: str, found: str, meant: str, what: str) -> None:
    """Compare the SHA-256 of a file with that of the required file; "" accepts any file.

    Raises:
        CoreError: it is a different file.
    """
    if meant and found != meant:
        raise CoreError(
            f"{path} is not {what} that was recorded: its SHA-256 begins with {found[:12]} "
            f"instead of {meant[:12]}; put the recorded file in its place"
        )


def opened(path: Path) -> ctypes.CDLL:
    """Load a shared library.

    Raises:
        CoreError: it is not a library for this machine, or a library that it needs is missing.
    """
    if not path.is_file():
        raise CoreError(f"{path} does not exist; build it first, or correct the path")
    try:
        return ctypes.CDLL(str(path.resolve()))
    except OSError as error:
        raise CoreError(
            f"{path} cannot be loaded ({str(error).removeprefix(str(path.resolve()) + ': ')}); "
            "it must be a shared library for this machine, and every library that it links to "
            "must be installed: cc -O2 -shared -fPIC"
        ) from error


def address(library: ctypes.CDLL, name: str) -> int:
    """Return the address of a function, 0 if the library does not have it."""
    try:
        return ctypes.cast(getattr(library, name), ctypes.c_void_p).value or 0
    except AttributeError:
        return 0


_LOADED: dict[str, Library] = {}


def load(path: str) -> Library:
    """Load a library that contains a numerical part; a second call returns the same object.

    Raises:
        CoreError: stating what it lacks and what it must have.
    """
    place = Path(path).resolve()
    known = _LOADED.get(str(place))
    sha256 = hash_of(place) if place.is_file() else ""
    if known is not None and known.sha256 == sha256:
        return known
    if known is not None:
        raise CoreError(
            f"{place} was rebuilt after this process had loaded it, and a process cannot load a "
            "second library of the same name: rename the new library, or start a new process"
        )
    library = opened(place)
    functions = {name: address(library, PREFIX + name) for name in (*REQUIRED, *OPTIONAL)}
    _check_functions(library, place, functions)
    found = {name: at for name, at in functions.items() if at}
    version = ffi.cast("int32_t(*)(void)", found["version"])()
    if not FIRST_VERSION <= version <= LIBRARY_VERSION:
        raise CoreError(
            f"{place} was built for version {version} of the interface, but this program accepts "
            f"versions {FIRST_VERSION} to {LIBRARY_VERSION}: build it again with the "
            "rthyb_library.h of this program"
        )
    interfaces = ffi.cast("int32_t(*)(void)", found["interfaces"])()
    if not 1 <= interfaces <= lib.RTHYB_INTERFACES_MAX:
        raise CoreError(
            f"{place}: {PREFIX}interfaces returns {interfaces}; it must be from 1 to "
            f"{lib.RTHYB_INTERFACES_MAX}"
        )
    parameters, responses = _names(place, found)
    if "report" in found and not responses:
        raise CoreError(
            f"{place} has a function {PREFIX}report, but {PREFIX}names returns no responses, so "
            'it would never be called: let it return their names with units, such as "roof[m]", '
            f"for RTHYB_PART_RESPONSES, or remove {PREFIX}report"
        )
    loaded = Library(str(place), sha256, found, interfaces, parameters, responses)
    _LOADED[str(place)] = loaded
    return loaded


def _check_functions(library: ctypes.CDLL, path: Path, functions: Mapping[str, int]) -> None:
    lacking = [PREFIX + name for name in REQUIRED if not functions[name]]
    if not lacking:
        return
    mangled = [f"{name}_" for name in lacking if address(library, f"{name}_")]
    hint = (
        f" ({mangled[0]} exists: in Fortran, the function needs bind(C, name = "
        f'"{mangled[0][:-1]}"))'
        if mangled
        else ""
    )
    raise CoreError(
        f"{path} has no function {', '.join(lacking)}{hint}; a numerical part exports "
        f"{', '.join(PREFIX + name for name in REQUIRED)}, as rthyb_library.h declares them"
    )


def _names(path: Path, found: Mapping[str, int]) -> tuple[tuple[str, ...], tuple[Recorded, ...]]:
    """Return the names of a library's parameters, and its responses."""
    if "names" not in found:
        return (), ()
    ask = ffi.cast("void(*)(int32_t, char *)", found["names"])

    def words(of: int) -> list[str]:
        room = ffi.new("char[]", lib.RTHYB_PART_NAMES_ROOM)
        ask(of, room)
        return bytes(ffi.string(room, lib.RTHYB_PART_NAMES_ROOM)).decode(errors="replace").split()

    parameters, said = words(lib.RTHYB_PART_PARAMETERS), words(lib.RTHYB_PART_RESPONSES)
    responses = []
    for word in said:
        match = _RESPONSE.fullmatch(word)
        if match is None:
            raise CoreError(
                f'{path}: {PREFIX}names returns the response "{word}"; a response must be a '
                "name of up to 32 lower-case letters, digits and underscores with its unit, "
                'such as "roof[m]"'
            )
        responses.append(Recorded(match[1], match[2] or ""))
    bad = [word for word in parameters if not _NAME.fullmatch(word)]
    names = [*parameters, *(one.name for one in responses)]
    if bad or len(set(parameters)) < len(parameters) or len(responses) > RESPONSES_MAX:
        raise CoreError(
            f"{path}: {PREFIX}names returns {' '.join(names)}; the names must differ, consist of "
            f"letters, digits and underscores, and include at most {RESPONSES_MAX} responses"
        )
    if responses and "report" not in found:
        raise CoreError(
            f"{path} names responses but has no function {PREFIX}report to return their values"
        )
    return tuple(parameters), tuple(responses)


@dataclass(frozen=True)
class LibraryConfig:
    """Settings of a numerical part in a shared library.

    ``k_e_n_per_m`` and ``place`` as for `fill_setup`. ``parameters`` are given by name, all that
    the library requires; ``sha256`` is that of the required file, "" to accept any file.
    """

    path: str
    k_e_n_per_m: Stiffness
    parameters: Values = ()
    period_s: float = PERIOD_S
    sha256: str = ""
    place: Places = IN_ORDER

    kind: ClassVar[str] = "library"
    what: ClassVar[str] = "the library"

    @functools.cached_property
    def library(self) -> Library:
        """The library.

        Raises:
            CoreError: it cannot be loaded, or is not the required file.
        """
        found = load(self.path)
        check_meant(self.path, found.sha256, self.sha256, self.what)
        return found

    @property
    def responses(self) -> tuple[Recorded, ...]:
        """The responses that are recorded."""
        return self.library.responses

    @property
    def interfaces(self) -> int:
        """The number of its interfaces."""
        return self.library.interfaces

    def values(self) -> list[float]:
        """Return its parameters in its own order.

        Raises:
            CoreError: one is missing, or unknown to the library.
        """
        given, names = dict(self.parameters), self.library.parameters
        return ordered(given, names, Path(self.path).name)

    def struct(self) -> list[Any]:
        """Return the ``rthyb_library_config`` of the C core, and the objects that must outlive it.

        Raises:
            CoreError: the library cannot be loaded, or a parameter is missing.
        """
        library, cfg = self.library, ffi.new("rthyb_library_config *")
        kept = fill_setup(cfg, self, library.interfaces, self.values())
        for name in _CALLS:
            ctype = ffi.typeof("rthyb_part_calls").fields
            setattr(cfg.calls, name, library.call(name, dict(ctype)[name].type))
        size = library.call("state_bytes", "int64_t(*)(const rthyb_part_setup *)")
        cfg.state_bytes = size(ffi.addressof(cfg, "setup"))
        if not 0 <= cfg.state_bytes <= lib.RTHYB_LIBRARY_STATE_MAX:
            raise CoreError(
                f"{self.path}: {PREFIX}state_bytes returns {cfg.state_bytes}; it must be from 0 to "
                f"{lib.RTHYB_LIBRARY_STATE_MAX}"
            )
        cfg.responses = len(library.responses)
        return [cfg, kept]

    def plain(self) -> dict[str, Any]:
        """Return everything as plain values for a recording; `of_plain` restores it."""
        return {
            "kind": self.kind, "path": self.path, "parameters": dict(self.parameters),
            "period_s": self.period_s, "sha256": self.library.sha256, **plain_interfaces(self),
        }  # fmt: skip

    @classmethod
    def of_plain(cls, plain: Mapping[str, Any]) -> LibraryConfig:
        """Return the settings that `plain` described; raises ``KeyError`` or similar."""
        given = {key: value for key, value in plain.items() if key != "kind"}
        given |= {"parameters": tuple(dict(given["parameters"]).items())}
        return cls(**given | interfaces_of_plain(plain))


def ordered(given: Mapping[str, float], names: tuple[str, ...], of: str) -> list[float]:
    """Return the values of parameters in the library's order.

    Raises:
        CoreError: one is missing, or unknown to the library.
    """
    unknown = [name for name in given if name not in names]
    takes = f"it takes {', '.join(names)}" if names else "it takes none"
    if unknown:
        raise CoreError(f"{of} has no parameter {', '.join(unknown)}; {takes}")
    lacking = [name for name in names if name not in given]
    if lacking:
        raise CoreError(f"the parameter {', '.join(lacking)} of {of} is missing; {takes}")
    return [float(given[name]) for name in names]


# ---- the trial ----------------------------------------------------------------------------------

TRIAL_S: Final = 20.0
"""Time after which a trial is ended."""
TRIAL_STEPS: Final = 512
"""Timed steps of a trial for real time; the same number is run under supervision."""
FEW_STEPS: Final = 16
"""The same in virtual time, where only a crash or an endless step matters."""
_STAGES: Final = {
    lib.RTHYB_TRIAL_IN_INIT: "while it was set up",
    lib.RTHYB_TRIAL_IN_STEPS: "in a step",
    lib.RTHYB_TRIAL_WATCHED: "in a step",
}


@dataclass(frozen=True)
class LibraryTrial:
    """Result of the trial of a part; times on this computer, s.

    Attributes:
        step_s, worst_s: median and largest time of a step.
        answer_s: median time between force and displacement.
        allocations: calls of the allocator in the supervised steps.
        system_call: number of a system call that a step made; None if it made none.
        watched: whether this system can forbid system calls.
        steps: number of timed steps; the same number is run under supervision.
        ill: whether a displacement was not finite, implausible or missing.
    """

    step_s: float
    worst_s: float
    answer_s: float
    allocations: int
    system_call: int | None
    watched: bool
    steps: int
    ill: bool


class _RejectedError(CoreError):
    """The part does not accept its settings."""


def _try_out(
    part: Any, k_e_n_per_m: Stiffness, period_s: float, steps: int = TRIAL_STEPS
) -> LibraryTrial:
    """Run the trial of a ``rthyb_numerical``; arguments and errors as for `tried`."""
    found = ffi.new("rthyb_trial *")
    k_e = ffi.new("double[]", [v for row in rows_of(k_e_n_per_m) for v in row])
    lib.rthyb_part_try(part, period_s, k_e, steps, TRIAL_S, found)
    where = _STAGES.get(found.stage, "")
    if found.ended == lib.RTHYB_TRIAL_NOT_TRIED:
        raise CoreError(
            "could not be tried out: the operating system did not start a second process"
        )
    if found.ended == lib.RTHYB_TRIAL_REFUSED:
        raise _RejectedError(f"rejected its settings (its init returned {found.number})")
    if found.ended == lib.RTHYB_TRIAL_CRASHED:
        name = signal.Signals(found.number).name
        raise CoreError(
            f"crashed {where} ({name}, {signal.strsignal(found.number)}); it was run in a "
            "separate process; debug it there"
        )
    if found.ended == lib.RTHYB_TRIAL_ENDED:
        raise CoreError(f"ended the process {where} (exit status {found.number})")
    if found.ended == lib.RTHYB_TRIAL_STUCK:
        raise CoreError(
            f"did not finish {2 * steps} steps within {TRIAL_S:g} s {where}: check for an "
            "endless loop"
        )
    called = found.ended == lib.RTHYB_TRIAL_CALLED
    return LibraryTrial(
        found.step_s, found.worst_s, found.answer_s, int(found.allocations),
        int(found.number) if called else None, bool(found.watched) or called, int(found.steps),
        bool(found.status),
    )  # fmt: skip


def tried(part: Any, steps: int = TRIAL_STEPS) -> LibraryTrial:
    """Run a part with an elastic specimen in a separate process, as a trial.

    Args:
        part: settings of a library or an FMU.
        steps: number of timed steps; the same number is run under supervision.

    Raises:
        CoreError: it rejects its settings, crashes or does not return; or it cannot be loaded.
    """
    slot = ffi.new("rthyb_numerical *")
    kept = fill_part(slot, part)
    try:
        return _try_out(slot, part.k_e_n_per_m, part.period_s, steps)
    except CoreError as error:
        said = part.complaint() if isinstance(error, _RejectedError) and part.kind == "fmu" else ""
        said = f': it says "{said}"' if said else ""
        raise CoreError(f"{Path(part.path).name} {error}{said}") from error
    finally:
        kept.clear()
