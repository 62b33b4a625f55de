"""Load of a bus or a serial line by the frames of a test, computed before anything is opened.

The frames of one sample are counted: command, displacement and force, at the rate of the drive. The
load is that of the worst case, with every stuff bit that the data could require.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rthyb_rt.config.rate import STANDARD_HZ

if TYPE_CHECKING:
    from rthyb_rt.core.wire import Codec

MAX_SHARE = 0.8
"""Maximum load: above it, a frame that must wait for another arrives a sample late."""

CAN_BITRATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
"""Bit rates that every adapter supports (CiA 102)."""

MOST_DATA_BITRATE = 8_000_000
"""Highest bit rate of the data phase of CAN FD."""

BAUD_RATES = (460_800, 500_000, 576_000, 921_600, 1_000_000, 1_152_000, 1_500_000, 2_000_000,
              2_500_000, 3_000_000, 3_500_000, 4_000_000)  # fmt: skip
"""Baud rates of Linux that can be sufficient."""

COMMAND_BYTES = 12
FEEDBACK_BYTES = 16
"""Bytes of the program's own serial packets (docs/wire.md)."""

EXTRA_BYTES = 4
"""Bytes of an extra channel, in a serial packet and in a CAN FD frame of the program."""

BITS_PER_BYTE = 10
"""Start bit, eight data bits, stop bit."""


@dataclass(frozen=True)
class FrameSize:
    """Properties that determine how long a frame takes.

    Attributes:
        data_bytes: bytes of data.
        extended: whether its identifier has 29 bits.
        fd: whether it is a CAN FD frame.
        switches: whether a CAN FD frame switches to the rate of the data phase, if there is one.
    """

    data_bytes: int
    extended: bool = False
    fd: bool = False
    switches: bool = True


OWN_BYTES = 8
OWN_FRAMES = (FrameSize(OWN_BYTES),) * 3
"""Command, displacement and force of ``hw/rthyb.dbc``."""

_FD_BYTES = (8, 12, 16, 20, 24, 32, 48, 64)


def own_frames(*, fd: bool = False, extras: int = 0) -> tuple[FrameSize, ...]:
    """Return the program's own frames of one sample.

    Args:
        fd: CAN FD frames; all of them switch the bit rate.
        extras: extra channels in the force frame, which only CAN FD frames can hold.
    """
    if not fd:
        return OWN_FRAMES
    force = next(n for n in _FD_BYTES if n >= OWN_BYTES + EXTRA_BYTES * extras)
    return FrameSize(OWN_BYTES, fd=True), FrameSize(OWN_BYTES, fd=True), FrameSize(force, fd=True)


SHORTER = "give the drive shorter frames"
"""Remedy where no bit rate of the arbitration phase is enough for the frames of a DBC file."""


def can_bits(frame: FrameSize) -> int:
    """Return the maximum length of a classic CAN frame, in bits, including the interframe space.

    g + 8 s + 13 + floor((g + 8 s - 1) / 4) with s data bytes and g = 34, or 54 for a 29-bit
    identifier: Davis, Burns, Bril & Lukkien, *Controller Area Network (CAN) schedulability
    analysis: refuted, revisited and revised*, Real-Time Systems 35 (2007). 135 bits for 8 bytes.
    """
    stuffed = (54 if frame.extended else 34) + 8 * frame.data_bytes
    return stuffed + 13 + (stuffed - 1) // 4


def can_fd_bits(frame: FrameSize) -> tuple[int, int]:
    """Return the maximum length of a CAN FD frame, in bits: arbitration phase and data phase.

    Fields by ISO 11898-1:2015. Up to the bit-rate switch there are 17 bits, or 36 with a 29-bit
    identifier; then ESI, DLC and data, stuffed as in classic CAN; then stuff count and CRC of 17
    bits (21 above 16 bytes), with a fixed stuff bit before every four of them; then 13 bits of CRC
    delimiter, acknowledgement, end of frame and intermission at the first rate again.
    """
    head = 36 if frame.extended else 17
    checked = 4 + (17 if frame.data_bytes <= 16 else 21)
    data = 5 + 8 * frame.data_bytes
    stuffed_head = (head - 1) // 4
    stuffed = (head + data - 1) // 4
    tail = checked + math.ceil(checked / 4)
    return head + stuffed_head + 13, data + (stuffed - stuffed_head) + tail


