"""Room on the disk: what a recording needs, and a reserve that is had before a block is written."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from rthyb_rt import core
from rthyb_rt.config import STANDARD, Rate

RESERVE_BYTES: Final = 1 << 20
"""Had in the file itself before every block: HDF5 must never meet a full disk."""
KEPT_FREE_BYTES: Final = 8 << 20
"""Of the disk: for the last steps of a recording, and for everybody else."""

_INDEX_PER_ROW_BYTES: Final = 8
"""Of the file's index and checksums: measured 2.4 where rows do not compress, as bad a case as
there is."""
_AROUND_S: Final = 120.0
"""Beside the test proper: zeroing, armed, ramps, a HOLD."""


def free_bytes(folder: Path) -> int:
    """Return the room that is left for this user.

    Raises:
        OSError: the folder is not there.
    """
    found = os.statvfs(folder)
    return found.f_bavail * found.f_frsize


def needed_bytes(
    test_ticks: int,
    channels: Sequence[core.Channel] = (),
    axis_count: int = 1,
    rate: Rate = STANDARD,
) -> int:
    """Return the room that the rows of a test may take, with what is kept free.

    Args:
        test_ticks: of the test proper.
        channels: what its rows have beside the record.
        axis_count: axes of the rig.
        rate: of its samples.
    """
    ticks = test_ticks + rate.ticks(_AROUND_S)
    per_row = core.row_dtype(channels, axis_count).itemsize + _INDEX_PER_ROW_BYTES
    return ticks * per_row + KEPT_FREE_BYTES + 2 * RESERVE_BYTES


FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""What the system says of a disk without room."""


def has_room(descriptor: int, end: int, folder: Path) -> bool:
    """Return whether the next block of an open file can be written; its blocks are had then.

    Args:
        descriptor: of the file.
        end: where the next block begins; what is reserved lies behind.
        folder: of the file.

    Raises:
        OSError: something else than room is missing.
    """
    if free_bytes(folder) < KEPT_FREE_BYTES:
        return False
    try:
        os.posix_fallocate(descriptor, end, RESERVE_BYTES)
    except OSError as error:
        if error.errno in FULL:
            return False
        raise
    return True
