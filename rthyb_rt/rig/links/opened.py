"""The result of opening a link of any kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
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
        further: for a rig of several axes, the links of all axes but the first, which is this.
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
    further: tuple[Opened, ...] = ()

    @property
    def all(self) -> tuple[Opened, ...]:
        """Links of all axes, in their order."""
        return (self, *self.further)

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
        further=tuple(further),
    )


def bit_rate(bits_per_s: int) -> str:
    """Return a bit rate with its usual unit."""
    if bits_per_s >= 1_000_000:
        return f"{bits_per_s / 1e6:g} Mbit/s"
    return f"{bits_per_s / 1e3:g} kbit/s"
