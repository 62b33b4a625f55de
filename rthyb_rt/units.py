"""Numbers written with a unit, as on a drawing or a data sheet: ``"25 mm"``, ``"666.4 kN/m"``.

A small table of the units that a structural laboratory uses. Values are converted exactly (as
fractions) and rounded once, so ``"9 mm"`` is the same double as ``0.009``.
"""

from __future__ import annotations

import re
from fractions import Fraction
from functools import cache
from typing import NamedTuple

Dimension = tuple[int, int, int, int]
"""Exponents of mass, length, time and sample count."""

_MASS: Dimension = (1, 0, 0, 0)
_LENGTH: Dimension = (0, 1, 0, 0)
_TIME: Dimension = (0, 0, 1, 0)
_FREQUENCY: Dimension = (0, 0, -1, 0)
_FORCE: Dimension = (1, 1, -2, 0)
_ACCELERATION: Dimension = (0, 1, -2, 0)
_ENERGY: Dimension = (1, 2, -2, 0)
_COUNT: Dimension = (0, 0, 0, 1)
_RATIO: Dimension = (0, 0, 0, 0)

_DIMENSION_NAMES: dict[Dimension, str] = {
    _MASS: "a mass",
    _LENGTH: "a length",
    _TIME: "a time",
    _FREQUENCY: "a frequency",
    _FORCE: "a force",
    _ACCELERATION: "an acceleration",
    _ENERGY: "an energy",
    _COUNT: "a number of samples",
    _RATIO: "a number without a unit (or with %)",
    (0, 1, -1, 0): "a velocity",
    (0, 2, -1, 0): "an area per time",
    (1, 0, -2, 0): "a stiffness",
    (1, 0, -1, 0): "a damping coefficient",
    (0, 0, -2, 0): "a rate per second squared",
    (0, -1, 0, 0): "a rate per length",
    (0, -1, 1, 0): "a time per length",
    (1, -1, 0, 0): "a quadratic damping coefficient",
    (1, -1, -2, 0): "a quadratic stiffness",
    (1, -2, -2, 0): "a cubic stiffness",
}

_UNITS: dict[str, tuple[str, Dimension]] = {
    "m": ("1", _LENGTH),
    "km": ("1e3", _LENGTH),
    "cm": ("1e-2", _LENGTH),
    "mm": ("1e-3", _LENGTH),
    "um": ("1e-6", _LENGTH),
    "nm": ("1e-9", _LENGTH),
    "in": ("0.0254", _LENGTH),
    "ft": ("0.3048", _LENGTH),
    "kg": ("1", _MASS),
    "t": ("1e3", _MASS),
    "s": ("1", _TIME),
    "ms": ("1e-3", _TIME),
    "us": ("1e-6", _TIME),
    "min": ("60", _TIME),
    "Hz": ("1", _FREQUENCY),
    "kHz": ("1e3", _FREQUENCY),
    "N": ("1", _FORCE),
    "mN": ("1e-3", _FORCE),
    "kN": ("1e3", _FORCE),
    "MN": ("1e6", _FORCE),
    "J": ("1", _ENERGY),
    "kJ": ("1e3", _ENERGY),
    "lbf": ("4.4482216152605", _FORCE),
    "kip": ("4448.2216152605", _FORCE),
    "g": ("9.80665", _ACCELERATION),
    "gal": ("1e-2", _ACCELERATION),
    "Gal": ("1e-2", _ACCELERATION),
    "samples": ("1", _COUNT),
    "sample": ("1", _COUNT),
    "%": ("1e-2", _RATIO),
    "rad": ("1", _RATIO),
    "mrad": ("1e-3", _RATIO),
}

# The length of the exponent is limited so that it cannot cause a huge fraction.
_NUMBER = re.compile(
    r"\s*([+-]?(?:\d{1,40}(?:\.\d{0,40})?|\.\d{1,40})(?:[eE][+-]?\d{1,3})?)(.*)", re.S
)
_TOKEN = re.compile(r"\s*(?:([A-Za-z%]+)|([*/()^])|([+-]?\d{1,2}))")
_SPELLINGS = str.maketrans({"·": "*", "⋅": "*", "×": "*", "µ": "u", "μ": "u", "−": "-"})
_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
_SUPERSCRIPT_RUN = re.compile("([⁰¹²³⁴⁵⁶⁷⁸⁹⁻]+)")


class UnitError(ValueError):
    """A text that is not a number with a known unit of the right kind."""


