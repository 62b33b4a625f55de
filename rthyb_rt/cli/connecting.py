"""What a command in real time needs to reach a rig: its link, or a virtual rig of its own."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from rthyb_rt.config import AxesRig, RigFile
    from rthyb_rt.core.loop import Clock
    from rthyb_rt.rig.commissioning.moving import Connection
    from rthyb_rt.rig.links.opened import Opened

K_E = "elastic_stiffness_n_per_m"


def clock_of(rig: RigFile) -> Clock:
    """Return what real time goes by, unless the command line says otherwise."""
    return rig.link.clock if rig.link is not None else "link"


@contextmanager
def opened_link(rig: RigFile, clock: Clock) -> Iterator[tuple[Opened, Callable[[], None] | None]]:
    """Give the link to a rig, and what the stepped clock waits for before a tick.

    Without a ``[link]`` a virtual rig is at the other end, in a process of its own.

    Raises:
        InputError: what stands against opening it.
        RthybError: the virtual rig's process did not start.
    """
    from rthyb_rt.rig import virtual_rig
    from rthyb_rt.rig.links import opening

    if rig.link is not None:
        with opening.open_link(rig.link, "controller") as opened:
            for note in opened.facts.get("notes", ()):
                terminal.tell(f"note: {note}")
            yield opened, None
        return
    ours, theirs = opening.socket_pair()
    with ours, theirs:
        if clock == "stepped":
            terminal.tell("no [link] in the rig file: on a virtual rig, tick by tick with it")
            with virtual_rig.in_step(rig, theirs) as drive:
                yield ours, drive.tick
            return
        companion = virtual_rig.Companion(rig, theirs.fd)
        try:
            theirs.close()
            terminal.tell(
                f"no [link] in the rig file: on a virtual rig in process {companion.pid}, over a "
                "socket pair"
            )
            yield ours, None
        finally:
            ours.close()
            companion.close()


@contextmanager
def connected(rig: RigFile) -> Iterator[Connection]:
    """Give a rig within reach, for small motions; a Ctrl-C stops what moves."""
    from rthyb_rt.rig.commissioning.moving import Connection

    clock = clock_of(rig)
    with opened_link(rig, clock) as (opened, before_tick):
        yield Connection(
            rig,
            opened,
            clock,
            before_tick,
            told=interrupts.told,
            warn=lambda text: terminal.tell(f"warning: {text}"),
            # A virtual rig of its own has no other operator.
            resets=rig.link is None,
        )


def load_rig(name: str, settings: list[str] | None) -> tuple[RigFile, Path]:
    """Read a rig file and say where it is; one without k_e will do, for nothing here needs it.

    Raises:
        InputError: with every fault of the file and the settings.
    """
    from rthyb_rt import config

    path = config.find_rig(name)
    overrides: dict[str, str] = {}
    for part in config.split_overrides(settings or ()):
        overrides.update(part)
    if not _has_stiffness(path) and not any(key.endswith(K_E) for key in overrides):
        # Any value does.
        overrides[f"rig.{K_E}"] = "1"
    return config.load_rig(path, overrides), path


def load_axes_rig(name: str, settings: list[str] | None) -> tuple[AxesRig, Path] | None:
    """Read a rig file of several axes and say where it is; None where it is of one.

    Raises:
        InputError: with every fault of the file and the settings.
    """
    from rthyb_rt import config

    path = config.find_rig(name)
    if not config.has_axes(path):
        return None
    overrides: dict[str, str] = {}
    for part in config.split_overrides(settings or ()):
        overrides.update(part)
    rig = config.load_any_rig(path, overrides)
    assert isinstance(rig, config.AxesRig)
    return rig, path


def _has_stiffness(path: Path) -> bool:
    """Return whether the file states k_e; True where it cannot be read, which is said later."""
    from rthyb_rt import config

    try:
        table = tomllib.loads(config.read_text(path, "rig")).get("rig")
    except (InputError, ValueError, RecursionError):
        return True
    return not isinstance(table, dict) or K_E in table
