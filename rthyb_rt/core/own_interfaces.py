"""The interfaces of a part of your own: their order, and the specimen's stiffness at them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Protocol

from rthyb_rt._core import ffi
from rthyb_rt.core.library import CoreError

Stiffness = float | tuple[tuple[float, ...], ...]
"""Elastic stiffness along the directions of a rig: a number, or the rows of a matrix, (m, m)."""
Places = tuple[int, ...]
IN_ORDER: Final[Places] = ()
"""The places of a part that has its interfaces in the order of the directions."""


class AtInterfaces(Protocol):
    """Settings of any part of your own, as far as they concern its interfaces.

    Attributes:
        k_e_n_per_m: elastic stiffness of the specimen along the directions of the rig: a number,
            or the rows of a matrix, (m, m).
        period_s: sampling period.
        place: for each direction the number of the part's interface, from 0, (m,); `IN_ORDER`.
    """

    @property
    def k_e_n_per_m(self) -> Stiffness: ...
    @property
    def period_s(self) -> float: ...
    @property
    def place(self) -> Places: ...


def rows_of(stiffness: Stiffness) -> tuple[tuple[float, ...], ...]:
    """Return the elastic stiffness of a specimen as rows, also if it is a single number."""
    return stiffness if isinstance(stiffness, tuple) else ((stiffness,),)


def own_stiffness(part: AtInterfaces) -> tuple[tuple[float, ...], ...]:
    """Return the elastic stiffness of the specimen in the part's order of its interfaces."""
    rows = rows_of(part.k_e_n_per_m)
    places = part.place or range(len(rows))
    order = sorted(range(len(rows)), key=lambda i: places[i])
    return tuple(tuple(rows[i][j] for j in order) for i in order)


def fill_setup(cfg: Any, part: AtInterfaces, interfaces: int, values: list[float]) -> list[Any]:
    """Fill interfaces and setup of a ``rthyb_library_config``.

    Args:
        cfg: the struct.
        part: the settings of the part.
        interfaces: how many the part has.
        values: its parameters, in its own order.

    Returns:
        The objects that must outlive it.

    Raises:
        CoreError: the part does not have an interface for each direction of the rig.
    """
    given = len(rows_of(part.k_e_n_per_m))
    place = part.place or tuple(range(given))
    if interfaces != given:
        each = "one direction" if given == 1 else f"{given} directions"
        raise CoreError(
            f"found {interfaces} interface{'s' if interfaces > 1 else ''} for {each}; a numerical "
            "part must have as many interfaces as the specimen has directions in which it is moved"
        )
    if sorted(place) != list(range(given)):
        raise CoreError(
            f"found the interfaces {', '.join(map(str, place))} of the part for {given} "
            f"directions; each of 0 to {given - 1} must occur once"
        )
    stiffness = own_stiffness(part)
    kept = [ffi.new("double[]", values or [0.0])]
    kept.append(ffi.new("double[]", [stiffness[i][i] for i in range(given)]))
    kept.append(ffi.new("double[]", [v for row in stiffness for v in row]))
    cfg.interfaces, cfg.place[0:given] = given, list(place)
    cfg.setup.period_s, cfg.setup.interfaces = part.period_s, given
    cfg.setup.parameter, cfg.setup.k_e_n_per_m, cfg.setup.stiffness_n_per_m = kept
    return kept


def plain_interfaces(part: AtInterfaces) -> dict[str, Any]:
    """Return stiffness and places as plain values; of one interface, only the stiffness."""
    if not isinstance(part.k_e_n_per_m, tuple):
        return {"k_e_n_per_m": part.k_e_n_per_m}
    rows = [list(row) for row in part.k_e_n_per_m]
    return {"k_e_n_per_m": rows, "place": list(part.place)}


def interfaces_of_plain(plain: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that `plain_interfaces` described."""
    k_e = plain["k_e_n_per_m"]
    if not isinstance(k_e, list):
        return {"k_e_n_per_m": k_e}
    return {"k_e_n_per_m": tuple(map(tuple, k_e)), "place": tuple(plain["place"])}
