"""Python interface of the wire: numbers to frames and back, framing, bookkeeping.

Every function and class is named after its counterpart in ``csrc/rthyb.h``, which states the
contract; `docs/wire.md` describes the frames byte by byte. SI units: m, N. Nothing here does I/O: a
C link uses the same functions on the struct of `Wire`, a Python link uses the methods.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

from rthyb_rt._core import ffi, lib
from rthyb_rt.core import CoreError
from rthyb_rt.core.library import words

ACT_CMD: Final[int] = lib.RTHYB_ACT_CMD
ACT_FB: Final[int] = lib.RTHYB_ACT_FB
LC_FB: Final[int] = lib.RTHYB_LC_FB
ID_EXTENDED: Final[int] = lib.RTHYB_ID_EXTENDED
FRAME_MAX: Final[int] = lib.RTHYB_FRAME_MAX
PACKET_MAX: Final[int] = lib.RTHYB_PACKET_MAX
COBS_MAX: Final = 253
"""Largest number of bytes that `cobs_encode` accepts."""

DEVICE_STOPPED: Final[int] = lib.RTHYB_DEVICE_STOPPED
DEVICE_INVALID: Final[int] = lib.RTHYB_DEVICE_INVALID

NOTICES: Final[dict[int, str]] = {
    lib.RTHYB_NOTICE_RESET: "RESET",
    lib.RTHYB_NOTICE_LEAVING: "LEAVING",
}
"""Notices that a command may carry in place of the controller's state, by number."""

LOST: Final[int] = lib.RTHYB_LOST
_NOT_FINITE: Final[int] = lib.RTHYB_S_NOT_FINITE
_WORD: Final = 0xFFFF_FFFF

EXTRAS_MAX: Final[int] = lib.RTHYB_EXTRAS_MAX
_WITHOUT_EXTRAS: Final[int] = ffi.offsetof("rthyb_codec", "extra_count")
_OWN_LENGTH: Final = 8
_SERIAL_EXTRAS_AT: Final = 8 * 12
_NO_NUMBER: Final = -(2**31)
_MOST: Final = float(2**31 - 1)

VERDICTS: Final = words("rthyb_verdict", "RTHYB_W_")


def verdict_names(verdict: int) -> list[str]:
    """Return the names of the bits set in a verdict."""
    return [name for name, bit in VERDICTS.items() if verdict & bit]


@dataclass(frozen=True)
class Frame:
    """One CAN frame, or bytes of the serial line (``id`` 0).

    ``id`` is as in SocketCAN: `ID_EXTENDED` is added to a 29-bit identifier.
    """

    id: int
    data: bytes
    fd: bool = False


DISPLACEMENT_STEP_M: Final = 1e-9
FORCE_STEP_N: Final = 1e-3
"""Resolution of the program's own frames."""


@dataclass(frozen=True)
class Setpoint:
    """A command: displacement, sequence number, controller state or key of `NOTICES`."""

    x_m: float
    seq: int = 0
    state: int = 0


@dataclass(frozen=True)
class Reading:
    """A sample from the drive, or the half that one frame holds (the other is ``None``)."""

    x_m: float | None
    f_n: float | None
    echo: int = 0
    count: int = 0
    status: int = 0
    extra: tuple[float, ...] = ()


@dataclass(frozen=True)
class Extra:
    """An extra channel on the wire.

    Attributes:
        scale, offset: value = scale * wire + offset.
        step: resolution on the wire, for a 32-bit field of its own.
        signal: its position in a frame of a DBC file (``rthyb_signal``); None: a field of its own.
        in_force: whether that is the force frame rather than the displacement frame.
    """

    scale: float = 1.0
    offset: float = 0.0
    step: float = 1e-6
    signal: Any = None
    in_force: bool = False


@dataclass(frozen=True)
class Feedback:
    """The feedback available in one tick: the newest pair, fresh or not.

    Attributes:
        lost: 0 for a fresh pair, else `LOST` with the ``core.STATUS`` bits that rejected a reading.
        x_m, f_n: newest pair, 0 before the first.
        echo, count, status: as the drive sent them.
        delay: samples between this tick's command and the command that the drive had applied at the
            instant of the pair; ``None`` while unknown.
        age: ticks since the pair arrived.
        samples: the drive's sample count, unwrapped.
    """

    lost: int
    x_m: float
    f_n: float
    echo: int
    count: int
    status: int
    delay: int | None
    age: int
    samples: int


