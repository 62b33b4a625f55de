"""``rthyb effects``: the effects that a diagnosis can name."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rthyb_rt.cli import terminal
from rthyb_rt.cli.inputs import JsonOption

if TYPE_CHECKING:
    from rthyb_rt.diagnose.catalogue import EffectEntry


def effects(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="Name of an effect.", show_default=False)
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the effects that a diagnosis can name.

    With a NAME, show the equation of that effect, what it looks like, which experiment reveals it,
    and what it can be confused with. docs/effects.md has the same text with figures.

    \b
    Examples:
      rthyb effects
      rthyb effects stribeck
    """
    from rthyb_rt.diagnose.catalogue import entries

    known = entries()
    if name is not None and name not in known:
        raise typer.BadParameter(
            f"there is no effect {name!r}; the effects are {', '.join(known)}", param_hint="NAME"
        )
    if as_json:
        one: Any = asdict(known[name]) if name is not None else None
        terminal.print_json(one or {key: asdict(e) for key, e in known.items()})
        return
    file = terminal.people(as_json)
    if name is None:
        terminal.print_table([(e.name, e.plain, e.place) for e in known.values()], file)
    else:
        _print_effect(known[name], known, file)


def _print_effect(entry: EffectEntry, known: dict[str, EffectEntry], file: Any) -> None:
    from rthyb_rt.diagnose.words import KINDS

    kind, why = entry.shown_by
    rows = [
        ("effect", f"{entry.name}: {entry.plain} ({entry.place})"),
        ("equation", entry.equation),
        ("parameters", ", ".join(entry.params)),
        ("fingerprint", entry.fingerprint),
        ("shown by", f"{KINDS.get(kind, kind)}: {why}"),
    ]
    rows += [("confused with", f"{known[n].plain}: {parts}") for n, parts in entry.alike]
    terminal.print_table(rows, file)
