"""What opening a link results in, whatever the link is made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any, Literal, Self

from rthyb_rt.core.loop import Kind, LastCommand
from rthyb_rt.core.wire import Codec

Side = Literal["controller", "drive"]

Owned = ExitStack[None]
"""What has to be given back, last first; no exception ends in it."""


def _never() -> None:
    return None


@dataclass
class Opened:
    """An open link, checked and set up; its frames are the core's business from here on.

    Attributes:
        kind: "can" or "stream", as `rthyb_rt.core.loop.Link` takes it.
        fd: the descriptor; -1 after `close`. `rthyb_rt.core.loop.Link` makes one of its own of it.
        codec: the frames.
        real_time: False if a Python thread stands in between.
        name: what it is, for messages: "can0, CAN 1 Mbit/s".
        facts: what was found out about it, for the recording; numbers, words, lists of words.
        left: what the last session at it told the drive last: where the next one goes on.
        further: of a rig of several axes, the links of all but the first, which this one is.
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
        """The links of all axes, in their order."""
        return (self, *self.further)

    @property
    def failure(self) -> str | None:
        """Why the Python thread in between gave up; None: there is none, or it goes on."""
        return self.failed()

    def close(self) -> None:
        """Give back all that was opened and locked; twice does no harm."""
        self.fd = -1
        self.owned.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def together(links: Mapping[str, Opened]) -> Opened:
    """Return the links of several axes as one, which owns them all.

    Args:
        links: of each axis by its name, in their order.
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
    """Return a bit rate as people write it."""
    if bits_per_s >= 1_000_000:
        return f"{bits_per_s / 1e6:g} Mbit/s"
    return f"{bits_per_s / 1e3:g} kbit/s"
