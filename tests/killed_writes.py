"""The growing file of a recording, killed at each write in turn by the preloaded write_killer.

LD_PRELOAD=write_killer.so python killed_writes.py FOLDER BLOCKS FIRST_BLOCK PAGES

Each kill occurs in the blocks from FIRST_BLOCK on, between two writes, or after a number of PAGES
of one. Prints the number of kills, and one line for each after which the file lacked rows that it
should have, or could not be continued to the last row.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from recording_data import recording as made_up
from test_service_recorder import truth

from rthyb_rt.record.recording import BLOCK_ROWS
from rthyb_rt.service.growing import PART_NAME, GrowingFile

KILLER = ctypes.CDLL(None)
KILLER.writes_seen.restype = ctypes.c_long


def in_child(work: Callable[[], str]) -> tuple[str, int]:
    """Run a function in a child process; return its output and its exit status."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.write(writing, work().encode())
        os._exit(0)
    os.close(writing)
    with open(reading, encoding="ascii") as said:
        words = said.read()
    return words, os.waitpid(pid, 0)[1]


class Recorded:
    """A recording with a number of blocks.

    Args:
        folder: folder of the run.
        blocks: number of blocks.
    """

    def __init__(self, folder: Path, blocks: int) -> None:
        self.folder, self.path = folder, folder / PART_NAME
        self.rows = truth(blocks * BLOCK_ROWS)
        self.session = made_up()

    def write(self, most: int = 0) -> GrowingFile:
        """Begin or continue the file, block by block, to its end or to a given row."""
        file = GrowingFile(self.folder, self.session)
        for at in range(file.next_row, most or self.rows.size, BLOCK_ROWS):
            file.add(self.rows[at : at + BLOCK_ROWS])
        return file

    def same(self, found: np.ndarray) -> bool:
        """Whether rows are the first ones of the recording."""
        wanted = self.rows[: found.size]
        return all(np.array_equal(found[name], wanted[name]) for name in wanted.dtype.names or ())

    def read(self) -> str:
        """Return the state of the file as any program would see it."""
        if not self.path.exists():
            return "not begun"
        try:
            with h5py.File(self.path, "r") as file:
                return "good" if self.same(file["samples"][()]) else "wrong rows"
        except OSError as error:
            return f"unreadable: {error}"

    def go_on(self) -> str:
        """Continue the file and write the rest; return the result."""
        try:
            self.write().close()
        except Exception as error:
            return f"not gone on with: {error}"
        whole = self.read() == "good" and len(list(self.folder.iterdir())) == 1
        with h5py.File(self.path, "r") as file:
            return "good" if whole and len(file["samples"]) == self.rows.size else "not whole"


def main(folder: Path, blocks: int, first_block: int, pages: int) -> None:
    made, begun = Recorded(folder / "run", blocks), Recorded(folder / "begun", blocks)
    if first_block:
        begun.write(first_block * BLOCK_ROWS).close()
    kills, killed = 0, True
    while killed:
        kills += 1
        shutil.rmtree(made.folder, ignore_errors=True)
        if first_block:
            shutil.copytree(begun.folder, made.folder)

        def write(number: int = kills) -> str:
            KILLER.kill_at(number, pages)
            made.write()
            return "through"

        said, _ = in_child(write)
        killed = not said
        for what, found in (("read", in_child(made.read)), ("go on", in_child(made.go_on))):
            if found not in (("good", 0), ("not begun", 0)):
                print(f"write {kills}, {what}: {found[0] or f'ended with status {found[1]}'}")
    print(f"{kills - 1} kills")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
