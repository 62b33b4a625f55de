"""The methods of a user's class: which arguments they take, and what they may return."""

from __future__ import annotations

import difflib
import inspect
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rthyb_rt.core.pending import OwnFault, moment_in_words

DISPLACEMENT_MAX_M: Final = 1e3
"""Largest displacement that the core accepts, RTHYB_DISPLACEMENT_MAX_M of csrc/numeric.h."""
FORCE_MAX_N: Final = 1e12
"""Largest force that the core accepts, RTHYB_FORCE_MAX_N of csrc/numeric.h."""

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
            own = [name for name, value in vars(kind).items() if inspect.isfunction(value)]
            close = difflib.get_close_matches(self.name, own, n=1)
            has = f"; is {close[0]} misspelt?" if close else ""
            return (
                f"{kind.__name__} at {place_of(kind)} has no method {self.form}{has}; define it so "
                f"that it returns {self.returns}"
            )
        function = inspect.getattr_static(kind, self.name)
        if not inspect.isfunction(function):
            return None
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

    def number(self, made: object, found: object, given: Sequence[float]) -> float:
        """Return a number that the method returned.

        Args:
            made: the user's object.
            found: what its method returned.
            given: the values with which it was called, for the message.

        Raises:
            OwnFault: it is not a number, not finite, or too large.
        """
        try:
            value = math.nan if isinstance(found, (str, bytes)) else float(found)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            value = math.nan
        if abs(value) <= self.most:
            return value
        raise self.fault(made, f"returned {_said(found)}", given)

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


def _said(found: object) -> str:
    if found is None:
        return "None (is a return missing?)"
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
    OwnMethod("report", (), "a list of numbers, one for each of its responses"),
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