def crc8(data: bytes) -> int:
    """Return CRC-8/SAE-J1850 (polynomial 0x1D, start and final exclusive-or 0xFF)."""
    return int(lib.rthyb_crc8(data, len(data)))


def crc16(data: bytes) -> int:
    """Return CRC-16/CCITT-FALSE (polynomial 0x1021, start 0xFFFF)."""
    return int(lib.rthyb_crc16(data, len(data)))


def cobs_encode(data: bytes) -> bytes:
    """Return COBS of at most `COBS_MAX` bytes, with the 0 that ends the packet."""
    if len(data) > COBS_MAX:
        raise CoreError(f"found a packet of {len(data)} bytes; at most {COBS_MAX} are allowed")
    out = ffi.new("uint8_t[]", len(data) + 2)
    return bytes(ffi.buffer(out, lib.rthyb_cobs_encode(data, len(data), out)))


@dataclass(frozen=True)
class Identifiers:
    """The 11-bit identifiers of the program's own frames of one drive."""

    command: int = ACT_CMD
    displacement: int = ACT_FB
    force: int = LC_FB


def _force_bytes(extras: int) -> int:
    """Return the length of the force frame: the extra channels follow its own eight bytes."""
    needed = _OWN_LENGTH + 4 * extras
    return next(n for n in (8, 12, 16, 20, 24, 32, 48, 64) if n >= needed)


def _spell_out(struct: Any, identifiers: Identifiers) -> None:
    """Write the program's own frames as a table, all of them classic CAN."""
    struct.format = lib.RTHYB_WIRE_TABLE
    struct.reset, struct.leaving = lib.RTHYB_NOTICE_RESET, lib.RTHYB_NOTICE_LEAVING
    for message, number, value, step in (
        (struct.command, identifiers.command, lib.RTHYB_FIELD_X, DISPLACEMENT_STEP_M),
        (struct.displacement, identifiers.displacement, lib.RTHYB_FIELD_X, DISPLACEMENT_STEP_M),
        (struct.force, identifiers.force, lib.RTHYB_FIELD_F, FORCE_STEP_N),
    ):
        message.id, message.length, message.crc_at = number, _OWN_LENGTH, 7
        message.field[value] = ffi.new(
            "rthyb_signal *",
            {"kind": lib.RTHYB_SIGNED, "length": 32, "has_none": 1, "none": _NO_NUMBER,
             "scale": step, "low": -_MOST, "high": _MOST},
        )[0]  # fmt: skip
        whole = [(lib.RTHYB_FIELD_ECHO, 32, 8), (lib.RTHYB_FIELD_COUNT, 40, 8),
                 (lib.RTHYB_FIELD_STATUS, 48, 8)]  # fmt: skip
        if number == identifiers.command:
            whole = [(lib.RTHYB_FIELD_SEQ, 32, 16), (lib.RTHYB_FIELD_STATE, 48, 8)]
        for field, start, bits in whole:
            place = message.field[field]
            place.kind, place.start, place.length, place.scale = lib.RTHYB_UNSIGNED, start, bits, 1


