"""The control laws of the core, as described by their own tables.

Each law is a file ``csrc/law_NAME.c``, the only place that defines its name, its settings and the
values that it reports. Settings, messages, documentation and figures take their texts from there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from rthyb_rt._core import ffi, lib


@dataclass(frozen=True)
class Parameter:
    """One setting of a control law.

    Attributes:
        key: key in a test file below ``[controller]``, with a point between table and key.
        unit: SI unit; "" for a dimensionless number.
        low, high: allowed range; ``open_low`` and ``open_high`` exclude the bound itself.
        default: value if the file gives none; None: the test file must give it, or
            the rig file at ``rig_key``.
        meaning: description, worded as the beginning of a sentence.
        rig_key: key in a rig file, which applies if the test file does not give the value.
        words: text for summaries, with ``{}`` for the number.
    """

    key: str
    unit: str
    low: float
    high: float
    default: float | None
    meaning: str
    open_low: bool
    open_high: bool
    rig_key: str | None
    words: str | None


@dataclass(frozen=True)
class Value:
    """One number that a control law reports at every tick: its name, unit and label in figures."""

    name: str
    unit: str
    label: str


@dataclass(frozen=True)
class LawDescription:
    """A control law.

    Attributes:
        name: value of ``controller.type``.
        meaning: description in one line.
        calmer: what to change when it learns wrongly; None: it does not learn.
        parameters: settings in the order of the core.
        values: values that it reports; alpha and beta are stored in the record.
        uses_rest_noise: whether it needs the noise at rest.
        with_rfc: whether it is designed for use with the restoring-force compensator; other laws
            were published without one.
        passes: whether the command is x_c itself; force compensation is then off.
        as_printed: whether settings left open keep the paper's constants, whatever the rig.
        learns_curvature: whether a phase lead adapts beta as well as alpha.
        benchmark_start: initial values in the benchmark: ``rig``, ``second-order``,
            ``third-order`` (an inverse fitted to the rig's sweep), or ``table``.
        kind: its number in this version of the program only.
        state_bytes: size of its state.
    """

    name: str
    meaning: str
    calmer: str | None
    parameters: tuple[Parameter, ...]
    values: tuple[Value, ...]
    uses_rest_noise: bool
    with_rfc: bool
    kind: int
    state_bytes: int
    passes: bool = False
    as_printed: bool = False
    learns_curvature: bool = False
    benchmark_start: str = "rig"

    @property
    def runs_unset(self) -> bool:
        """Whether every setting has a default or a place in the rig file."""
        return all(p.default is not None or p.rig_key for p in self.parameters)

    @property
    def learns(self) -> bool:
        """Whether the law changes while a test runs."""
        return self.calmer is not None

    def parameter(self, key: str) -> Parameter | None:
        """Return the setting with this key, or None."""
        return next((p for p in self.parameters if p.key == key), None)

    def value(self, name: str) -> Value | None:
        """Return the reported value with this name, or None."""
        return next((v for v in self.values if v.name == name), None)

    @property
    def beside(self) -> tuple[Value, ...]:
        """Values reported in addition to alpha and beta, which have fields in the record."""
        return tuple(value for value in self.values if value.name not in ("alpha", "beta"))

    def ordered(self, given: Mapping[str, float]) -> list[float]:
        """Return all settings in the core's order, with defaults for those not given.

        Raises:
            ValueError: a setting is unknown, or one without a default is missing.
        """
        unknown = sorted(set(given) - {p.key for p in self.parameters})
        if unknown:
            raise ValueError(
                f"control law {self.name!r}: found {', '.join(unknown)}; it accepts "
                f"{', '.join(p.key for p in self.parameters) or 'nothing'}"
            )
        values = [given.get(p.key, p.default) for p in self.parameters]
        missing = [p.key for p, v in zip(self.parameters, values, strict=True) if v is None]
        if missing:
            raise ValueError(f"control law {self.name!r}: {', '.join(missing)} missing")
        return [float(value) for value in values if value is not None]

    def complaint(self, values: Sequence[float], period_s: float) -> tuple[str, str] | None:
        """Return what is wrong with a combination of settings that are each within range.

        Args:
            values: settings in the core's order.
            period_s: sampling period.

        Returns:
            The key to report and the reason, or None.
        """
        why = ffi.new("rthyb_law_complaint *")
        at = lib.rthyb_law_check(self.kind, ffi.new("double[]", list(values)), period_s, why)
        if at < 0:
            return None
        return self.parameters[at].key, _words(why.text).format(*(f"{n:g}" for n in why.numbers))


def _text(pointer: Any) -> str | None:
    return None if pointer == ffi.NULL else bytes(ffi.string(pointer)).decode("utf-8")


def _words(pointer: Any) -> str:
    return _text(pointer) or ""


def _parameter(p: Any) -> Parameter:
    return Parameter(
        key=_words(p.key),
        unit=_words(p.unit),
        low=float(p.low),
        high=float(p.high),
        default=None if math.isnan(p.standard) else float(p.standard),
        meaning=_words(p.meaning),
        open_low=bool(p.open & lib.RTHYB_OPEN_LOW),
        open_high=bool(p.open & lib.RTHYB_OPEN_HIGH),
        rig_key=_text(p.rig_key),
        words=_text(p.words),
    )


_STARTS: Final[dict[int, str]] = {
    value: name.removeprefix("RTHYB_START_").replace("_", "-").lower()
    for name, value in ffi.typeof("enum rthyb_benchmark_start").relements.items()
}


def _law(kind: int) -> LawDescription:
    found = lib.rthyb_law_describe(kind)
    values = [found.values[i] for i in range(found.value_count)]
    return LawDescription(
        name=_words(found.name),
        meaning=_words(found.meaning),
        calmer=_text(found.calmer),
        parameters=tuple(_parameter(found.parameters[i]) for i in range(found.parameter_count)),
        values=tuple(Value(_words(v.name), _words(v.unit), _words(v.label)) for v in values),
        uses_rest_noise=bool(found.uses_rest_noise),
        with_rfc=bool(found.with_rfc),
        kind=kind,
        state_bytes=int(lib.rthyb_law_state_size(kind)),
        passes=bool(found.passes),
        as_printed=bool(found.as_printed),
        learns_curvature=bool(found.learns_curvature),
        benchmark_start=_STARTS[found.benchmark_start],
    )


LAWS: Final[dict[str, LawDescription]] = {
    law.name: law
    for law in sorted(map(_law, range(lib.rthyb_law_count())), key=lambda law: law.name)
}
"""All control laws by name."""
PASSING: Final[LawDescription] = next(law for law in LAWS.values() if law.passes)
"""The law that compensates nothing."""


def passes(name: str | None) -> bool:
    """Return whether this is the name of the law that compensates nothing."""
    return name == PASSING.name


def law_value(law: str | None, name: str) -> Value | None:
    """Return a value by name; for a law unknown to this version, as other laws define it."""
    known = LAWS.get(law or "")
    if known is not None:
        return known.value(name)
    return next((v for other in LAWS.values() for v in other.values if v.name == name), None)


def parameters() -> dict[str, list[tuple[LawDescription, Parameter]]]:
    """Return every setting of all laws by key, with the laws that have it."""
    found: dict[str, list[tuple[LawDescription, Parameter]]] = {}
    for law in LAWS.values():
        for parameter in law.parameters:
            found.setdefault(parameter.key, []).append((law, parameter))
    return found
