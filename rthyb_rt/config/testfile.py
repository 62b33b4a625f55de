"""The test file: motion, numerical part, compensation and limits of a test."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal, Self

from pydantic import (
    ConfigDict,
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    StrictBool,
    Tag,
    model_serializer,
)

from rthyb_rt.config import lawtables
from rthyb_rt.config.fields import (
    SLUG,
    SOME_TEXT,
    Alternatives,
    Condition,
    Count,
    Names,
    Range,
    Table,
    Text,
    WholeFile,
    written,
)
from rthyb_rt.config.limits import Limits
from rthyb_rt.config.numerical import Matrices
from rthyb_rt.config.own_tables import INTERFACES, PYTHON, FmuFile, LibraryFile, PythonClass
from rthyb_rt.config.prescribed_history import History
from rthyb_rt.config.rate import LEAST_HZ, MOST_HZ, STANDARD_HZ
from rthyb_rt.config.structures import (
    FROM_FILE,
    MOST_RECORDED,
    WRITTEN_OUT,
    Damping,
    Interface,
    MatrixFile,
    Nonlinear,
    Storeys,
)
from rthyb_rt.core.laws import LAWS, PASSING, LawDescription, passes
from rthyb_rt.core.sizes import COUPLED_MAX

MATRIX: Final = "matrix"
"""Compensation of several coupled axes by matrices, which is not a control law of one axis."""

if TYPE_CHECKING:
    LawName = str
    LawNameOrMatrix = str
else:
    LawName = Literal[tuple(LAWS)]
    LawNameOrMatrix = Literal[(*LAWS, MATRIX, PYTHON)]

TEST_SCHEMA = "rthyb-test/1"
MOST_NONLINEAR = 2000

SampleCount = Annotated[
    int, Count(1, 1024, "the number of samples T0 of the tangent-stiffness window (Eqn 3.3)")
]


PRESCRIBED: Final = "prescribed motion, not a test"
"""Description of what runs a motion without a structure, such as a sweep of `rthyb identify`."""


class TestInfo(Table):
    """Name and length of the test.

    If ``duration_s`` is absent, the test lasts as long as the ground motion, plus
    ``free_vibration_s``. A rate other than 1024 Hz is for virtual time; samples in the files are
    always of 1/1024 s. ``time_scale`` is the number of laboratory seconds per second of the
    structure.
    """

    __test__: ClassVar[bool] = False

    name: Annotated[str, SLUG]
    description: Annotated[str, Text("a description")] = ""
    duration_s: Annotated[float, Range("s", 0.01, 3600, "the test's length")] | None = None
    free_vibration_s: Annotated[
        float, Range("s", 0, 600, "the duration of the free vibration after the ground motion")
    ] = 10.0
    sample_rate_hz: Annotated[
        float, Range("Hz", LEAST_HZ, MOST_HZ, "the rate of the controller")
    ] = STANDARD_HZ
    time_scale: Annotated[
        float, Range("", 1, 1000, "seconds in the laboratory per second of the structure")
    ] = 1.0


class GroundMotionTable(Table):
    """The record and how it is modified; at most one of ``pga_g`` and ``factor``."""

    choices: ClassVar[tuple[Alternatives, ...]] = (
        Alternatives(("pga_g", "factor"), required=False),
    )

    record: Annotated[str, SOME_TEXT] = "elcentro-1940-ns"
    format: Literal[
        "auto", "at2", "cosmos-v1", "cosmos-v2", "csmip-v1", "csmip-v2", "knet", "columns"
    ] = "auto"
    units: Annotated[str, SOME_TEXT] | None = None
    channel: Annotated[str, SOME_TEXT] | None = None
    pga_g: (
        Annotated[
            float,
            Range(
                "g",
                1e-6,
                5,
                "the peak ground acceleration",
                'check the unit: 5 m/s2 is 0.51 g, and may be given as "5 m/s2"',
            ),
        ]
        | None
    ) = None
    factor: Annotated[float, Range("", -1e4, 1e4, "the scale factor")] | None = None
    start_s: Annotated[
        float, Range("s", 0, 3600, "the time in the record at which the test starts")
    ] = 0.0
    duration_s: Annotated[float, Range("s", 0.01, 3600, "the length used")] | None = None
    interpolation: Literal["band-limited", "linear"] = "band-limited"

    @classmethod
    def expand(cls, data: Any) -> Any:
        """Accept a channel given as a number, as in most record files."""
        if isinstance(data, dict) and type(data.get("channel")) is int:
            return {**data, "channel": str(data["channel"])}
        return data


def _form(given: object) -> str:
    """Return which form a table of matrices has; neither is a key of a file."""
    keys = given if isinstance(given, dict) else getattr(given, "model_fields_set", ())
    return FROM_FILE if {"file", "files", "data"} & set(keys) else WRITTEN_OUT


def _only_in_matrices(
    matrices: Matrices | MatrixFile | None, storeys: Storeys | None, integrator: str
) -> str | None:
    if isinstance(matrices, MatrixFile) or storeys is not None:
        if integrator != "forward-euler":
            return None
        return (
            f'found "{integrator}"; storeys and matrices from a file use kr-alpha, cr or '
            "central-difference"
        )
    if matrices is None or integrator == "central-difference":
        return None
    return f'found "{integrator}"; with matrices set numerical.matrices.integrator instead'


def _in_matrices(
    matrices: Matrices | MatrixFile | None, storeys: Storeys | None, stiffness_n_per_m: float
) -> str | None:
    if (matrices is None and storeys is None) or stiffness_n_per_m == 0.0:
        return None
    if storeys is not None or isinstance(matrices, MatrixFile):
        return (
            f"found {stiffness_n_per_m:g} N/m; this key is for one degree of freedom: give the "
            "stiffness in storeys or matrices"
        )
    return f"found {stiffness_n_per_m:g} N/m; with matrices give every stiffness in k_n_per_m"


def _for_structures(what: str) -> Any:
    def test(
        matrices: Matrices | MatrixFile | None, storeys: Storeys | None, value: Any
    ) -> str | None:
        if storeys is not None or isinstance(matrices, MatrixFile) or not value:
            return None
        return f"{what} belongs to storeys or to matrices from a file, and there are neither"

    return test


def _storeys_damped(storeys: Storeys | None, damping: Damping | None) -> str | None:
    if storeys is None or damping is not None:
        return None
    return "missing; storeys need it: damping = { ratio = 0.02, modes = [1, 2] }"


def _has_its_own(
    library: LibraryFile | None, fmu: FmuFile | None, python: PythonClass | None, integrator: str
) -> str | None:
    if (library or fmu or python) is None or integrator == "central-difference":
        return None
    return f'found "{integrator}"; a library, an FMU or a class in Python does its own integration'


class Numerical(Table):
    """The computed part: mass or period, damping or damping ratio, additional stiffness.

    ``rho_inf`` is used by the integrator ``kr-alpha`` only. ``matrices`` or ``storeys`` replace all
    of these; with storeys, or matrices from a file, the default integrator is ``kr-alpha`` with
    0.8. With ``library``, ``fmu`` or ``python``, which compute the response, mass or period and
    damping describe the complete structure including the specimen, for windows and margins.
    """

    choices: ClassVar[tuple[Alternatives, ...]] = (
        Alternatives(("library", "fmu", "python", "matrices", "storeys"), required=False),
        Alternatives(("mass_kg", "period_s", "matrices", "storeys"), required=True),
        Alternatives(("damping_n_s_per_m", "damping_ratio", "matrices", "storeys"), required=True),
    )
    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("integrator", ("matrices", "storeys", "integrator"), _only_in_matrices),
        Condition("stiffness_n_per_m", ("matrices", "storeys", "stiffness_n_per_m"), _in_matrices),
        Condition("damping", ("storeys", "damping"), _storeys_damped),
        Condition("damping", ("matrices", "storeys", "damping"), _for_structures("damping")),
        Condition("nonlinear", ("matrices", "storeys", "nonlinear"), _for_structures("an element")),
        Condition("record", ("matrices", "storeys", "record"), _for_structures("what is recorded")),
        Condition("integrator", ("library", "fmu", "python", "integrator"), _has_its_own),
    )

    mass_kg: Annotated[float, Range("kg", 1e-3, 1e9, "the mass")] | None = None
    period_s: (
        Annotated[float, Range("s", 0.01, 100, "the period of the whole structure")] | None
    ) = None
    damping_n_s_per_m: Annotated[float, Range("N s/m", 0, 1e12, "the damping")] | None = None
    damping_ratio: Annotated[float, Range("", 0, 2, "the damping ratio")] | None = None
    stiffness_n_per_m: Annotated[
        float,
        Range("N/m", 0, 1e12, "the stiffness of the numerical part, in parallel with the specimen"),
    ] = 0.0
    integrator: Literal["central-difference", "forward-euler", "cr", "kr-alpha"] = (
        "central-difference"
    )
    rho_inf: Annotated[float, Range("", 0, 1, "the spectral radius at high frequency")] = 1.0
    matrices: (
        Annotated[
            Annotated[Matrices, Tag(WRITTEN_OUT)] | Annotated[MatrixFile, Tag(FROM_FILE)],
            Discriminator(_form),
        ]
        | None
    ) = None
    storeys: Storeys | None = None
    damping: Damping | None = None
    nonlinear: list[Nonlinear] = Field(default_factory=list, max_length=MOST_NONLINEAR)
    record: Annotated[list[str], Names("the quantities to record", MOST_RECORDED)] | None = None
    library: LibraryFile | None = None
    fmu: FmuFile | None = None
    python: PythonClass | None = None

    @classmethod
    def expand(cls, data: Any) -> Any:
        """Set the default integrator for a structure of many degrees of freedom."""
        if not isinstance(data, dict):
            return data
        matrices = data.get("matrices")
        if data.get("storeys") is None and not (matrices and _form(matrices) == FROM_FILE):
            return data
        return {"integrator": "kr-alpha", "rho_inf": 0.8, **data}

    @property
    def own(self) -> LibraryFile | FmuFile | PythonClass | None:
        """The user-defined part that replaces the equation of motion, if any."""
        return self.library or self.fmu or self.python

    @property
    def structure(self) -> Storeys | MatrixFile | None:
        """The structure of many degrees of freedom; excludes matrices written in the test file."""
        if self.storeys is not None:
            return self.storeys
        return self.matrices if isinstance(self.matrices, MatrixFile) else None


class _DelayEstimator(Table):
    """Settings for the learning of control laws, shared by several laws (Eqn 2.6-2.11).

    A file may hold the settings of several laws; each uses its own. ``enabled`` applies to all
    laws.
    """

    enabled: StrictBool = True


class RfcTable(Table):
    """The restoring-force compensator (Eqn 3.1-3.3); the default window is 0.1 periods.

    ``divisor = "printed"`` divides the T0 + 1 terms of Eqn 3.3 by T0, ``"terms"`` by their number.
    ``cutoff_hz`` belongs to the low-pass filter on x_c - x_m, 0 for none. ``force_lateness_s`` is
    the delay of the force behind x_m that the equation of motion uses; velocity times tangent
    stiffness times this delay is added to the force.
    """

    choices: ClassVar[tuple[Alternatives, ...]] = (
        Alternatives(("window_periods", "window_s", "window_samples"), required=False),
    )

    enabled: StrictBool = True
    window_periods: Annotated[float, Range("", 1e-4, 10, "the window in periods")] | None = None
    window_s: Annotated[float, Range("s", 1e-4, 1, "the window")] | None = None
    window_samples: SampleCount | None = None
    tangent: Literal["mean-of-ratios", "least-squares"] | None = None
    divisor: Literal["printed", "terms"] = "printed"
    cutoff_hz: (
        Annotated[float, Range("Hz", 0, 400, "the cut-off of the low-pass on x_c - x_m")] | None
    ) = None
    force_lateness_s: (
        Annotated[float, Range("s", -0.1, 0.1, "the delay of the force behind x_m")] | None
    ) = None


class _Law(Table):
    """A control law with its settings."""

    type: LawName = lawtables.DEFAULT_LAW
    plc_enabled: StrictBool = True
    delay_estimator: _DelayEstimator = Field(default_factory=_DelayEstimator)

    @property
    def law(self) -> LawDescription:
        """The control law; for compensation by matrices, which has none, the one that
        compensates nothing.
        """
        return LAWS.get(self.type, PASSING)

    @property
    def compensates(self) -> bool:
        """Whether the command is anything but x_c itself."""
        return not passes(self.type)

    @property
    def as_printed(self) -> bool:
        """Whether settings left open keep the constants printed in the paper, whatever the rig."""
        return self.law.as_printed

    def setting(self, key: str) -> float | None:
        """Return the file's value for a law's parameter, else its default, else None."""
        return lawtables.setting(self, key)

    def with_settings(self, values: Mapping[str, float]) -> Self:
        """Return a copy with the given settings of laws written out, by their keys."""
        return lawtables.with_settings(self, values)

    @classmethod
    def further_faults(
        cls, keys: dict[str, Any]
    ) -> Iterator[tuple[tuple[str, ...], str, tuple[str, ...]]]:
        """Check the combination of settings with the control law."""
        if keys.get("type") != MATRIX:
            yield from lawtables.faults(keys)


class _AxisLaw(_Law):
    """The control law of one axis, which replaces the one common to all axes."""

    name: Annotated[str, SLUG]


class MatrixLaw(Table):
    """Compensation of coupled axes by matrices: gain, delay and curvature.

    With ``inverse`` true, an inverse fitted to the rig's ``[identified]`` follows them; otherwise
    they start with the values that best invert that response. They then learn the remaining error,
    unless ``delay_estimator.enabled = false``.
    """

    inverse: StrictBool = True
    coupled: StrictBool = True
    roll_off_hz: Annotated[float, Range("Hz", 1, 400, "the roll-off of the lead")] = 20.0
    cutoff_hz: Annotated[
        float, Range("Hz", 0.1, 400, "the cut-off frequency of the signals used for learning")
    ] = 10.0
    memory_s: Annotated[float, Range("s", 0.1, 1e4, "the memory")] = 10.0
    gate_factor: Annotated[
        float,
        Range("", 0, 1e6, "the ratio of the power to that at rest above which the law learns"),
    ] = 10.0


def _of_matrix(type: str, matrix: MatrixLaw | None) -> str | None:
    if matrix is None or type == MATRIX:
        return None
    return (
        f'found type = "{type}", but this table belongs to type = "{MATRIX}": remove it, or set '
        "that type"
    )


def _of_axes(type: str, axis: list[Any]) -> str | None:
    if axis and type == MATRIX:
        return (
            f'found laws of axes beside type = "{MATRIX}", which compensates all axes; remove '
            "one of the two"
        )
    names = [one.name for one in axis]
    twice = [name for name in names if names.count(name) > 1]
    return f'found axis "{twice[0]}" twice; each axis has one law' if twice else None


def _by_its_class(type: str, python: PythonClass | None) -> str | None:
    if type == PYTHON and python is None:
        return 'missing; type = "python" needs it: python = { class = "my_laws:Slope" }'
    if type != PYTHON and python is not None:
        return f'found a class, but type = "{type}"; use type = "python", or remove the class'
    return None


class _Controller(_Law):
    """The compensation: the control law with its settings, restoring force (Eqn 3.2).

    ``python`` is the class for a law of type "python".
    """

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("matrix", ("type", "matrix"), _of_matrix),
        Condition("axis", ("type", "axis"), _of_axes),
        Condition("python", ("type", "python"), _by_its_class),
    )

    type: LawNameOrMatrix = lawtables.DEFAULT_LAW
    rfc: RfcTable = Field(default_factory=RfcTable)
    matrix: MatrixLaw | None = None
    axis: list[_AxisLaw] = Field(default_factory=list, max_length=COUPLED_MAX)
    python: PythonClass | None = None

    @property
    def law(self) -> LawDescription:
        """The control law; for compensation by matrices, which has none, the law ``none``.

        Raises:
            CoreError: it is a class in Python that cannot be imported.
        """
        if self.python is None:
            return super().law
        from rthyb_rt.core.own import law_of

        return law_of(self.python.own)


if TYPE_CHECKING:
    # The laws' own tables add their keys, which `setting` reads.
    DelayEstimator = _DelayEstimator
    AxisLaw = _AxisLaw
    Controller = _Controller
else:
    DelayEstimator = lawtables.extended(_DelayEstimator, "DelayEstimator", "delay_estimator")
    AxisLaw = lawtables.extended(
        _AxisLaw, "AxisLaw", "", sections={"delay_estimator": DelayEstimator}
    )

    class _WithAxes(_Controller):
        __doc__ = _Controller.__doc__
        axis: list[AxisLaw] = Field(default_factory=list, max_length=COUPLED_MAX)

    Controller = lawtables.extended(
        _WithAxes, "Controller", "", sections={"delay_estimator": DelayEstimator}
    )


class Reference(Table):
    """The reference simulation; ``table_forces`` adds the table's forces at the load cell."""

    table_forces: StrictBool = True


