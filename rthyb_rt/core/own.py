"""Numerical parts, control laws and specimen elements in Python, for tests in virtual time.

Each is a class with the same functions as its counterpart in C. A file or a recording identifies it
by its name, ``module:Class``, and its settings, the arguments with which it was created; other
processes create it again from these. An exception raised in a method is kept until the call into C
has returned, and is raised then.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import itertools
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final, Self, TypeVar

import numpy as np

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.laws import LawDescription, Value
from rthyb_rt.core.library import CoreError
from rthyb_rt.core.own_interfaces import (
    IN_ORDER,
    Places,
    Stiffness,
    fill_setup,
    interfaces_of_plain,
    own_stiffness,
    plain_interfaces,
    rows_of,
)
from rthyb_rt.core.own_library import Recorded
from rthyb_rt.core.own_methods import (
    ANSWER,
    FORCE,
    LAW,
    LEAD,
    PART,
    REPORT,
    RESPONSES,
    VALUE_MAX,
    VALUES,
    OwnMethod,
    place_of,
    settings_complaint,
    value_of,
)
from rthyb_rt.core.pending import OwnCodeError, guarded
from rthyb_rt.core.sizes import PERIOD_S

_Plain = bool | int | float | str
Setting = _Plain | tuple[_Plain, ...]
Settings = tuple[tuple[str, Setting], ...]

ELEMENT_STATES: Final[int] = lib.RTHYB_ELEMENT_STATES - 1
"""Number of state variables of a user-defined element."""


class Own:
    """Base class of numerical parts, control laws and elements written in Python."""

    what: ClassVar[str] = "a class"
    _made_of_own: ClassVar[bool] = True
    _given: dict[str, Any]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Remember the arguments, with which another process can create the object again."""
        made = super().__new__(cls)
        if cls.__init__ is object.__init__ and (args or kwargs):
            raise TypeError(f"{cls.__name__}() takes no arguments")
        try:
            given = inspect.signature(cls.__init__).bind(made, *args, **kwargs).arguments
        except TypeError as error:
            raise TypeError(f"{cls.__name__}() {error}") from None
        own = dict(itertools.islice(given.items(), 1, None))
        names = inspect.signature(cls.__init__).parameters
        for name, parameter in names.items():
            if parameter.kind is parameter.VAR_KEYWORD:
                own |= own.pop(name, {})
        object.__setattr__(made, "_given", own)
        return made


class NumericalPart(Own):
    """A numerical part in Python: a class with ``answer``, and whatever else it needs.

    It starts at rest at zero displacement. All quantities are in SI units: for a rotation the
    displacement is in rad and the force in N m.

    Attributes:
        interfaces: number of directions in which the actuators move the specimen. With more than
            one, force and displacement are arrays, (interfaces,), and the stiffness of the specimen
            is a matrix, (interfaces, interfaces).
        responses: names and units of the values that `report` returns; each becomes a channel of
            the recording. They must be finite.

    Examples:
        >>> class Oscillator(NumericalPart):
        ...     def __init__(self, mass_kg: float) -> None:
        ...         self.mass_kg = mass_kg
        ...
        ...     def begin(self, period_s: float, k_e_n_per_m: float) -> None:
        ...         self.h, self.x, self.x1 = period_s, 0.0, 0.0
        ...
        ...     def answer(self, ag_mps2: float, force_n: float) -> float:
        ...         acceleration = -ag_mps2 - force_n / self.mass_kg
        ...         self.x, self.x1 = 2 * self.x - self.x1 + self.h**2 * acceleration, self.x
        ...         return self.x
    """

    what: ClassVar[str] = "a numerical part"
    interfaces: int = 1
    responses: ClassVar[Mapping[str, str]] = {}

    def begin(self, period_s: float, k_e_n_per_m: Any) -> None:
        """Start at rest at zero, with the sampling period and the specimen's elastic stiffness."""

    def answer(self, ag_mps2: float, force_n: Any) -> Any:
        """Return the displacement at t[n+1], m, from ground acceleration and force at t[n]."""
        raise NotImplementedError(f"{type(self).__name__} has no method answer(ag_mps2, force_n)")

    def advance(self) -> None:
        """Do the rest of the step after the command has been sent."""

    def freeze(self, force_n: Any) -> None:
        """Handle a tick in which a ramp or a hold controls the actuator: the part's time stops."""

    def report(self) -> Sequence[float]:
        """Return the values of ``responses``; called between `answer` and `advance`."""
        return ()


