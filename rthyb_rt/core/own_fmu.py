"""A numerical part in an FMU for co-simulation, FMI 2.0 or 3.0 (``csrc/numerical_fmu.c`` steps it).

The model description is read here by its XML element names, without any other package.
"""

from __future__ import annotations

import atexit
import difflib
import functools
import platform
import shutil
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final
from xml.etree import ElementTree

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.library import CoreError
from rthyb_rt.core.own_interfaces import (
    IN_ORDER,
    Places,
    Stiffness,
    fill_setup,
    interfaces_of_plain,
    plain_interfaces,
)
from rthyb_rt.core.own_library import (
    Recorded,
    Values,
    address,
    check_meant,
    hash_of,
    opened,
)
from rthyb_rt.core.sizes import PERIOD_S

_REALS: Final = ("Float64", "Real")
_FUNCTIONS: Final[dict[int, dict[str, str]]] = {
    2: {
        "instantiate": "fmi2Instantiate",
        "free_instance": "fmi2FreeInstance",
        "setup_experiment": "fmi2SetupExperiment",
        "enter_initialization": "fmi2EnterInitializationMode",
        "exit_initialization": "fmi2ExitInitializationMode",
        "set": "fmi2SetReal",
        "get": "fmi2GetReal",
        "do_step": "fmi2DoStep",
        "terminate": "fmi2Terminate",
    },
    3: {
        "instantiate": "fmi3InstantiateCoSimulation",
        "free_instance": "fmi3FreeInstance",
        "enter_initialization": "fmi3EnterInitializationMode",
        "exit_initialization": "fmi3ExitInitializationMode",
        "set": "fmi3SetFloat64",
        "get": "fmi3GetFloat64",
        "do_step": "fmi3DoStep",
        "terminate": "fmi3Terminate",
    },
}
DESCRIPTION: Final = "modelDescription.xml"
MOST_BYTES: Final = 500 * 10**6
"""Maximum size of the files in an FMU when unpacked."""


@dataclass(frozen=True)
class Variable:
    """A variable of an FMU: reference, causality, whether it is a single real number, unit."""

    reference: int
    causality: str
    real: bool
    unit: str


@dataclass(frozen=True)
class Fmu:
    """An FMU that was unpacked.

    Attributes:
        path: where it is.
        folder: where its files are.
        fmi: 2 or 3.
        name, token: of the model; token is the guid of FMI 2.
        binary: the shared library in it, for this machine.
        variables: by name.
    """

    path: str
    folder: Path
    fmi: int
    name: str
    token: str
    binary: Path
    variables: Mapping[str, Variable]

    def reference(self, name: str, causalities: tuple[str, ...], what: str) -> int:
        """Return the reference of a variable.

        Raises:
            CoreError: no variable has that name, or it is not of an allowed causality.
        """
        found = self.variables.get(name)
        fitting = [n for n, v in self.variables.items() if v.causality in causalities and v.real]
        allowed = f"; of {' or '.join(causalities)} it has {_some(fitting)}"
        if found is None:
            close = difflib.get_close_matches(name, list(self.variables), n=1)
            near = f' (did you mean "{close[0]}"?)' if close else ""
            raise CoreError(f'{what}: {self.name} has no variable "{name}"{near}{allowed}')
        if not found.real:
            raise CoreError(f'{what}: "{name}" is not a single real number{allowed}')
        if found.causality not in causalities:
            raise CoreError(
                f'{what}: "{name}" has the causality {found.causality}; it must be '
                f"{' or '.join(causalities)}{allowed}"
            )
        return found.reference


def _some(names: list[str]) -> str:
    shown = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    return shown or "none"


