"""The catalogue of effects that a model may have left out; see `base.Effect` for adding one."""

from __future__ import annotations

from rthyb_rt.diagnose.effects import friction, hysteretic, inertial, sensor, springs
from rthyb_rt.diagnose.effects.base import Context, Effect, Param, Trial

_REGISTER: dict[str, Effect] = {}


def register(effect: Effect) -> None:
    """Add an effect to the catalogue, or replace the one of its name."""
    _REGISTER[effect.name] = effect


def remove(name: str) -> None:
    """Take an effect out of the catalogue."""
    _REGISTER.pop(name, None)


def catalogue() -> dict[str, Effect]:
    """Return the effects on the force by name, in a fixed order."""
    return dict(_REGISTER)


for _module in (springs, friction, inertial, hysteretic, sensor):
    for _effect in _module.EFFECTS:
        register(_effect)


def params_of(name: str, effect: Effect) -> set[str]:
    """Return the names of an effect's parameters; of one part of a joint law where it is one."""
    own = _REGISTER.get(name)
    return {p.name for p in (own or effect).params}


__all__ = ["Context", "Effect", "Param", "Trial", "catalogue", "params_of", "register", "remove"]
