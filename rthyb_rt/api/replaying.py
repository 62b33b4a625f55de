"""Is a recording what this core computes from the same inputs: `rthyb replay`."""

from __future__ import annotations

from rthyb_rt.api.files import Place
from rthyb_rt.api.recordings import Recording, as_recording
from rthyb_rt.lab.experiment import Replay


def replay(recording: Recording | Place) -> Replay:
    """Compute a recording again from its own measurements, and compare every field bit for bit.

    Args:
        recording: the recording, or folder or file of one; of virtual or real time.

    Raises:
        InputError: it cannot be read, or another version has to replay it; says which.

    Examples:
        >>> replay(run("section5-T0.5")).identical
        True
    """
    from rthyb_rt.lab import realtime

    return realtime.replay(as_recording(recording, "replay").raw)