class Codec:
    """Numbers to frames and back: `can` (``hw/rthyb.dbc``), `own`, `serial`, or by a DBC file.

    `rthyb_rt.core.dbc.load` returns a codec for a DBC file. Raises ``CoreError`` for a table that
    does not fit its frames.

    Attributes:
        struct: the ``rthyb_codec`` of the C core.
    """

    def __init__(self, struct: Any) -> None:
        if lib.rthyb_codec_check(struct):
            raise CoreError("the table of signals does not match its frames")
        self.struct = struct
        self._frames = ffi.new("rthyb_frame[2]")
        self._sent = ffi.new("double *")
        self._setpoint = ffi.new("rthyb_setpoint *")
        self._reading = ffi.new("rthyb_reading *")

    @classmethod
    def of(cls, table: bytes) -> Codec:
        """Return the codec from its `table`; raises ``CoreError`` if the table is not valid."""
        struct = ffi.new("rthyb_codec *")
        # Recordings of earlier versions have no extra channels: their table is the first part of
        # this one.
        if len(table) not in (ffi.sizeof(struct[0]), _WITHOUT_EXTRAS):
            raise CoreError("the table of signals was not written by this version")
        ffi.memmove(struct, table, len(table))
        return cls(struct)

    @property
    def table(self) -> bytes:
        """The complete table as bytes, for a recording."""
        return bytes(ffi.buffer(self.struct))

    @property
    def is_serial(self) -> bool:
        """Whether frames are bytes of a serial line."""
        return bool(self.struct.format == lib.RTHYB_WIRE_SERIAL)

    @property
    def command_id(self) -> int:
        """Identifier of the command frame."""
        return int(self.struct.command.id) if self._by_table else ACT_CMD

    @property
    def feedback_ids(self) -> tuple[int, ...]:
        """Identifiers that a receive filter must pass: one, or displacement and force."""
        if not self._by_table:
            return (ACT_FB, LC_FB)
        return tuple(dict.fromkeys((self.struct.displacement.id, self.struct.force.id)))

    @property
    def is_fd(self) -> bool:
        """Whether the bus must be opened for CAN FD."""
        messages = (self.struct.command, self.struct.displacement, self.struct.force)
        return self._by_table and any(message.fd for message in messages)

    @property
    def command_switches(self) -> bool:
        """Whether the command is a CAN FD frame that switches to the rate of the data phase."""
        return self._by_table and bool(self.struct.command.fd == lib.RTHYB_FD_SWITCHED)

    @property
    def has_status(self) -> bool:
        """Whether the frames can report that a drive has stopped on its own."""
        feedback = (self.struct.displacement, self.struct.force)
        status = lib.RTHYB_FIELD_STATUS
        return not self._by_table or any(part.field[status].length for part in feedback)

    @property
    def has_reset(self) -> bool:
        """Whether the frames can reset a drive that has stopped on its own."""
        return not self._by_table or bool(self.struct.reset)

    @property
    def _by_table(self) -> bool:
        return bool(self.struct.format == lib.RTHYB_WIRE_TABLE)

    def with_extras(self, extras: Sequence[Extra]) -> Codec:
        """Return the codec with extra channels, in their order.

        A serial packet has them after its status byte, 32 bits each; `Extra.signal` gives their
        position in the frames of a DBC file. The classic frames of ``hw/rthyb.dbc`` are full: the
        force frame is then a longer one of CAN FD.

        Raises:
            CoreError: there are more than `EXTRAS_MAX`, or one does not fit its frame.
        """
        if len(extras) > EXTRAS_MAX:
            raise CoreError(f"found {len(extras)} extra channels; at most {EXTRAS_MAX} are allowed")
        if not extras:
            return self
        struct = ffi.new("rthyb_codec *")
        ffi.memmove(struct, self.struct, ffi.sizeof(struct[0]))
        own = not self.is_serial and all(one.signal is None for one in extras)
        if struct.format == lib.RTHYB_WIRE_CAN:
            _spell_out(struct, Identifiers())
        if own:
            struct.force.length = _force_bytes(len(extras))
            struct.force.fd = struct.force.fd or lib.RTHYB_FD
        at = 8 * _OWN_LENGTH if own else _SERIAL_EXTRAS_AT
        struct.extra_count = len(extras)
        for i, one in enumerate(extras):
            slot = struct.extra[i]
            slot.in_force = one.in_force or own
            signal = {
                "kind": lib.RTHYB_SIGNED, "length": 32, "start": at + 32 * i, "scale": one.step,
                "has_none": 1, "none": _NO_NUMBER, "low": -_MOST, "high": _MOST,
            }  # fmt: skip
            if one.signal is not None:
                ffi.memmove(ffi.addressof(slot, "signal"), one.signal, ffi.sizeof("rthyb_signal"))
            else:
                slot.signal = ffi.new("rthyb_signal *", signal)[0]
            # The calibrated wire value: the drive's end has the same table and applies the inverse.
            slot.signal.offset = one.scale * slot.signal.offset + one.offset
            slot.signal.scale *= one.scale
        return Codec(struct)

    def extra_reach(self, number: int) -> float:
        """Return the magnitude up to which an extra channel carries every value of either sign.

        A converter that saturates sends a value of at least that magnitude in place of what it
        cannot carry. 0: the channel does not carry both signs.
        """
        return float(lib.rthyb_extra_reach(self.struct, number))

    def reading_reach(self, *, force: bool, gain: float, offset: float) -> float:
        """Return the same of a reading of the axis, ``gain`` times the wire plus ``offset``.

        A signal of one sign, such as the position of a piston from its lower end, carries every
        reading up to its far end.
        """
        part = lib.RTHYB_HAS_F if force else lib.RTHYB_HAS_X
        return float(lib.rthyb_reading_reach(self.struct, part, gain, offset))

    def reading_step(self, *, force: bool, gain: float) -> float:
        """Return the difference of neighbouring readings of the axis, ``gain`` times the wire.

        0 if the frame contains a floating-point number.
        """
        if not self._by_table:
            return abs(gain) * (FORCE_STEP_N if force else DISPLACEMENT_STEP_M)
        message = self.struct.force if force else self.struct.displacement
        signal = message.field[lib.RTHYB_FIELD_F if force else lib.RTHYB_FIELD_X]
        return 0.0 if signal.kind == lib.RTHYB_FLOAT else abs(gain * float(signal.scale))

    def extra_step(self, number: int) -> float:
        """Return the difference of neighbouring values of an extra channel; 0 if it is a float."""
        signal = self.struct.extra[number].signal
        return 0.0 if signal.kind == lib.RTHYB_FLOAT else abs(float(signal.scale))

    def encode_setpoint(self, setpoint: Setpoint) -> tuple[Frame, float]:
        """Return a command's frame and the displacement that the drive will decode, m.

        A displacement beyond the range of the frame is limited to that range. Raises ``CoreError``
        for one that is not finite, which no frame can represent.
        """
        c = self._setpoint
        c.x_m, c.seq, c.state = setpoint.x_m, setpoint.seq & _WORD, setpoint.state
        if lib.rthyb_encode_setpoint(self.struct, c, self._frames, self._sent) & _NOT_FINITE:
            raise CoreError(f"found the command {setpoint.x_m}; a command must be finite")
        return _frame(self._frames[0]), self._sent[0]

    def encode_feedback(self, reading: Reading) -> list[Frame]:
        """Return the frames of one sample of the drive; both values are required.

        A value that is not finite is sent as "no number". Raises ``CoreError`` if the table has no
        such raw value.
        """
        if reading.x_m is None or reading.f_n is None:
            raise CoreError("a sample from the drive must have a displacement and a force")
        c = self._reading
        c.has = lib.RTHYB_HAS_X | lib.RTHYB_HAS_F
        c.x_m, c.f_n = reading.x_m, reading.f_n
        c.echo, c.count, c.status = reading.echo & _WORD, reading.count & _WORD, reading.status
        for i, value in enumerate(reading.extra):
            c.extra[i] = value
        n = lib.rthyb_encode_feedback(self.struct, c, self._frames)
        if n == 0:
            raise CoreError("the DBC file cannot represent a reading that is not finite")
        return [_frame(self._frames[i]) for i in range(n)]

    def decode_setpoint(self, frame: Frame) -> tuple[int, Setpoint]:
        """Return the verdict on a frame (0: good) and the command that it contains."""
        c = self._setpoint
        verdict = lib.rthyb_decode_setpoint(self.struct, _fill(self._frames, frame), c)
        return verdict, Setpoint(c.x_m, c.seq, c.state)

    def decode_feedback(self, frame: Frame) -> tuple[int, Reading]:
        """Return the verdict on a frame (0: good) and the reading that it contains."""
        c = self._reading
        verdict = lib.rthyb_decode_feedback(self.struct, _fill(self._frames, frame), c)
        x_m = c.x_m if c.has & lib.RTHYB_HAS_X else None
        f_n = c.f_n if c.has & lib.RTHYB_HAS_F else None
        extra = tuple(
            math.nan if c.beyond >> i & 1 else c.extra[i] for i in range(self.struct.extra_count)
        )
        return verdict, Reading(x_m, f_n, c.echo, c.count, c.status, extra)


