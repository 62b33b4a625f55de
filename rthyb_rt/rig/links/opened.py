"""The result of opening a link of any kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Self

from rthyb_rt.core.loop import Kind, LastCommand
from rthyb_rt.core.wire import Codec

Side = Literal["controller", "drive"]

Owned = ExitStack[None]
"""What must be released, in reverse order; suppresses no exception."""


def _never() -> None:
    return None


@dataclass
class Opened:
    """An open link, checked and set up; from here on the core exchanges its frames.

    Attributes:
        kind: "can" or "stream", as `rthyb_rt.core.loop.Link` takes it.
        fd: the descriptor; -1 after `close`. `rthyb_rt.core.loop.Link` duplicates it.
        codec: the frames.
        real_time: False if a Python thread is in between.
        name: for messages, such as "can0, CAN 1 Mbit/s".
        facts: properties of the link, for the recording; numbers, strings, lists of strings.
        left: the last command of the previous session, from which the next one continues.
        first, further: for a rig of several axes, the links of the first and of all other axes.
        heard: for one axis of several, the links of the other axes, to which nothing is sent.
    """

    kind: Kind
    fd: int
    codec: Codec
    real_time: bool
    name: str
    facts: dict[str, Any]
    owned: Owned = field(default_factory=Owned, repr=False)
    failed: Callable[[], str | None] = field(default=_never, repr=False)
    left: LastCommand | None = field(default=None, repr=False)
    first: Opened | None = None
    further: tuple[Opened, ...] = ()
    heard: tuple[Opened, ...] = ()

    @property
    def all(self) -> tuple[Opened, ...]:
        """Links of all axes, in their order."""
        return (self.first or self, *self.further)

    def alone(self, axis: int) -> Opened:
        """Return the link of one axis, which hears the others; all remain this object's to close.

        Args:
            axis: its number.
        """
        heard = tuple(one for k, one in enumerate(self.all) if k != axis)
        return replace(self.all[axis], heard=heard, owned=Owned())

    @property
    def failure(self) -> str | None:
        """Why the Python thread in between gave up; None if it runs or if there is none."""
        return self.failed()

    def close(self) -> None:
        """Release everything that was opened and locked; may be called more than once."""
        self.fd = -1
        self.owned.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def together(links: Mapping[str, Opened]) -> Opened:
    """Return the links of several axes as one that owns them all.

    Args:
        links: by name of the axis, in order.
    """
    first, *further = links.values()

    def failed() -> str | None:
        whys = [f"axis {name}: {one.failure}" for name, one in links.items() if one.failure]
        return "; ".join(whys) or None

    owned = Owned()
    for one in reversed([*links.values()]):
        owned.callback(one.close)
    return Opened(
        kind=first.kind,
        fd=first.fd,
        codec=first.codec,
        real_time=all(one.real_time for one in links.values()),
        name="; ".join(f"{name}: {one.name}" for name, one in links.items()),
        facts={f"{name}.{key}": v for name, one in links.items() for key, v in one.facts.items()},
        owned=owned,
        failed=failed,
        first=first,
        further=tuple(further),
    )


def bit_rate(bits_per_s: int) -> str:
    """Return a bit rate with its usual unit."""
    if bits_per_s >= 1_000_000:
        return f"{bits_per_s / 1e6:g} Mbit/s"
    return f"{bits_per_s / 1e3:g} kbit/s"
