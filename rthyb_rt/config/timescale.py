"""A slow time scale: the structure's equation of motion in the laboratory's time.

With L seconds in the laboratory per second of the structure, X(L t) = x(t), and a derivative by the
laboratory's time is 1/L of one by the structure's. So

    m x'' + c x' + k x + f = -m ag(t)      becomes      L^2 m X'' + L c X' + k X + f = -L^2 m A,

A(L t) = ag(t) / L^2: masses grow by L^2, dampings by L, stiffnesses are unchanged, and the ground
acceleration shrinks by L^2. All other figures of a test (control law, limits, margins, roots) are
then in laboratory time. Each integrator of the program takes the same step as the unscaled one with
h / L, because it uses only h c / m and h^2 k / m.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from rthyb_rt.core.settings import ElementConfig

_EXPONENTS: Final = (
    ("_n_s2_per_m2", 2),
    ("_s_per_m", 1),
    ("_m_per_s", -1),
    ("_kg", 2),
    ("_hz", -1),
    ("_s", 1),
)
"""Powers of a second in the units of element parameters, with force and length unscaled."""


def exponent(parameter: str) -> int:
    """Return the power of the time scale by which a parameter of an element grows."""
    return next((power for suffix, power in _EXPONENTS if parameter.endswith(suffix)), 0)


def slowed(element: ElementConfig, time_scale: float) -> ElementConfig:
    """Return an element with the same force for the same motion on a slower time scale.

    Args:
        element: element of a structure or a specimen.
        time_scale: seconds in the laboratory per second of the structure.
    """
    # NumPy, which the core needs, is slow to import, and few tests have a time scale.
    from rthyb_rt.core.library import CoreError
    from rthyb_rt.core.settings import ELEMENT_PARAMS

    if element.own is not None:
        if time_scale == 1.0:
            return element
        raise CoreError(f"how {element.own.name} behaves in stretched time is not known")
    names = ELEMENT_PARAMS[element.kind]
    values = (
        value * time_scale ** exponent(name)
        for name, value in zip(names, element.params, strict=True)
    )
    return replace(element, params=tuple(values))


def rate_dependent(element: ElementConfig) -> bool:
    """Return whether an element's force depends on the rate of the motion."""
    from rthyb_rt.core.settings import ELEMENT_PARAMS

    if element.own is not None:
        return True  # unknown, so assumed
    return on_rate(zip(ELEMENT_PARAMS[element.kind], element.params, strict=True))


def on_rate(params: Iterable[tuple[str, float]]) -> bool:
    """Return whether a law with these parameters, by name, depends on the rate of the motion.

    One of zero does not count: a stop without loss is elastic.
    """
    return any(value != 0.0 and exponent(name) for name, value in params)
