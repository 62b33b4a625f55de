"""A user's class: which arguments its methods take, what they may return, what it may report."""

from __future__ import annotations

import difflib
import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rthyb_rt._core import lib
from rthyb_rt.core.pending import OwnFault, moment_in_words
from rthyb_rt.core.rows import CHANNEL_NAME

DISPLACEMENT_MAX_M: Final = 1e3
"""Largest displacement that the core accepts, RTHYB_DISPLACEMENT_MAX_M of csrc/numeric.h."""
FORCE_MAX_N: Final = 1e12
"""Largest force that the core accepts, RTHYB_FORCE_MAX_N of csrc/numeric.h."""
VALUE_MAX: Final = 1e150
"""Largest value in any unit that a class may report: its square, as in an rms, is finite."""

_STARS: Final[dict[Any, str]] = {
    inspect.Parameter.VAR_POSITIONAL: "*",
    inspect.Parameter.VAR_KEYWORD: "**",
}


@dataclass(frozen=True)
class OwnMethod:
    """A method that the core calls.

    Attributes:
        name: its name.
        takes: names of its arguments, without ``self``.
        returns: what it must return, for messages; "": nothing.
        most: largest magnitude of a number that it returns.
        needed: whether every class must define it.
    """

    name: str
    takes: tuple[str, ...]
    returns: str = ""
    most: float = math.inf
    needed: bool = False

    @property
    def form(self) -> str:
        """Its first line, without ``def``."""
        return f"{self.name}({', '.join(('self', *self.takes))})"

    def complaint(self, kind: type, base: type) -> str | None:
        """Return what is wrong with the method of a class, or None.

        Args:
            kind: the user's class.
            base: the class of this program from which it is derived.
        """
        if getattr(kind, self.name) is getattr(base, self.name):
            if not self.needed:
                return None
            own = [
                name
                for name, value in vars(kind).items()
                if inspect.isfunction(value) and name != self.name
            ]
            close = difflib.get_close_matches(self.name, own, n=1)
            has = f"; is {close[0]} misspelt?" if close else ""
            return (
                f"{kind.__name__} at {place_of(kind)} has no method {self.form}{has}; define it so "
                f"that it returns {self.returns}"
            )
        function = inspect.getattr_static(kind, self.name)
        if not inspect.isfunction(function):
            # A static method, a partial function and the like may be called as well.
            if callable(function) or hasattr(function, "__get__"):
                return None
            return (
                f"{kind.__name__}.{self.name} at {place_of(kind)} is {_said(function)}, which is "
                f"not a method: define it as {self.form}"
            )
        signature = inspect.signature(function)
        try:
            signature.bind(None, *self.takes)
        except TypeError:
            taken = ", ".join(
                _STARS.get(one.kind, "") + one.name for one in signature.parameters.values()
            )
            return (
                f"{kind.__name__}.{self.name} at {place_of(function)} takes ({taken}), but it is "
                f"called with {len(self.takes)} values after self: define it as {self.form}"
            )
        return None

    def number(
        self, made: object, found: object, given: Sequence[float] = (), name: str = ""
    ) -> float:
        """Return a number that the method returned.

        Args:
            made: the user's object.
            found: what its method returned.
            given: the values with which it was called, for the message.
            name: name of the number, if the method returns several.

        Raises:
            OwnFault: it is not a number, not finite, or too large.
        """
        value = _number(found)
        if abs(value) <= self.most:
            return value
        named = f"{name} = " if name else ""
        hint = " (is a return missing?)" if found is None and not name else ""
        raise self.fault(made, f"returned {named}{_said(found)}{hint}", given)

    def fault(self, made: object, what: str, given: Sequence[float] = ()) -> OwnFault:
        """Return the error for an object whose method did what it must not.

        Args:
            made: the user's object.
            what: what it did: "returned nan".
            given: the values with which it was called.
        """
        kind = type(made)
        values = ", ".join(f"{n} = {v:.6g}" for n, v in zip(self.takes, given, strict=False))
        most = "" if math.isinf(self.most) else f", finite and of at most {self.most:g}"
        return OwnFault(
            f"{kind.__name__}.{self.name} {what}{moment_in_words()}"
            f"{f', for {values}' if values else ''}; it must return {self.returns}{most}",
            f"{place_of(inspect.getattr_static(kind, self.name))}, in {self.name}",
        )


@dataclass(frozen=True)
class OwnValues:
    """The attribute of a class that names what it reports, with units.

    Attributes:
        name: its name.
        most: how many there may be.
        example: one of them with its unit, for messages.
    """

    name: str
    most: int
    example: str

    def complaint(self, kind: type) -> str | None:
        """Return what is wrong with the attribute of a class, or None."""
        given, at = getattr(kind, self.name), f"{kind.__name__} at {place_of(kind)}"
        form = f"define {self.name} as a dict of names and units, {{{self.example}}}"
        if not isinstance(given, Mapping):
            return f"{at} has {self.name} = {_said(given)}: {form}"
        if len(given) > self.most:
            return f"{at} has {len(given)} {self.name}; at most {self.most} are allowed"
        for name, unit in given.items():
            if not isinstance(name, str) or not CHANNEL_NAME.fullmatch(name):
                return (
                    f"{at} has {_said(name)} as a name in {self.name}; a name consists of up to 32 "
                    f"of a-z, 0-9 and _, and begins with a letter: {form}"
                )
            if not isinstance(unit, str):
                return (
                    f"{at} has {_said(unit)} as the unit of {name} in {self.name}; a unit is a "
                    f'string, such as "m", or "1" for a number without unit: {form}'
                )
        return None


