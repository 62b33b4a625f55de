"""Connection of a real-time command to a rig: over its link, or to a virtual rig."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from rthyb_rt.config import AxesRig, Rate, RigFile
    from rthyb_rt.config.rigfile import LinkTable
    from rthyb_rt.core.loop import Clock
    from rthyb_rt.rig.commissioning.guided_motion import AnyRig, AxesConnection, Connection, Reach
    from rthyb_rt.rig.links.opened import Opened


def clock_of(rig: RigFile | AxesRig) -> Clock:
    """Return the default clock of a rig in real time."""
    # The axes of a virtual rig share one clock.
    return rig.link.clock if rig.link is not None else "link"


@contextmanager
def opened_link(
    rig: RigFile | AxesRig, clock: Clock, rate: Rate | None = None
) -> Iterator[tuple[Opened, Callable[[], None] | None]]:
    """Yield the link to a rig, and what the stepped clock calls before a tick.

    For a rig of several axes, yields the links of all. Without a ``[link]``, a virtual rig in a
    separate process is at the other end, sampled at ``rate``; None: at that of the rig file.

    Raises:
        InputError: what prevents opening it; sensors without an actuator that no link reads, or a
            range that no frame carries.
        RthybError: the virtual rig's process did not start.
    """
    from rthyb_rt.config import AxesRig
    from rthyb_rt.lab import axis_wires, sensor_wires
    from rthyb_rt.rig import virtual_rig
    from rthyb_rt.rig.links import opening

    if isinstance(rig, AxesRig):
        rig.refuse_silent_sensors("real time")
        sensor_wires.check(rig)
    axis_wires.check(rig)
    if rig.link is not None:
        with _reached(rig, rig.link) as opened:
            for key, notes in opened.facts.items():
                for note in notes if key.endswith("notes") else ():
                    terminal.tell(f"note: {note}")
            yield opened, None
        return
    axes = axes_of(rig)
    ours, theirs = opening.socket_pairs(axes) if axes else opening.socket_pair()
    with ours, theirs:
        if clock == "stepped":
            terminal.tell(
                "no [link] in the rig file: running on a virtual rig in step with it, tick by tick"
            )
            with virtual_rig.in_step(rig, theirs, virtual_rig.RigPlan(rate=rate)) as drive:
                yield ours, drive.tick
            return
        companion = virtual_rig.Companion(rig, *(one.fd for one in theirs.all), rate=rate)
        try:
            theirs.close()
            terminal.tell(
                "no [link] in the rig file: running on a virtual rig in process "
                f"{companion.pid}, over a socket pair"
            )
            yield ours, None
        finally:
            ours.close()
            companion.close()


def _reached(rig: RigFile | AxesRig, link: LinkTable) -> Opened:
    from rthyb_rt.config import AxesRig
    from rthyb_rt.rig.links import opening

    if isinstance(rig, AxesRig):
        return opening.open_axes(rig, "controller")
    return opening.open_link(link, "controller")


def axes_of(rig: RigFile | AxesRig) -> tuple[str, ...]:
    """Return the names of several axes; () for a rig of one axis."""
    from rthyb_rt.config import AxesRig

    return rig.names if isinstance(rig, AxesRig) else ()


@dataclass(frozen=True)
class Within:
    """A rig for small motions: a rig of one axis, or one axis of several.

    Attributes:
        rig: as a rig of one axis.
        axis: its name; "" for a rig of one axis.
        whole: the rig of several axes to which it belongs; None for a rig of one axis.
        path: of the rig file.
    """

    rig: RigFile
    axis: str
    whole: AxesRig | None
    path: Path

    @property
    def name(self) -> str:
        """Name of the rig, and of its axis if there are several, for messages."""
        if self.whole is None:
            return self.rig.rig.name
        return f"{self.whole.rig.name}, axis {self.axis}"

    @property
    def named(self) -> dict[str, str]:
        """Name of the rig, and of its axis if there are several, for JSON."""
        if self.whole is None:
            return {"rig_name": self.rig.rig.name}
        return {"rig_name": self.whole.rig.name, "axis": self.axis}


def load_within(name: str, settings: list[str] | None, axis: str | None) -> tuple[Within, ...]:
    """Read a rig file of one axis or of several.

    Args:
        name, settings: as given on the command line.
        axis: name given with ``--axis``; None: all axes, in order.

    Raises:
        InputError: lists every error in the file and the settings, or there is no such axis.
    """
    found = load_axes_rig(name, settings)
    if found is None:
        if axis is not None:
            raise InputError(f"found {axis}; the rig has one axis: omit the option", "--axis")
        rig, path = load_rig(name, settings)
        return (Within(rig, "", None, path),)
    whole, path = found
    names = whole.names if axis is None else (axis,)
    return tuple(Within(whole.of_axis(one), one, whole, path) for one in names)


def load_one_within(name: str, settings: list[str] | None, axis: str | None) -> Within:
    """Read a rig file and return the single axis that is to move; arguments as for `load_within`.

    Raises:
        InputError: as for `load_within`, or several axes and none selected.
    """
    found = load_within(name, settings, axis)
    if len(found) > 1:
        names = ", ".join(one.axis for one in found)
        raise InputError(
            f"missing; the rig has several axes ({names}), of which one is moved while the others "
            f"hold: choose it, for example --axis {found[0].axis}",
            "--axis",
        )
    return found[0]


def joined(found: Sequence[tuple[Within, dict[str, Any]]]) -> dict[str, Any]:
    """Combine JSON documents of axes by name; that of a rig of one axis is returned unchanged."""
    (first, document), *_ = found
    if first.whole is None:
        return document
    axes = {within.axis: one for within, one in found}
    return {"schema": document["schema"], "rig_name": first.whole.rig.name, "axes": axes}


@contextmanager
def _link_of(
    within: Within, clock: Clock, hears: bool
) -> Iterator[tuple[Opened, Callable[[], None] | None]]:
    """Yield the link to a rig, or to one axis of a rig whose other drives receive no commands."""
    whole = within.whole
    if whole is None or (within.rig.link is not None and not (hears and whole.sensor)):
        with opened_link(within.rig, clock) as found:
            yield found
        return
    with opened_link(whole, clock) as (opened, before_tick):
        alone = opened.alone(whole.names.index(within.axis))
        if within.rig.link is None:
            alone = replace(alone, name=f"socket pair of {within.axis}")
        yield alone, before_tick


@contextmanager
def connected(within: Within, *, hears: bool = False) -> Iterator[Connection]:
    """Yield an opened rig for small motions; Ctrl-C stops a motion.

    Args:
        within: the rig, or one axis of it.
        hears: whether something is to move: if the rig has sensors without an actuator, the other
            drives are then heard, because their frames contain readings of what the axis moves.

    Raises:
        InputError: one of redundant actuators is to move; or as `opened_link`.
    """
    if hears and within.whole is not None:
        within.whole.refuse_redundant(
            "moving one axis",
            "the others, which hold still, would push against it: detach it from the specimen, "
            "and commission it by a rig file of one axis",
        )
    clock = clock_of(within.rig)
    with _link_of(within, clock, hears) as (opened, before_tick):
        yield _reach(within.rig, opened, clock, before_tick)


@contextmanager
def connected_axes(rig: AxesRig) -> Iterator[AxesConnection]:
    """Yield an opened rig of several axes; Ctrl-C stops a motion."""
    clock = clock_of(rig)
    with opened_link(rig, clock) as (opened, before_tick):
        yield _reach(rig, opened, clock, before_tick)


def _reach(
    rig: AnyRig, opened: Opened, clock: Clock, before_tick: Callable[[], None] | None
) -> Reach[AnyRig]:
    from rthyb_rt.rig.commissioning.guided_motion import Reach

    return Reach(
        rig,
        opened,
        clock,
        before_tick,
        on_interrupt=interrupts.on_interrupt,
        warn=lambda text: terminal.tell(f"warning: {text}"),
        # No other operator could be in charge of a separate virtual rig.
        resets=rig.link is None,
    )


def load_rig(name: str, settings: list[str] | None) -> tuple[RigFile, Path]:
    """Return a rig file and its path; k_e may be missing, because it is not used here.

    Raises:
        InputError: lists every error in the file and the settings.
    """
    from rthyb_rt import config

    path = config.find_rig(name)
    overrides: dict[str, str] = {}
    for part in config.split_overrides(settings or ()):
        overrides.update(part)
    return config.load_rig(path, config.with_some_stiffness(path, overrides)), path


def load_axes_rig(name: str, settings: list[str] | None) -> tuple[AxesRig, Path] | None:
    """Return a rig file of several axes and its path; None for a rig of one axis.

    Raises:
        InputError: lists every error in the file and the settings.
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
