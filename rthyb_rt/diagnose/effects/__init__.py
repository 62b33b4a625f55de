"""The catalogue of effects that a model may have left out; see `base.Effect` for adding one."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rthyb_rt.diagnose.effects import dampers, friction, hysteretic, inertial, sensor, springs, worn
from rthyb_rt.diagnose.effects.base import Context, Effect, Param, Trial
from rthyb_rt.errors import InputError

_REGISTER: dict[str, Effect] = {}


def register(effect: Effect) -> None:
    """Add an effect to the catalogue, or replace the one with the same name."""
    _REGISTER[effect.name] = effect


def remove(name: str) -> None:
    """Remove an effect from the catalogue."""
    _REGISTER.pop(name, None)


def catalogue() -> dict[str, Effect]:
    """Return the effects on the force by name, in a fixed order."""
    return dict(_REGISTER)


def having(declared: Callable[[Effect], object]) -> frozenset[str]:
    """Return the names of the effects with a property, as in ``having(lambda e: e.dry)``."""
    return frozenset(name for name, effect in _REGISTER.items() if declared(effect))


def of_number(number: str) -> str:
    """Return the name of the effect that changes a number of the model; empty if none does."""
    return next((name for name, effect in _REGISTER.items() if effect.number == number), "")


def load(path: Path) -> list[str]:
    """Run a Python file that registers effects; return the names that are new or replaced.

    Raises:
        InputError: it cannot be read, fails, or registers nothing.
    """
    before = dict(_REGISTER)
    spec = importlib.util.spec_from_file_location(f"rthyb_effect_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise InputError("is not a Python file; its name must end in .py", str(path))
    try:
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", str(path)) from error
    except Exception as error:  # whatever a user's file may raise
        line = _line_of(error, path)
        raise InputError(f"{type(error).__name__}: {error}", f"{path}{line}") from error
    added = [name for name, effect in _REGISTER.items() if before.get(name) is not effect]
    if not added:
        raise InputError(
            "registers no effect; it must end with effects.register(YourEffect())", str(path)
        )
    for name in added:
        _check(_REGISTER[name], str(path))
    return added


@contextmanager
def beside(own: Sequence[Effect]) -> Iterator[None]:
    """Add user-defined effects to the catalogue for the duration of the block.

    Raises:
        InputError: an effect lacks something that the search needs; the message says what.
    """
    before = dict(_REGISTER)
    try:
        for effect in own:
            _check(effect, type(effect).__name__)
            register(effect)
        yield
    finally:
        _REGISTER.clear()
        _REGISTER.update(before)


def _line_of(error: BaseException, path: Path) -> str:
    if isinstance(error, SyntaxError):
        return f":{error.lineno}"
    lines, frame = [], error.__traceback__
    while frame is not None:
        if Path(frame.tb_frame.f_code.co_filename).resolve() == path.resolve():
            lines.append(frame.tb_lineno)
        frame = frame.tb_next
    return f":{lines[-1]}" if lines else ""


def _check(effect: Effect, where: str) -> None:
    """Reject an effect that lacks something that the search needs."""
    kind = type(effect)
    lacking = [
        word
        for word, there in (
            ("name", bool(effect.name)),
            ("params", bool(effect.params)),
            ("equation", bool(effect.equation)),
            ("columns(ctx, trial)", kind.columns is not Effect.columns),
        )
        if not there
    ]
    if len(effect.params) > 1 and kind.report is Effect.report:
        lacking.append("report(ctx, trial, beta), because it has several parameters")
    if lacking:
        remove(effect.name)
        raise InputError(
            f"effect {effect.name or kind.__name__!r} lacks {', '.join(lacking)}", where
        )


for _module in (springs, friction, dampers, inertial, hysteretic, worn, sensor):
    for _effect in _module.EFFECTS:
        register(_effect)


def params_of(name: str, effect: Effect) -> set[str]:
    """Return the names of an effect's parameters; for a joint law, those of one of its parts."""
    own = _REGISTER.get(name)
    return {p.name for p in (own or effect).params}


__all__ = [
    "Context",
    "Effect",
    "Param",
    "Trial",
    "beside",
    "catalogue",
    "having",
    "load",
    "of_number",
    "params_of",
    "register",
    "remove",
]