class Unit(NamedTuple):
    """A unit as a factor to SI and its dimension."""

    factor: Fraction
    dimension: Dimension


class _UnitReader:
    """Recursive-descent reader of ``N s/m``, ``kN*s/m``, ``m/s^2``, ``N/(m/s)``, ``1/s``."""

    def __init__(self, text: str) -> None:
        self.text = text
        plain = text.translate(_SPELLINGS)
        plain = _SUPERSCRIPT_RUN.sub(lambda run: "^" + run[1].translate(_SUPERSCRIPTS), plain)
        self.tokens: list[str] = []
        at = 0
        plain = plain.strip()
        while at < len(plain):
            match = _TOKEN.match(plain, at)
            if match is None:
                raise self.unknown(plain[at:].strip())
            self.tokens.append(match[0].strip())
            at = match.end()
        self.at = 0

    def unknown(self, part: str) -> UnitError:
        known = ", ".join(_UNITS)
        return UnitError(f'the unit "{part}" is not known; known are {known}')

    def peek(self) -> str:
        return self.tokens[self.at] if self.at < len(self.tokens) else ""

    def take(self) -> str:
        token = self.peek()
        self.at += 1
        return token

    def product(self) -> Unit:
        factor, dimension = self.term()
        while self.peek() not in ("", ")"):
            sign = -1 if self.peek() == "/" else 1
            if self.peek() in "*/":
                self.take()
            other = self.term()
            factor *= other.factor**sign
            a, b = dimension, other.dimension
            dimension = (
                a[0] + sign * b[0],
                a[1] + sign * b[1],
                a[2] + sign * b[2],
                a[3] + sign * b[3],
            )
        return Unit(factor, dimension)

    def term(self) -> Unit:
        token = self.take()
        if token == "(":
            unit = self.product()
            if self.take() != ")":
                raise UnitError(f'a ")" is missing in the unit "{self.text.strip()}"')
        elif token == "1":
            unit = Unit(Fraction(1), _RATIO)
        elif token in _UNITS:
            text, dimension = _UNITS[token]
            unit = Unit(Fraction(text), dimension)
        else:
            raise self.unknown(token or self.text.strip())
        power = self.exponent()
        a = unit.dimension
        return Unit(unit.factor**power, (a[0] * power, a[1] * power, a[2] * power, a[3] * power))

    def exponent(self) -> int:
        if self.peek() == "^":
            self.take()
        elif not self.peek().lstrip("+-").isdigit():
            return 1
        try:
            return int(self.take())
        except ValueError:
            raise UnitError(f'an exponent is missing in "{self.text.strip()}"') from None


@cache
def unit(text: str) -> Unit:
    """Return the factor to SI and the dimension of a unit; an empty text is a plain number.

    Raises:
        UnitError: a part of the text is not a known unit.
    """
    if not text.strip():
        return Unit(Fraction(1), _RATIO)
    reader = _UnitReader(text)
    result = reader.product()
    if reader.peek():
        raise reader.unknown(reader.peek())
    return result


def dimension_name(unit_text: str) -> str:
    """Return what a unit measures, in words: ``"N/m"`` -> ``"a stiffness"``."""
    return _DIMENSION_NAMES.get(unit(unit_text).dimension, f"a quantity in {unit_text}")


def convert(text: str, to_unit: str) -> float:
    """Read a number with a unit and return it in another unit of the same kind.

    Args:
        text: for example ``"25 mm"``, ``"0.04 g"``, ``"666.4 kN/m"``, ``"3 %"``.
        to_unit: the unit of the result, for example ``"m"``; empty for a ratio.

    Returns:
        The nearest double to the exact value.

    Raises:
        UnitError: the text is not a number with a unit, the unit is unknown, or it measures
            something else.
    """
    match = _NUMBER.fullmatch(text)
    if match is None:
        raise UnitError("that is not a number with a unit")
    number, rest = match.groups()
    if rest.lstrip().startswith(","):
        raise UnitError("the decimal sign is a point, not a comma")
    target = unit(to_unit)
    if not rest.strip():
        raise UnitError("a number in quotes needs a unit; leave the quotes out if it has none")
    given = unit(rest)
    if given.dimension != target.dimension:
        raise UnitError(f"that is {dimension_name(rest.strip())}")
    try:
        return float(Fraction(number) * given.factor / target.factor)
    except OverflowError:
        raise UnitError("that is too large for a number") from None