@functools.lru_cache(maxsize=32)
def unpacked(path: str, sha256: str) -> Fmu:
    """Unpack an FMU into a folder of this process, and read its description.

    Args:
        path: of the FMU.
        sha256: of the file, so that another file of the same path is read again.

    Raises:
        CoreError: it is not an FMU, or not one that can run here; the message says why.
    """
    folder = Path(tempfile.mkdtemp(prefix="rthyb-fmu-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    try:
        with zipfile.ZipFile(path) as archive:
            whole = sum(one.file_size for one in archive.infolist())
            if whole > MOST_BYTES:
                raise CoreError(
                    f"{path} has {whole / 1e6:.0f} MB when unpacked; at most 500 MB are accepted"
                )
            _check_description(path, archive.namelist())
            archive.extractall(folder)
        tree = ElementTree.parse(folder / DESCRIPTION).getroot()
    except ElementTree.ParseError as error:
        raise CoreError(
            f"{path} is not an FMU: its {DESCRIPTION} is no valid XML ({error}); export it again"
        ) from error
    except (zipfile.BadZipFile, OSError, RuntimeError) as error:
        raise CoreError(
            f"{path} is not an FMU ({error}); an FMU is a zip archive that contains {DESCRIPTION}: "
            "export it again, as an FMU for co-simulation"
        ) from error
    return _described(path, folder, tree)


def _check_description(path: str, names: list[str]) -> None:
    """Reject an archive without a description at the place where an FMU has it."""
    if DESCRIPTION in names:
        return
    inside = next((name for name in names if name.endswith(f"/{DESCRIPTION}")), None)
    if inside is not None:
        folder = inside.rpartition("/")[0]
        raise CoreError(
            f"{path} is not an FMU: it has {DESCRIPTION} in the folder {folder}, not at the top; "
            f"zip what is in {folder}, not the folder itself"
        )
    raise CoreError(
        f"{path} is not an FMU: it has no {DESCRIPTION}, but {_some(names)}; export it as an FMU "
        "for co-simulation, and do not change the archive"
    )


def _described(path: str, folder: Path, tree: ElementTree.Element) -> Fmu:
    version = tree.get("fmiVersion", "")
    fmi = {"2": 2, "3": 3}.get(version.partition(".")[0])
    if fmi is None:
        raise CoreError(
            f"{path} is for FMI {version or 'an unknown version'}; FMI 2.0 and 3.0 are supported"
        )
    simulation = tree.find("CoSimulation")
    if simulation is None:
        raise CoreError(
            f"{path} is an FMU for model exchange, which has no solver; export it for co-simulation"
        )
    if simulation.get("canBeInstantiatedOnlyOncePerProcess") == "true":
        raise CoreError(
            f"{path} can be instantiated only once, but the reference simulation needs a second "
            "instance; export it without canBeInstantiatedOnlyOncePerProcess"
        )
    name = simulation.get("modelIdentifier", "")
    token = tree.get("guid" if fmi == 2 else "instantiationToken", "")
    return Fmu(path, folder, fmi, name, token, _binary(path, folder, fmi, name), _variables(tree))


def _binary(path: str, folder: Path, fmi: int, name: str) -> Path:
    machine = platform.machine()
    here = f"{machine}-linux" if fmi == 3 else "linux64" if machine == "x86_64" else machine
    binary = folder / "binaries" / here / f"{name}.so"
    if binary.is_file():
        return binary
    others = sorted(p.name for p in (folder / "binaries").glob("*") if any(p.iterdir()))
    source = (folder / "sources").is_dir()
    raise CoreError(
        f"{path} has no binary for this machine, binaries/{here}/{name}.so; it has "
        f"{', '.join(others) if others else 'no binaries'}{' and sources' if source else ''}: "
        "export it for 64-bit Linux, or build the binary from its sources"
    )


def _variables(tree: ElementTree.Element) -> dict[str, Variable]:
    found = {}
    for one in tree.iterfind("ModelVariables/*"):
        inner = one if one.tag != "ScalarVariable" else next(iter(one), one)
        real = inner.tag in _REALS and one.find("Dimension") is None
        found[one.get("name", "")] = Variable(
            int(one.get("valueReference", "0")), one.get("causality", "local"), real,
            inner.get("unit", ""),
        )  # fmt: skip
    return found


@dataclass(frozen=True)
class FmuConfig:
    """Settings of a numerical part in an FMU, by the names of its variables.

    ``force`` and ``displacement`` have one name for each interface, ``k_e_n_per_m`` and ``place``
    are as for `fill_setup`. ``parameters`` are start values by name; ``record`` lists further
    variables to record; ``sha256`` is that of the required file, "" to accept any file.
    """

    path: str
    k_e_n_per_m: Stiffness
    force: str | tuple[str, ...]
    displacement: str | tuple[str, ...]
    ground_acceleration: str | None = None
    parameters: Values = ()
    record: tuple[str, ...] = ()
    period_s: float = PERIOD_S
    sha256: str = ""
    place: Places = IN_ORDER

    kind: ClassVar[str] = "fmu"
    what: ClassVar[str] = "the FMU"

    @functools.cached_property
    def fmu(self) -> Fmu:
        """The FMU.

        Raises:
            CoreError: it cannot be read, or is not the required file.
        """
        if not Path(self.path).is_file():
            raise CoreError(f"{self.path} does not exist; export it first, or correct the path")
        sha256 = hash_of(Path(self.path))
        check_meant(self.path, sha256, self.sha256, self.what)
        return unpacked(self.path, sha256)

    @property
    def interfaces(self) -> int:
        """The number of its interfaces."""
        return len(_several(self.force))

    @property
    def responses(self) -> tuple[Recorded, ...]:
        """The variables that are recorded.

        Raises:
            CoreError: it has no such variable, or two would have the same name.
        """
        found, fmu = [], self.fmu
        for name in self.record:
            fmu.reference(name, ("output", "local"), "record")
            plain = "".join(c if c.isascii() and c.isalnum() else "_" for c in name.lower())
            found.append(Recorded(f"fmu_{plain}"[:32], fmu.variables[name].unit))
        names = [one.name for one in found]
        if len(set(names)) < len(names):
            raise CoreError(f"record: two of {', '.join(self.record)} would get the same name")
        return tuple(found)

    def struct(self) -> list[Any]:
        """Return the ``rthyb_library_config`` of the C core, and the objects that must outlive it.

        Raises:
            CoreError: it cannot be read, or lacks a variable or a function.
        """
        fmu, cfg, own = self.fmu, ffi.new("rthyb_library_config *"), ffi.new("rthyb_fmu *")
        names = [name for name, _ in self.parameters]
        if len(names) > lib.RTHYB_FMU_PARAMETERS_MAX:
            raise CoreError(f"parameters: at most {lib.RTHYB_FMU_PARAMETERS_MAX} can be set")
        forces, displacements = _several(self.force), _several(self.displacement)
        if len(forces) != len(displacements):
            raise CoreError(
                f"displacement: found {len(displacements)} outputs for {len(forces)} forces; each "
                "interface has one input for its force and one output for its displacement"
            )
        kept = fill_setup(cfg, self, len(forces), [v for _, v in self.parameters])
        own.fmi, own.interfaces = fmu.fmi, len(forces)
        resources = fmu.folder / "resources"
        texts = {
            "name": "rthyb", "token": fmu.token,
            "resources": resources.as_uri() if fmu.fmi == 2 else f"{resources}/",
        }  # fmt: skip
        for key, text in texts.items():
            kept.append(ffi.new("char[]", text.encode()))
            setattr(own, key, kept[-1])
        for i, name in enumerate(forces):
            own.force[i] = fmu.reference(name, ("input",), "force")
        for i, name in enumerate(displacements):
            own.displacement[i] = fmu.reference(name, ("output",), "displacement")
        if self.ground_acceleration is not None:
            own.has_ground_acceleration = 1
            own.ground_acceleration = fmu.reference(
                self.ground_acceleration, ("input",), "ground_acceleration"
            )
        own.parameters, own.responses = len(names), len(self.responses)
        settable = ("parameter", "input", "local", "structuralParameter")
        for i, name in enumerate(names):
            own.parameter[i] = fmu.reference(name, settable, "parameters")
        for i, name in enumerate(self.record):
            own.response[i] = fmu.reference(name, ("output", "local"), "record")
        self._fill_calls(own, cfg)
        cfg.responses = own.responses
        return [cfg, kept, ffi.gc(own, lib.rthyb_fmu_close), own]

    def _fill_calls(self, own: Any, cfg: Any) -> None:
        library = opened(self.fmu.binary)
        for key, name in _FUNCTIONS[self.fmu.fmi].items():
            at = address(library, name)
            if not at:
                raise CoreError(f"{self.path}: the binary in it has no function {name}")
            setattr(own.call, key, ffi.cast("rthyb_any_function", at))
        cfg.instance = own
        cfg.calls.init, cfg.calls.answer = lib.rthyb_fmu_init, lib.rthyb_fmu_answer
        cfg.calls.report = lib.rthyb_fmu_report

    def complaint(self) -> str:
        """Return the message with which it rejects its settings, "" if it accepts them."""
        cfg, *kept = self.struct()
        own = ffi.cast("rthyb_fmu *", cfg.instance)
        lib.rthyb_fmu_init(own, ffi.addressof(cfg, "setup"))
        said = bytes(ffi.string(own.said)).decode(errors="replace")
        kept.clear()
        return said

    def plain(self) -> dict[str, Any]:
        """Return everything as plain values for a recording; `of_plain` restores it."""
        return {
            "kind": self.kind, "path": self.path, "force": _plain(self.force),
            "displacement": _plain(self.displacement),
            "ground_acceleration": self.ground_acceleration, "parameters": dict(self.parameters),
            "record": list(self.record), "period_s": self.period_s,
            "sha256": hash_of(Path(self.path)), **plain_interfaces(self),
        }  # fmt: skip

    @classmethod
    def of_plain(cls, plain: Mapping[str, Any]) -> FmuConfig:
        """Return the settings that `plain` described; raises ``KeyError`` or similar."""
        given = {key: value for key, value in plain.items() if key != "kind"}
        given["parameters"] = tuple(dict(given["parameters"]).items())
        for name in ("force", "displacement"):
            given[name] = given[name] if isinstance(given[name], str) else tuple(given[name])
        given["record"] = tuple(given["record"])
        return cls(**given | interfaces_of_plain(plain))


def _several(names: str | tuple[str, ...]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else names


def _plain(names: str | tuple[str, ...]) -> str | list[str]:
    return names if isinstance(names, str) else list(names)
