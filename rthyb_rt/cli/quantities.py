"""Numbers with a unit on the command line."""

from __future__ import annotations

import re
from dataclasses import dataclass

import typer

_PLAIN = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*", re.ASCII)


@dataclass(frozen=True)
class Allowed:
    """Values that an option accepts: ``low`` to ``high`` in ``unit``; plain ones in ``plain``."""

    unit: str
    plain: str
    low: float
    high: float
    words: str
    example: str


def read(text: str, option: str, allowed: Allowed) -> float:
    """Return the value of an option, in its unit.

    Raises:
        typer.BadParameter: the value is not allowed.
    """
    from rthyb_rt.units import UnitError, convert

    plain = _PLAIN.fullmatch(text)
    fault = f", assumed to be in {allowed.plain}" if plain else ""
    try:
        value = convert(f"{text} {allowed.plain}" if plain else text, allowed.unit)
        if allowed.low <= value <= allowed.high:
            return value
    except UnitError as error:
        fault = f" ({error})"
    raise typer.BadParameter(
        f'found "{text}"{fault}; must be {allowed.words}, as in {option} "{allowed.example}"',
        param_hint=option,
    )