class ControlLaw(Own):
    """A control law in Python: a class with ``lead``, and whatever else it needs. SI units.

    Attributes:
        values: names and units of the values that it reports at every sample, each an attribute of
            that name, a finite number. ``alpha`` and ``beta``, in samples and samples squared,
            have fields of their own in every recording; the others become channels.
        uses_rest_noise: whether it needs the noise at rest.

    Examples:
        >>> class Slope(ControlLaw):
        ...     def __init__(self, delay_s: float) -> None:
        ...         self.delay_s = delay_s
        ...
        ...     def begin(self, period_s: float, x0_m: float, rest_noise_m: float) -> None:
        ...         self.h, self.x1 = period_s, x0_m
        ...
        ...     def lead(self, x_c_m: float, allowed_m: float) -> float:
        ...         slope, self.x1 = (x_c_m - self.x1) / self.h, x_c_m
        ...         return x_c_m + self.delay_s * slope
    """

    what: ClassVar[str] = "a control law"
    values: ClassVar[Mapping[str, str]] = {}
    uses_rest_noise: ClassVar[bool] = False

    def begin(self, period_s: float, x0_m: float, rest_noise_m: float) -> None:
        """Start at rest at ``x0_m``, with the sampling period and the noise at rest."""

    def rest(self, x_m: float) -> None:
        """Come to rest at a displacement: `lead` then returns it; what was learnt is kept."""

    def observe(self, x_p_m: float, x_m_m: float, frozen: bool) -> None:
        """Process the drive's command and the reading; if frozen, learn nothing from them."""

    def lead(self, x_c_m: float, allowed_m: float) -> float:
        """Return x_p for x_c, m; what was learnt since the last call may change it by at most
        ``allowed_m``.
        """
        raise NotImplementedError(f"{type(self).__name__} has no method lead(x_c_m, allowed_m)")


class Element(Own):
    """A specimen element in Python: a class with ``force``. SI units.

    Examples:
        >>> class Hardening(Element):
        ...     def __init__(self, k_n_per_m: float, k3_n_per_m3: float) -> None:
        ...         self.k, self.k3 = k_n_per_m, k3_n_per_m3
        ...
        ...     def force(self, x_m, v_m_per_s, a_m_per_s2, dt_s, state):
        ...         return self.k * x_m + self.k3 * x_m**3
    """

    what: ClassVar[str] = "a specimen element"

    def force(
        self, x_m: float, v_m_per_s: float, a_m_per_s2: float, dt_s: float, state: Any
    ) -> float:
        """Return the force that resists the motion, N.

        Args:
            x_m, v_m_per_s, a_m_per_s2: motion of the specimen.
            dt_s: time since the last call; 0: the same instant again.
            state: 15 numbers, initially 0, which the method may change. All memory of the element
                must be kept here, because one object serves every specimen that contains it.
        """
        raise NotImplementedError(f"{type(self).__name__} has no method force(...)")


# ---- by name ------------------------------------------------------------------------------------

_Kind = TypeVar("_Kind", bound=Own)
_METHODS: Final[dict[str, tuple[OwnMethod, ...]]] = {
    "NumericalPart": PART, "ControlLaw": LAW, "Element": (FORCE,),
}  # fmt: skip


class SettingsError(CoreError):
    """A user's class does not take the settings that it is given.

    Args:
        message: what it takes, and what it was given.
        unknown: a setting that it does not take; "" if there is none.

    Attributes:
        key: the settings, or the unknown one, as a key of the table that describes the class.
    """

    def __init__(self, message: str, unknown: str) -> None:
        super().__init__(message)
        self.key = f"settings.{unknown}" if unknown else "settings"


