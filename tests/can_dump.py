"""Traffic on a CAN bus as seen by independent tools: candump and cantools."""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cantools
import numpy as np
from loop_bench import CAN_FRAME
from loop_bench import can_socket as raw_socket

LINE = re.compile(r"\(\d+\.\d+\) (\w+) ([0-9A-F]+)#(?:(#)[0-9A-F])?([0-9A-F]*)")
END = 0x7FE


class Dump:
    """Output of candump for an interface."""

    def __init__(self, interface: str, file: Path) -> None:
        self.interface, self.file = interface, file

    def frames(self) -> list[tuple[int, bytes, bool]]:
        """Identifier, content and whether it is CAN FD, of each frame so far."""
        with raw_socket(self.interface, ()) as marker:
            marker.send(CAN_FRAME.pack(END, 0, bytes(8)))
        await_that(lambda: f" {END:X}#\n" in self.file.read_text(), "candump misses a frame")
        matches = [LINE.fullmatch(line) for line in self.file.read_text().splitlines()]
        assert all(match and match[1] == self.interface for match in matches)
        frames = [(int(m[2], 16), bytes.fromhex(m[4]), bool(m[3])) for m in matches if m]
        mark = (END, b"", False)
        last = len(frames) - frames[::-1].index(mark)
        return [frame for frame in frames[:last] if frame != mark]


def await_that(is_so: Callable[[], object], complaint: str) -> None:
    end = time.monotonic() + 10.0
    while not is_so():
        assert time.monotonic() < end, complaint
        time.sleep(0.01)


@contextmanager
def candump(interface: str, folder: Path) -> Iterator[Dump]:
    """Start candump, with space for every frame of a test, and wait until it listens.

    It continues when the interface goes down.
    """
    file, listeners = folder / "candump", Path("/proc/net/can/rcvlist_all")
    listens = re.compile(rf"{interface} .* raw$", re.MULTILINE)
    with file.open("wb") as out:
        running = subprocess.Popen(["candump", "-L", "-D", "-r", "8000000", interface], stdout=out)
    try:
        await_that(lambda: listens.search(listeners.read_text()), "candump does not listen")
        yield Dump(interface, file)
    finally:
        running.terminate()
        running.wait()


def decoded(frames: list[tuple[int, bytes, bool]], file: Path, name: str) -> dict[str, np.ndarray]:
    """Everything that cantools decodes from frames of one name: raw numbers by signal."""
    database = cantools.database.load_file(file)
    message = database.get_message_by_name(name)
    found: list[Any] = [
        message.decode(data, decode_choices=False, scaling=False)
        for can_id, data, _ in frames
        if can_id == message.frame_id
    ]
    return {signal: np.array([each[signal] for each in found]) for signal in found[0]}