def can() -> Codec:
    """Return the codec of ``hw/rthyb.dbc``."""
    return Codec(ffi.new("rthyb_codec *", {"format": lib.RTHYB_WIRE_CAN}))


def own(identifiers: Identifiers, *, fd: bool = False, switched: bool = False) -> Codec:
    """Return the codec of the frames of ``hw/rthyb.dbc`` with other identifiers.

    Args:
        identifiers: of the frames of one drive.
        fd: CAN FD frames with the same data, rather than classic ones.
        switched: CAN FD frames send their data at the bit rate of the data phase.

    Raises:
        CoreError: the command has the identifier of a reading, or one has more than 11 bits.
    """
    struct = ffi.new("rthyb_codec *")
    _spell_out(struct, identifiers)
    for message in (struct.command, struct.displacement, struct.force):
        message.fd = (lib.RTHYB_FD_SWITCHED if switched else lib.RTHYB_FD) if fd else 0
    return Codec(struct)


def serial() -> Codec:
    """Return the codec of the serial packets."""
    return Codec(ffi.new("rthyb_codec *", {"format": lib.RTHYB_WIRE_SERIAL}))


class Deframer:
    """Finds packets in the bytes of a serial line, on the drive's side or for a listener.

    Args:
        extras: number of extra channels in a feedback packet.
    """

    def __init__(self, extras: int = 0) -> None:
        self._c = ffi.new("rthyb_deframer *", {"extras": extras})
        self._packet = ffi.new("rthyb_frame *")

    def feed(self, data: bytes) -> Iterator[tuple[int, Frame]]:
        """Yield verdict and packet for every 0 that ends a packet.

        With the verdict ``packet`` the frame holds the bytes before the CRC; otherwise it is empty.
        """
        for byte in data:
            verdict = lib.rthyb_deframer_byte(self._c, byte, self._packet)
            if verdict == lib.RTHYB_W_PACKET:
                yield verdict, _frame(self._packet)
            elif verdict:
                yield verdict, Frame(0, b"")


