"""The poles of a linear plant, s' = a s + b u: which of them grow, and which do not decay."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

Rows = Sequence[Sequence[float]]

_ROUNDING: Final = 1e-8
"""Share of the fastest pole below which a real part is that of an integrator or of an undamped
motion: rounding of the eigenvalues, and of numbers that a file gives to eight digits."""


def in_words(pole: complex) -> str:
    """Return a pole as frequency and damping ratio, or, if it is real, as its rate."""
    if pole.imag == 0.0:
        return f"{pole.real:.3g} per second" if pole.real else "0 Hz"
    size = abs(pole)
    return f"{size / (2.0 * math.pi):.4g} Hz with a damping ratio of {-pole.real / size:.2g}"


def growing(a: Rows) -> list[complex]:
    """Return the poles whose motion grows, the fastest first; one of each conjugate pair."""
    poles, rounding = _poles(a)
    return sorted((p for p in poles if p.real > rounding), key=lambda pole: -pole.real)


def staying(a: Rows) -> list[complex]:
    """Return the poles whose motion neither grows nor decays, apart from rounding."""
    poles, rounding = _poles(a)
    return [complex(0.0, p.imag) for p in poles if abs(p.real) <= rounding]


def _poles(a: Rows) -> tuple[list[complex], float]:
    import numpy as np

    found = [complex(pole) for pole in np.linalg.eigvals(np.array(a, dtype=np.float64))]
    rounding = _ROUNDING * max(abs(pole) for pole in found)
    # Next to nothing beside the fastest pole, an imaginary part is rounding as well.
    real = [complex(p.real, 0.0) if abs(p.imag) <= rounding else p for p in found]
    return [pole for pole in real if pole.imag >= 0.0], rounding


def fault(a: Rows) -> str | None:
    """Return what is wrong with the poles of a plant, and what can be done; None if nothing is."""
    found = growing(a)
    if not found:
        return None
    first = found[0]
    others = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    return (
        f"found a pole at {in_words(first)}{others}, whose motion grows by a factor of e every "
        f"{1.0 / first.real:.3g} s, whatever the command; the motion of every pole must decay. "
        "a is in continuous time, s' = a s + b u with time in s: convert the matrices of a model "
        "in discrete time. If a was identified, fit it with stable poles or with fewer states"
    )


def note(a: Rows) -> str | None:
    """Return the note on poles that neither grow nor decay; None if there are none."""
    found = staying(a)
    if not found:
        return None
    places = ", ".join(in_words(pole) for pole in found)
    what = (
        "a constant command can move an axis without end"
        if any(pole.imag == 0.0 for pole in found)
        else "motions at this frequency do not die out"
    )
    return f"[plant] has poles that neither decay nor grow ({places}): {what}"