def _something_to_move(numerical: Numerical, interface: list[Interface]) -> str | None:
    if interface and numerical.structure is None and numerical.own is None:
        return (
            "[[interface]] needs a structure given by storeys or by matrices from a file, or a "
            "part of your own; a numerical part with one degree of freedom, or with matrices in "
            "the test file, already determines what the actuator moves: remove [[interface]]"
        )
    return None


def _numbered(numerical: Numerical, interface: list[Interface]) -> str | None:
    """Check that the interfaces of your own part, and only they, are given by their number."""
    if numerical.structure is None and numerical.own is None:
        return None
    numbers = [one.number for one in interface]
    for i, one in enumerate(interface, 1):
        if numerical.own is not None and one.number is None:
            return (
                f"interface {i} has no number; a numerical part of your own has interfaces by "
                f"their number: write number = {i} instead"
            )
        if numerical.own is None and one.number is not None:
            return (
                f"interface {i} has number = {one.number}, which is for a numerical part of your "
                "own; in a structure give its storey or dof"
            )
    if numerical.own is not None and sorted(filter(None, numbers)) != [*range(1, len(numbers) + 1)]:
        found = ", ".join(map(str, numbers))
        return f"found the numbers {found}; each of 1 to {len(numbers)} must occur once"
    return None


