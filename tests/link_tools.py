"""Common helpers for tests of links."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import loop_bench
import pytest

from rthyb_rt import core
from rthyb_rt.config.rigfile import LinkTable
from rthyb_rt.core import dbc, loop, wire
from rthyb_rt.rig.links.opening import Opened


def wanted(kind: str, channel: object, **more: Any) -> LinkTable:
    """The ``[link]`` table of a rig file."""
    return LinkTable.model_validate({"kind": kind, "channel": str(channel), **more})


def users_table(folder: Path, text: str) -> wire.Codec:
    """Frames as in a user's DBC table."""
    pytest.importorskip("cantools")
    path = folder / "table.dbc"
    path.write_text(text, encoding="ascii")
    return dbc.load(path)


def until(condition: Callable[[], Any], seconds: float = 20.0) -> Any:
    """Wait for an event in another thread or the kernel."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.0005)
    return found


@contextmanager
def nothing_left_open() -> Iterator[None]:
    """Check that no descriptor and no thread remain after the block."""
    descriptors, threads = set(os.listdir("/proc/self/fd")), set(threading.enumerate())
    yield
    assert set(os.listdir("/proc/self/fd")) == descriptors
    assert set(threading.enumerate()) == threads


@contextmanager
def as_nobody() -> Iterator[None]:
    """Run without the privileges of root, if the tests have them."""
    if os.geteuid():
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


class LinkUnderTest:
    """The core's link on an opened channel, and a loop that drains it, one tick at a time."""

    def __init__(self, opened: Opened) -> None:
        self.link = loop.Link(opened.kind, opened.fd)
        station = core.Station(loop_bench.config(), loop_bench.shaking(0.1))
        self.loop = loop.Loop(station, wire.Wire(opened.codec), self.link)

    def down(self) -> str:
        self.loop.step()
        return self.link.down

    def comes_down(self, fault: str) -> None:
        until(lambda: self.down() == fault)
        self.link.close()

    def __enter__(self) -> LinkUnderTest:
        return self

    def __exit__(self, *_: object) -> None:
        self.link.close()