class Wire:
    """The controller's end: creates commands, pairs displacement with force, counts frames.

    Raises ``CoreError`` for a codec whose table does not fit its frames.

    Attributes:
        codec: format of the frames.
        struct: the ``rthyb_wire`` of the C core. While a C link that uses it is running, only
            `counters` may be called.
    """

    def __init__(self, codec: Codec) -> None:
        self.codec = codec
        self.struct = ffi.new("rthyb_wire *")
        if lib.rthyb_wire_init(self.struct, codec.struct):
            raise CoreError("the table of signals does not match its frames")
        self._frame = ffi.new("rthyb_frame *")
        self._sent = ffi.new("double *")
        self._feedback = ffi.new("rthyb_feedback *")

    def command(self, x_m: float, state: int) -> tuple[Frame, float]:
        """Return the next command's frame and the displacement that the drive will decode, m.

        Raises ``CoreError`` for a displacement that is not finite; no sequence number is consumed.
        """
        code = lib.rthyb_wire_command(self.struct, x_m, state, self._frame, self._sent)
        if code & _NOT_FINITE:
            raise CoreError(f"found the command {x_m}; a command must be finite")
        return _frame(self._frame), self._sent[0]

    def receive(self, frame: Frame) -> int:
        """Process a CAN frame; return the verdict."""
        return int(lib.rthyb_wire_receive(self.struct, _fill(self._frame, frame)))

    def feed(self, data: bytes) -> int:
        """Process bytes of the serial line; return all verdicts combined."""
        return int(lib.rthyb_wire_feed(self.struct, data, len(data)))

    def take(self) -> Feedback:
        """Return the newest pair; call once per tick, after everything received was processed."""
        c = self._feedback
        lost = lib.rthyb_wire_take(self.struct, c)
        return Feedback(
            lost=lost,
            x_m=c.x_m,
            f_n=c.f_n,
            echo=c.echo,
            count=c.count,
            status=c.status,
            delay=None if c.delay < 0 else c.delay,
            age=c.age,
            samples=c.samples,
        )

    def counters(self) -> dict[str, int]:
        """Return every counter of ``rthyb_wire_counters`` by name."""
        counters = self.struct.counters
        return {name: getattr(counters, name) for name, _ in ffi.typeof(counters).fields}


def _frame(c: Any) -> Frame:
    return Frame(c.id, bytes(ffi.buffer(c.data, c.length)), bool(c.fd))


def _fill(c: Any, frame: Frame) -> Any:
    """Write a frame into C memory; an oversized frame keeps its length but has no bytes."""
    target = c[0]
    target.id, target.fd, target.length = frame.id, frame.fd, len(frame.data)
    if len(frame.data) <= FRAME_MAX:
        ffi.memmove(target.data, frame.data, len(frame.data))
    return c