def bus_load(
    frames: Sequence[FrameSize],
    bitrate: int,
    data_bitrate: int | None = None,
    *,
    rate_hz: float = STANDARD_HZ,
) -> float:
    """Return the load of a CAN bus by the frames of every sample, as a fraction.

    Args:
        frames: frames of one sample.
        bitrate: bit rate of the bus, bit/s; with CAN FD, of the arbitration phase.
        data_bitrate: bit rate of the data phase of CAN FD frames that switch the bit rate, bit/s.
        rate_hz: samples per second.
    """
    seconds = 0.0
    for frame in frames:
        if not frame.fd:
            seconds += can_bits(frame) / bitrate
            continue
        arbitration, data = can_fd_bits(frame)
        switched = data_bitrate if data_bitrate and frame.switches else bitrate
        seconds += arbitration / bitrate + data / switched
    return seconds * rate_hz


def bus_fault(
    frames: Sequence[FrameSize],
    bitrate: int,
    data_bitrate: int | None = None,
    *,
    rate_hz: float = STANDARD_HZ,
    otherwise: str = SHORTER,
) -> str | None:
    """Return the error for a bit rate that is too low for the frames, with a sufficient one.

    Args:
        frames, bitrate, data_bitrate, rate_hz: as of `bus_load`.
        otherwise: what to do if no bit rate is sufficient.
    """
    load = bus_load(frames, bitrate, data_bitrate, rate_hz=rate_hz)
    if load <= MAX_SHARE:
        return None
    enough = [
        rate
        for rate in CAN_BITRATES
        if bus_load(frames, rate, data_bitrate, rate_hz=rate_hz) <= MAX_SHARE
    ]
    if enough:
        remedy = f"{enough[0]} bit/s is enough"
    else:
        remedy = f"no bit rate up to {CAN_BITRATES[-1]} bit/s is enough; {otherwise}"
        if data_bitrate is None and any(frame.fd for frame in frames):
            remedy += ", or set data_bitrate if its CAN FD frames switch the bit rate"
        if rate_hz > STANDARD_HZ:
            remedy += f"; {bitrate} bit/s has room for {most_hz(load, rate_hz)} Hz"
    return (
        f"found {bitrate} bit/s; {len(frames)} frames, {rate_hz:g} times per second, load the bus "
        f"to {math.ceil(100 * load)} %, and at most 80 % is allowed; {remedy}"
    )


def most_hz(load: float, rate_hz: float) -> int:
    """Return the highest possible sample rate if ``rate_hz`` causes a given load."""
    return math.floor(rate_hz * MAX_SHARE / load)


def serial_load(baud: int, extras: int = 0, *, rate_hz: float = STANDARD_HZ) -> float:
    """Return the load of a serial line by command and feedback, as a fraction.

    Args:
        baud: baud rate of the line.
        extras: extra channels in the feedback.
        rate_hz: samples per second.
    """
    return serial_bits_per_s(extras, rate_hz=rate_hz) / baud


def serial_bits_per_s(extras: int = 0, *, rate_hz: float = STANDARD_HZ) -> int:
    """Return the number of bits of command and feedback per second."""
    size = COMMAND_BYTES + FEEDBACK_BYTES + EXTRA_BYTES * extras
    return round(size * BITS_PER_BYTE * rate_hz)


def serial_fault(baud: int, extras: int = 0, *, rate_hz: float = STANDARD_HZ) -> str | None:
    """Return the error for a baud rate that is too low, with a sufficient one."""
    load = serial_load(baud, extras, rate_hz=rate_hz)
    if load <= MAX_SHARE:
        return None
    fits = [baud for baud in BAUD_RATES if serial_load(baud, extras, rate_hz=rate_hz) <= MAX_SHARE]
    most = f"which is {most_hz(load, rate_hz)} Hz on this line"
    enough = f"so use at least {fits[0]} Bd" if fits else most
    feedback = FEEDBACK_BYTES + EXTRA_BYTES * extras
    return (
        f"found {baud} Bd: command ({COMMAND_BYTES} bytes) and feedback ({feedback} bytes) "
        f"at {rate_hz:g} Hz need {serial_bits_per_s(extras, rate_hz=rate_hz)} Bd, "
        f"{math.ceil(100 * load)} % of the line's capacity; at most 80 % is allowed, {enough}"
    )


def frames_of(codec: Codec) -> tuple[FrameSize, ...]:
    """Return the frames of one sample of a codec: the command, then one or two feedbacks."""
    # Only a table has lengths; the program's own frames need none.
    if not codec.struct.command.length:
        return OWN_FRAMES
    messages = {m.id: m for m in (codec.struct.displacement, codec.struct.force)}
    # A drive with frames of its own decides about its feedback; only our end sends the command.
    return tuple(
        FrameSize(int(message.length), bool(message.id >> 31), bool(message.fd), switches)
        for message, switches in (
            (codec.struct.command, codec.command_switches or not codec.struct.command.fd),
            *((message, True) for message in messages.values()),
        )
    )
