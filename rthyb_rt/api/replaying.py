"""Replay of a recording: does the core compute the same output from the same inputs?"""

from __future__ import annotations

from rthyb_rt.api.files import Place
from rthyb_rt.api.recordings import Recording, as_recording
from rthyb_rt.lab.experiment import Replay


def replay(recording: Recording | Place) -> Replay:
    """Recompute a recording from its measurements and compare every field bit by bit.

    Args:
        recording: a recording in virtual or real time, or its file or folder.

    Raises:
        InputError: it cannot be read, or must be replayed by another version, which the message
            names.

    Examples:
        >>> replay(run("section5-T0.5")).identical
        True
    """
    from rthyb_rt.lab import realtime

    return realtime.replay(as_recording(recording, "replay").raw)