def _interfaces_differ(interface: list[Interface]) -> str | None:
    names = [one.name for one in interface]
    for i, name in enumerate(names):
        if name in names[:i]:
            return (
                f"interfaces {names.index(name) + 1} and {i + 1} are both called "
                f"{written(name)}; each needs its own name, one of those in the rig's kinematics"
            )
    return None


_WITHOUT_STRUCTURE = ("ground_motion", "numerical", "interface", "reference")
"""Tables of a hybrid test that a prescribed history does not have."""
_NO_STRUCTURE = {"period_s": 1.0, "damping_ratio": 0.0}
"""Placeholder for the structure of a history: an oscillator, which is never computed."""


def _numerical_or_history(schema: dict[str, Any]) -> None:
    schema["required"].remove("numerical")
    schema["oneOf"] = [{"required": ["numerical"]}, {"required": ["history"]}]


class TestFile(WholeFile):
    """A hybrid test, or a prescribed history.

    ``rig`` is a path, or the name of a rig that comes with the program. With ``history`` there is
    no structure and no ground motion, and by default no control law.
    """

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("interface", ("numerical", "interface"), _something_to_move),
        Condition("interface", ("interface",), _interfaces_differ),
        Condition("interface", ("numerical", "interface"), _numbered),
    )

    __test__: ClassVar[bool] = False
    model_config = ConfigDict(json_schema_extra=_numerical_or_history)

    schema_: Literal["rthyb-test/1"] = Field(alias="schema")
    rig: Annotated[str, SOME_TEXT] | None = None
    test: TestInfo
    history: Annotated[History, Field(discriminator="kind")] | None = None
    ground_motion: GroundMotionTable = Field(default_factory=GroundMotionTable)
    numerical: Numerical
    interface: list[Interface] = Field(default_factory=list, max_length=INTERFACES)
    controller: Controller = Field(default_factory=Controller)
    limits: Limits = Field(default_factory=Limits)
    reference: Reference = Field(default_factory=Reference)

    @classmethod
    def expand(cls, data: Any) -> Any:
        """Give a history a placeholder structure, and by default no control law."""
        if not isinstance(data, dict) or data.get("history") is None:
            return data
        controller = data.get("controller")
        if controller is None or (isinstance(controller, dict) and "type" not in controller):
            controller = {**(controller or {}), "type": PASSING.name}
        data = {**data, "controller": controller}
        if "numerical" not in data:
            data["numerical"] = _NO_STRUCTURE
        return data

    @classmethod
    def further_faults(
        cls, keys: dict[str, Any]
    ) -> Iterator[tuple[tuple[str, ...], str, tuple[str, ...]]]:
        """Report tables and keys that are not allowed beside a history."""
        if keys.get("history") is None:
            return
        for key in _WITHOUT_STRUCTURE:
            if key in keys and keys[key] is not _NO_STRUCTURE:
                yield (
                    (key,),
                    "found a table beside [history], which prescribes the displacement, so there "
                    "is no structure to compute; remove one of the two",
                    (key, "history"),
                )
        info = keys.get("test")
        for key in ("duration_s", "free_vibration_s"):
            if isinstance(info, dict) and key in info:
                yield (
                    ("test", key),
                    "found a length, but the length of a history follows from its own keys; "
                    "remove this key",
                    (f"test.{key}",),
                )

    @model_serializer(mode="wrap")
    def _without_structure(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Remove the placeholders of a history, so that it reads back equal."""
        found: dict[str, Any] = handler(self)
        if self.history is not None:
            for key in _WITHOUT_STRUCTURE:
                found.pop(key, None)
            for key in ("duration_s", "free_vibration_s"):
                found["test"].pop(key, None)
        return found