def key_of(error: CoreError) -> str:
    """Return the key of the table of a user's class to which an error belongs."""
    return error.key if isinstance(error, SettingsError) else "class"


def _complaint(place: type[Own], kind: type[Own]) -> str | None:
    """Return what is wrong with a user's class, or None."""
    for method in _METHODS.get(kind.__name__, ()):
        complaint = method.complaint(place, kind)
        if complaint is not None:
            return complaint
    if issubclass(place, ControlLaw):
        return VALUES.complaint(place)
    if issubclass(place, NumericalPart):
        return RESPONSES.complaint(place) or _unreported(place, kind)
    return None


def _unreported(place: type[NumericalPart], kind: type[Own]) -> str | None:
    """Return what is wrong if a part has responses without `report`, or the reverse, or None."""
    if place.responses:
        lacking = replace(REPORT, needed=True).complaint(place, kind)
        said = f"its responses are {', '.join(place.responses)}"
        return None if lacking is None else f"{lacking}, because {said}"
    if place.report is NumericalPart.report:
        return None
    return (
        f"{place.__name__} at {place_of(place)} has a method report but no responses, so it would "
        f"never be called: define responses as a dict of names and units, {{{RESPONSES.example}}}, "
        "in the class, not in __init__, or remove report"
    )


def _imported(name: str) -> Any:
    """Return the module, which may also be in the folder in which the program was started.

    An installed command looks for modules beside itself, not there, unlike ``python -m``. The
    folder stays the last place to look, because what a user's module imports later is there too.
    """
    here = os.getcwd()
    if here not in sys.path:
        sys.path.append(here)
    return importlib.import_module(name)


@dataclass(frozen=True)
class OwnClass:
    """A user-defined class and the arguments with which it is created.

    ``name`` is ``module:Class``.
    """

    name: str
    settings: Settings = ()

    def found(self, kind: type[_Kind]) -> type[_Kind]:
        """Return the class.

        Raises:
            CoreError: it cannot be imported, is not a class of the requested kind, one of its
                methods is missing or takes other arguments, or what it reports is not named in
                the right form.
        """
        module_name, _, inner = self.name.partition(":")
        try:
            module = sys.modules.get(module_name) or _imported(module_name)
        except ImportError as error:
            raise CoreError(
                f'"{self.name}" cannot be imported ({error}); Python must be able to find the '
                "module: start the program in the module's folder, or add that folder to "
                "PYTHONPATH"
            ) from error
        except Exception as error:  # whatever a user's module may raise
            raise OwnCodeError(error, f'importing "{module_name}"') from error
        place: Any = module
        for part in inner.split("."):
            place = getattr(place, part, None)
        if place is None:
            hint = (
                "; a class defined in a notebook or a shell is unknown to other processes: "
                "write it to a file, my_parts.py, and import it from there"
                if module_name == "__main__"
                else ""
            )
            raise CoreError(f'"{self.name}": module {module_name} has no {inner}{hint}')
        if not (isinstance(place, type) and issubclass(place, kind)):
            raise CoreError(
                f'"{self.name}" is not a {kind.__name__}; {kind.what} is a class '
                f"{inner}(rthyb_rt.{kind.__name__})"
            )
        complaint = _complaint(place, kind)
        if complaint is not None:
            raise CoreError(f'"{self.name}": {complaint}')
        return place

    def made(self, kind: type[_Kind]) -> _Kind:
        """Return a new object of it.

        Raises:
            CoreError: it cannot be imported, or is not a class of the requested kind.
            SettingsError: it does not take its settings.
            OwnCodeError: it raised an error.
        """
        own, given = self.found(kind), {name: _listed(value) for name, value in self.settings}
        complaint = settings_complaint(own, given)
        if complaint is not None:
            text, unknown = complaint
            raise SettingsError(f'"{self.name}": {text}', unknown)
        try:
            return own(**given)
        except Exception as error:  # whatever a user's class may raise
            raise OwnCodeError(error, f"creating {self.name}") from error

    def plain(self) -> dict[str, Any]:
        """Return name and settings in the form in which a file stores them."""
        settings = {name: _listed(value) for name, value in self.settings}
        return {"class": self.name, "settings": settings}

    @classmethod
    def of_plain(cls, plain: Mapping[str, Any]) -> OwnClass:
        """Return the object that `plain` described."""
        settings = dict(plain.get("settings") or {})
        return cls(plain["class"], tuple((name, _frozen(v)) for name, v in settings.items()))


