"""Disk space: what a recording needs, and a reserve that is allocated before each block."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from rthyb_rt import core
from rthyb_rt.config import STANDARD, Rate

RESERVE_BYTES: Final = 1 << 20
"""Allocated in the file itself before every block, because HDF5 must never meet a full disk."""
KEPT_FREE_BYTES: Final = 8 << 20
"""Left free on the disk, for the last steps of a recording and for other programs."""

_INDEX_PER_ROW_BYTES: Final = 8
"""Index and checksums of the file: 2.4 measured for incompressible rows, the worst case."""
_AROUND_S: Final = 120.0
"""Time besides the test proper: zeroing, armed, ramps, a HOLD."""


def free_bytes(folder: Path) -> int:
    """Return the space that is available to this user.

    Raises:
        OSError: the folder does not exist.
    """
    found = os.statvfs(folder)
    return found.f_bavail * found.f_frsize


def needed_bytes(
    test_ticks: int,
    channels: Sequence[core.Channel] = (),
    axis_count: int = 1,
    rate: Rate = STANDARD,
) -> int:
    """Return the space that the rows of a test may need, including what is left free.

    Args:
        test_ticks: length of the test proper.
        channels: number of recorded channels besides the standard record.
        axis_count: axes of the rig.
        rate: sample rate.
    """
    ticks = test_ticks + rate.ticks(_AROUND_S)
    per_row = core.row_dtype(channels, axis_count).itemsize + _INDEX_PER_ROW_BYTES
    return ticks * per_row + KEPT_FREE_BYTES + 2 * RESERVE_BYTES


FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of the system that mean a full disk."""


def has_room(descriptor: int, end: int, folder: Path) -> bool:
    """Return whether the next block of an open file can be written; if so, it is allocated.

    Args:
        descriptor: of the file.
        end: where the next block begins; the reserve follows it.
        folder: of the file.

    Raises:
        OSError: any failure other than a lack of space.
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