def value_of(law: object, name: str, method: str) -> float:
    """Return a value that a law reports, an attribute of that name.

    Args:
        law: the user's object.
        name: the value.
        method: name of the method that has just been called.

    Raises:
        OwnFault: it is missing, not a number, not finite, or too large.
    """
    found = getattr(law, name, None)
    value = _number(found)
    if abs(value) <= VALUE_MAX:
        return value
    kind = type(law)
    what = f"is {_said(found)}" if hasattr(law, name) else "is missing"
    begun = "" if method != "begin" else ", in begin, before the first sample"
    raise OwnFault(
        f"{kind.__name__}.values names {name}, but the attribute {name} {what} after "
        f"{method}{moment_in_words()}; set self.{name} to a number, finite and of at most "
        f"{VALUE_MAX:g}{begun}, or remove it from values",
        f"{place_of(getattr(kind, method))}, in {method}"
        if method in vars(kind) and inspect.isfunction(getattr(kind, method))
        else place_of(kind),
    )


def settings_complaint(kind: type, given: Mapping[str, object]) -> tuple[str, str] | None:
    """Return why a class cannot be created with certain settings, or None.

    Args:
        kind: the user's class.
        given: the settings by name.

    Returns:
        What is wrong; the first setting that it does not take, "" if there is none.
    """
    init: Any = kind.__init__  # type: ignore[misc]
    taken = list(inspect.signature(init).parameters.values())[1:]
    if init is object.__init__:
        taken = []
    by_name = {
        one.name: one for one in taken if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)
    }
    place = place_of(init if inspect.isfunction(init) else kind)
    said = f"{kind.__name__}.__init__ at {place}"
    for one in taken:
        if one.kind is one.POSITIONAL_ONLY or (
            one.kind is one.VAR_POSITIONAL and one.name in given
        ):
            return (
                f"{said} takes {_STARS.get(one.kind, '')}{one.name} by position only, but a file "
                "states every setting by its name: give each an argument with a name, or give "
                "them as one list",
                "",
            )
    wrong = [
        f"{name} is missing"
        for name, one in by_name.items()
        if one.default is one.empty and name not in given
    ]
    unknown = [name for name in given if name not in by_name]
    if any(one.kind is one.VAR_KEYWORD for one in taken):
        unknown = []
    for name in unknown:
        close = difflib.get_close_matches(name, [one for one in by_name if one not in given], n=1)
        wrong.append(f"{name} is unknown" + (f" (is it {close[0]}?)" if close else ""))
    if not wrong:
        return None
    allowed = ", ".join(
        name if one.default is one.empty else f"{name} = {_said(one.default)}"
        for name, one in by_name.items()
    )
    found = ", ".join(given) or "none"
    return (
        f"{said} takes {f'the settings {allowed}' if allowed else 'no settings'}; found {found}: "
        f"{', '.join(wrong)}",
        unknown[0] if unknown else "",
    )


def place_of(thing: Any) -> str:
    """Return file and line of a class or a function, or its module where Python knows no file."""
    code = getattr(thing, "__code__", None)
    if code is not None:
        return f"{_short(code.co_filename)}:{code.co_firstlineno}"
    try:
        return f"{_short(inspect.getfile(thing))}:{inspect.getsourcelines(thing)[1]}"
    except (OSError, TypeError):
        return f"module {getattr(thing, '__module__', '?')}"


def _short(file: str) -> str:
    """Return a path relative to the working directory if it is below it."""
    path = Path(file)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else file


def _number(found: object) -> float:
    """Return a number that a user's class gave, NaN for what is none."""
    try:
        return math.nan if isinstance(found, (str, bytes)) else float(found)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return math.nan


def _said(found: object) -> str:
    text = repr(found)
    return text if len(text) <= 60 else f"{text[:57]}..."


ANSWER: Final = OwnMethod(
    "answer", ("ag_mps2", "force_n"),
    "the displacement of the next sample as one number, m, or one for each interface",
    DISPLACEMENT_MAX_M, needed=True,
)  # fmt: skip
PART: Final = (
    ANSWER,
    OwnMethod("begin", ("period_s", "k_e_n_per_m")),
    OwnMethod("advance", ()),
    OwnMethod("freeze", ("force_n",)),
    OwnMethod("report", (), "a list of numbers, one for each of its responses", VALUE_MAX),
)
"""Methods of a numerical part."""
REPORT: Final = PART[-1]
LEAD: Final = OwnMethod(
    "lead", ("x_c_m", "allowed_m"), "the command x_p as one number, m", DISPLACEMENT_MAX_M,
    needed=True,
)  # fmt: skip
LAW: Final = (
    LEAD,
    OwnMethod("begin", ("period_s", "x0_m", "rest_noise_m")),
    OwnMethod("rest", ("x_m",)),
    OwnMethod("observe", ("x_p_m", "x_m_m", "frozen")),
)
"""Methods of a control law."""
FORCE: Final = OwnMethod(
    "force", ("x_m", "v_m_per_s", "a_m_per_s2", "dt_s", "state"), "the force as one number, N",
    FORCE_MAX_N, needed=True,
)  # fmt: skip
RESPONSES: Final = OwnValues("responses", lib.RTHYB_RESPONSES_MAX, '"roof": "m"')
"""What a numerical part reports."""
VALUES: Final = OwnValues("values", lib.RTHYB_LAW_VALUES_MAX, '"tau_s": "s"')
"""What a control law reports."""