def _listed(value: Any) -> Any:
    return [_listed(v) for v in value] if isinstance(value, tuple) else value


def _frozen(value: Any) -> Any:
    return tuple(_frozen(v) for v in value) if isinstance(value, (list, tuple)) else value


def _storable(value: Any) -> Any:
    """Return a setting with NumPy's arrays and tuples as lists, and its scalars as Python's."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return [_storable(v) for v in value] if isinstance(value, (list, tuple)) else value


def spelled(made: Own) -> OwnClass:
    """Return name and settings of an object, from which it can be created again.

    Raises:
        CoreError: its class is defined inside a function, or an argument cannot be stored in a
            file.
    """
    kind = type(made)
    if "<" in kind.__qualname__:
        raise CoreError(
            f"{kind.__qualname__} is defined inside a function, where other processes cannot "
            "find it; define the class at the top level of its module"
        )
    settings = []
    for name, value in made._given.items():
        stored = _storable(value)
        inner = stored if isinstance(stored, list) else [stored]
        if not all(isinstance(v, (bool, int, float, str)) for v in inner):
            raise CoreError(
                f"{kind.__qualname__} was created with {name} = {value!r}; a setting must be a "
                "number, a string, true or false, or a list or a one-dimensional array of these, "
                "so that a file can hold it"
            )
        settings.append((name, _frozen(stored)))
    return OwnClass(f"{kind.__module__}:{kind.__qualname__}", tuple(settings))


# ---- a numerical part ---------------------------------------------------------------------------


@dataclass(frozen=True)
class PythonPartConfig:
    """Settings of a numerical part that is a class in Python.

    ``k_e_n_per_m`` and ``place`` are as for `fill_setup`.
    """

    own: OwnClass
    k_e_n_per_m: Stiffness
    period_s: float = PERIOD_S
    place: Places = IN_ORDER

    kind: ClassVar[str] = "python"
    what: ClassVar[str] = "the numerical part"

    @property
    def responses(self) -> tuple[Recorded, ...]:
        """The responses that are recorded.

        Raises:
            CoreError: it cannot be imported.
        """
        kind = self.own.found(NumericalPart)
        return tuple(Recorded(name, unit) for name, unit in kind.responses.items())

    @property
    def interfaces(self) -> int:
        """The number of its interfaces.

        Raises:
            CoreError: it cannot be imported, or the number is not a whole number from 1.
            OwnCodeError: it raised an error when it was created.
        """
        found = self.own.made(NumericalPart).interfaces
        if isinstance(found, bool) or not isinstance(found, int) or found < 1:
            raise CoreError(
                f"{self.own.name} has interfaces = {found!r}; it must be a whole number from 1"
            )
        return found

    def struct(self) -> list[Any]:
        """Return the ``rthyb_library_config`` of the C core, and the objects that must outlive it.

        Raises:
            CoreError: it cannot be imported.
        """
        names, cfg = self.responses, ffi.new("rthyb_library_config *")
        kept = fill_setup(cfg, self, self.interfaces, [])
        calls = _part_calls(self, [one.name for one in names])
        for name, call in calls.items():
            setattr(cfg.calls, name, call)
        cfg.responses = len(names)
        return [cfg, kept, calls]

    def plain(self) -> dict[str, Any]:
        """Return everything as plain values for a recording; `of_plain` restores it."""
        own = self.own.plain()
        return {"kind": self.kind, **own, "period_s": self.period_s, **plain_interfaces(self)}

    @classmethod
    def of_plain(cls, plain: Mapping[str, Any]) -> PythonPartConfig:
        """Return the settings that `plain` described; raises ``KeyError`` or similar."""
        own = OwnClass.of_plain(plain)
        return cls(own, period_s=plain["period_s"], **interfaces_of_plain(plain))


def _several(method: OwnMethod, made: Own, found: Any, count: int) -> list[Any]:
    """Return the values that a method returned, which must be a certain number.

    Raises:
        OwnFault: they are not a list, or of another length.
    """
    try:
        values = list(found)
    except TypeError:
        raise method.fault(made, f"returned {found!r} instead of {count} values") from None
    if len(values) != count:
        raise method.fault(made, f"returned {len(values)} values instead of {count}")
    return values


_PART_CALLS: Final = dict(ffi.typeof("rthyb_part_calls").fields)


def _part_calls(config: PythonPartConfig, names: Sequence[str]) -> dict[str, Any]:
    """Return the functions that C calls; each ``init`` creates a new object."""
    at: dict[str, NumericalPart] = {}
    count = len(rows_of(config.k_e_n_per_m))

    def forces(force_n: Any) -> Any:
        return force_n[0] if count == 1 else np.array(ffi.unpack(force_n, count))

    def init(_state: Any, _setup: Any) -> int:
        part = config.own.made(NumericalPart)
        stiffness = own_stiffness(config)
        part.begin(config.period_s, stiffness[0][0] if count == 1 else np.array(stiffness))
        at["part"] = part
        return 0

    def answer(_state: Any, ag_mps2: float, force_n: Any, x_next_m: Any) -> int:
        part, force = at["part"], forces(force_n)
        found = part.answer(ag_mps2, force)
        given = (ag_mps2, force) if count == 1 else (ag_mps2,)
        next_m = [found] if count == 1 else _several(ANSWER, part, found, count)
        x_next_m[0:count] = [ANSWER.number(part, one, given) for one in next_m]
        return 0

    def advance(_state: Any) -> int:
        at["part"].advance()
        return 0

    def freeze(_state: Any, force_n: Any) -> None:
        at["part"].freeze(forces(force_n))

    def report(_state: Any, values: Any) -> None:
        part = at["part"]
        reported = _several(REPORT, part, part.report(), len(names))
        values[0 : len(names)] = [
            REPORT.number(part, one, name=name) for name, one in zip(names, reported, strict=True)
        ]

    kind = config.own.found(NumericalPart)
    functions: dict[str, Callable[..., Any]] = {"init": init, "answer": answer}
    if kind.advance is not NumericalPart.advance:
        functions["advance"] = advance
    if kind.freeze is not NumericalPart.freeze:
        functions["freeze"] = freeze
    if names:
        functions["report"] = report
    made = {}
    for name, does in functions.items():
        failed = 1 if name in ("init", "answer", "advance") else None
        safe = guarded(does, f"{name} of {config.own.name}", failed)
        made[name] = ffi.callback(_PART_CALLS[name].type, safe)
    return made


# ---- a control law ------------------------------------------------------------------------------


def law_of(own: OwnClass) -> LawDescription:
    """Return the description of a user-defined control law, like those of the core.

    Raises:
        CoreError: it cannot be imported.
    """
    kind = own.found(ControlLaw)
    learns = kind.observe is not ControlLaw.observe
    return LawDescription(
        name="python",
        meaning=own.name,
        calmer=f"change the settings of {own.name}" if learns else None,
        parameters=(),
        values=tuple(Value(name, unit, name) for name, unit in kind.values.items()),
        uses_rest_noise=kind.uses_rest_noise,
        with_rfc=True,
        kind=-1,
        state_bytes=8 * (1 + len(kind.values)),
    )


_LAW_CALLS: Final = dict(ffi.typeof("rthyb_control_law").fields)


def control_law(own: OwnClass) -> Any:
    """Return the ``rthyb_control_law`` of the C core, which lives as long as the program.

    Raises:
        CoreError: it cannot be imported.
        OwnCodeError: it raises an error when it is created.
    """
    own.made(ControlLaw)
    kind: Any = own.found(ControlLaw)
    return _control_law(own, kind)[0]


@functools.cache
def _control_law(own: OwnClass, kind: Any) -> tuple[Any, ...]:
    """Return it for a class; a class redefined under the same name is a different one."""
    law, struct = law_of(own), ffi.new("rthyb_control_law *")
    texts = [ffi.new("char[]", text.encode()) for v in law.values for text in (v.name, v.unit)]
    names = [value.name for value in law.values]
    values = ffi.new("rthyb_law_value[]", max(len(names), 1))
    for i in range(len(names)):
        values[i].name = values[i].label = texts[2 * i]
        values[i].unit, values[i].offset = texts[2 * i + 1], 8 * (1 + i)
    name = ffi.new("char[]", own.name.encode())
    about = getattr(struct, "is")
    about.name, about.meaning, about.values, about.value_count = name, name, values, len(names)
    struct.state_size = law.state_bytes
    calls = _law_calls(own, names)
    for one, call in calls.items():
        setattr(struct, one, call)
    return struct, values, texts, name, calls


def _law_calls(own: OwnClass, names: Sequence[str]) -> dict[str, Any]:
    """Return the functions that C calls; each ``init`` creates a new object.

    The state in C consists of the object's number and the values that it reports.
    """
    at: dict[float, ControlLaw] = {}
    numbers = itertools.count(1)

    def store_values(state: Any, law: ControlLaw, method: str) -> int:
        for i, name in enumerate(names, 1):
            found = getattr(law, name, None)
            # The common case, because this is called several times in every tick.
            if type(found) is float and -VALUE_MAX <= found <= VALUE_MAX:
                state[i] = found
            else:
                state[i] = value_of(law, name, method)
        return 0

    def init(state: Any, start: Any) -> int:
        law, number = own.made(ControlLaw), float(next(numbers))
        law.begin(start.period_s, start.x0_m, start.rest_noise_m)
        place = ffi.cast("double *", state)
        place[0], at[number] = number, law
        # Objects that are no longer in use are the oldest.
        at.pop(number - 64.0, None)
        return store_values(place, law, "begin")

    def rest(state: Any, x_m: float) -> None:
        at[ffi.cast("double *", state)[0]].rest(x_m)

    def observe(state: Any, x_p_m: float, x_m_m: float, frozen: int) -> int:
        place = ffi.cast("double *", state)
        law = at[place[0]]
        law.observe(x_p_m, x_m_m, bool(frozen))
        return store_values(place, law, "observe")

    def lead(state: Any, x_c_m: float, allowed_m: float, x_p_m: Any) -> int:
        place = ffi.cast("double *", state)
        law = at[place[0]]
        x_p_m[0] = x_c_m
        x_p_m[0] = LEAD.number(law, law.lead(x_c_m, allowed_m), (x_c_m, allowed_m))
        return store_values(place, law, "lead")

    functions: dict[str, Callable[..., Any]] = {
        "init": init,
        "rest": rest,
        "observe": observe,
        "lead": lead,
    }
    failed = {"init": lib.RTHYB_E_LAW, "observe": 0, "lead": 0}
    return {
        name: ffi.callback(
            _LAW_CALLS[name].type, guarded(does, f"{name} of {own.name}", failed.get(name))
        )
        for name, does in functions.items()
    }


# ---- a specimen element -------------------------------------------------------------------------


def own_force(own: OwnClass) -> Any:
    """Return the ``rthyb_own_force`` of an element, which lives as long as the program.

    Raises:
        CoreError: it cannot be imported.
        OwnCodeError: it raises an error when it is created.
    """
    kind: Any = own.found(Element)
    return _own_force(own, kind)


@functools.cache
def _own_force(own: OwnClass, kind: Any) -> Any:
    element, room = own.made(Element), 8 * ELEMENT_STATES

    def force(state: Any, x: float, v: float, a: float, dt: float) -> float:
        numbers = memoryview(ffi.buffer(state, room)).cast("B").cast("d")
        found = element.force(x, v, a, dt, numbers)
        # The common case, because this is called many times in every tick.
        if type(found) is float and -FORCE.most <= found <= FORCE.most:
            return found
        return FORCE.number(element, found, (x, v, a, dt))

    return ffi.callback("rthyb_own_force", guarded(force, f"force of {own.name}", 0.0))
