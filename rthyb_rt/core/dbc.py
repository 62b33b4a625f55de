"""The C core's signal table from a DBC file, for a drive that does not use `hw/rthyb.dbc`.

cantools reads the file once; the core does the packing and unpacking. Signals are found by name;
`ROLES` states the requirements on each, and `docs/wire.md` explains how to adapt a DBC file.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rthyb_rt import units
from rthyb_rt._core import ffi, lib
from rthyb_rt.core.wire import ID_EXTENDED, Codec
from rthyb_rt.errors import InputError, Problem

if TYPE_CHECKING:
    from cantools.database.can import Database, Message
    from cantools.database.can.signal import Signal

NONE_NAME: Final = "not_a_number"
"""Name, in a signal's value table, of the raw value that means "no number"."""

RESET_NAME: Final = "reset"
LEAVING_NAME: Final = "leaving"
"""Names, in the value table of ``state``, of notices to the drive beyond the states."""

OWN_STATES: Final = 8
"""Raw values of ``state`` below this one are the controller's own states."""

EXACT_BITS: Final = 53
"""Largest number of bits of an integer that a double represents exactly."""


@dataclass(frozen=True)
class SignalRole:
    """The controller's use of a signal.

    Attributes:
        field: its field in the table.
        unit: SI unit of its value; ``None`` for a dimensionless whole number.
        least_bits: least number of bits of a whole number; 0: the signal may be missing.
        meaning: description for messages.
    """

    field: int
    unit: str | None
    least_bits: int
    meaning: str


ROLES: Final[dict[str, SignalRole]] = {
    "x_cmd": SignalRole(lib.RTHYB_FIELD_X, "m", 1, "the commanded displacement"),
    "x_meas": SignalRole(lib.RTHYB_FIELD_X, "m", 1, "the measured displacement"),
    "f_meas": SignalRole(lib.RTHYB_FIELD_F, "N", 1, "the measured force"),
    "seq": SignalRole(lib.RTHYB_FIELD_SEQ, None, 4, "the command's sequence number"),
    "state": SignalRole(lib.RTHYB_FIELD_STATE, None, 0, "the controller's state"),
    "echo": SignalRole(lib.RTHYB_FIELD_ECHO, None, 0, "the sequence number that the drive applied"),
    "count": SignalRole(
        lib.RTHYB_FIELD_COUNT, None, lib.RTHYB_COUNT_BITS_MIN, "the drive's count of samples"
    ),
    "status": SignalRole(lib.RTHYB_FIELD_STATUS, None, 0, "the device's status bits"),
    "crc8": SignalRole(-1, None, 0, "the checksum"),
}
_LEADS: Final = {
    "x_cmd": ("command", ("seq", "state", "crc8")),
    "x_meas": ("displacement", ("count", "echo", "status", "crc8")),
    "f_meas": ("force", ("count", "echo", "status", "crc8")),
}


def load(
    path: str | Path, names: Mapping[str, str] | None = None, reset_state: int | None = None
) -> Codec:
    """Return the codec of the command and feedback frames that a DBC file describes.

    Args:
        path: the DBC file.
        names: names of signals that differ from those in `ROLES`: ``{"x_cmd": "SetPos"}`` or, if
            several frames contain the signal, ``{"x_cmd": "DRIVE.SetPos"}``.
        reset_state: raw value of ``state`` that resets the drive after a stop of its own; None: the
            one that the file's value table calls `RESET_NAME`, if any.

    Raises:
        InputError: with all errors at once: cantools is missing, the file does not exist or is not
            a DBC, a signal is missing or ambiguous, multiplexed, or has a wrong unit, type or size.
    """
    return _Reader(Path(path), names or {}, reset_state).codec()


def extra(path: str | Path, codec: Codec, name: str) -> tuple[Any, bool]:
    """Return where an extra channel is located in the frames of a DBC file.

    Args:
        path: the DBC file.
        codec: the codec that `load` returned for it.
        name: the signal, as ``Signal`` or ``FRAME.Signal``.

    Returns:
        Its ``rthyb_signal``, in the unit of the file, and whether it is in the force frame.

    Raises:
        InputError: no feedback frame contains such a signal, or it cannot be used.
    """
    reader = _Reader(Path(path), {}, None)
    frame, _, wanted = name.rpartition(".")
    ids = {int(codec.struct.displacement.id): False, int(codec.struct.force.id): True}
    found = [
        (signal, ids[number])
        for message in _parse(Path(path)).messages
        if (number := message.frame_id | (ID_EXTENDED if message.is_extended_frame else 0)) in ids
        and frame in ("", message.name)
        for signal in message.signals
        if signal.name == wanted
    ]
    if len(found) != 1:
        what = "is in both feedback frames; give FRAME.Signal"
        if not found:
            what = (
                "no signal of this name exists in the frames of displacement and force, the "
                "only ones that are read"
            )
        raise InputError(what, f"{Path(path).name}: {name}")
    signal, in_force = found[0]
    place = ffi.new("rthyb_signal *")
    reader.fill_number(place, signal, 1.0, f"{Path(path).name}: {name}")
    if reader.problems:
        raise InputError(reader.problems)
    return place, in_force


class _Reader:
    def __init__(self, path: Path, names: Mapping[str, str], reset_state: int | None) -> None:
        self.path = path
        self.names = names
        self.reset_state = reset_state
        self.problems: list[Problem] = []
        self.found: set[str] = set()

    def codec(self) -> Codec:
        """Build the table, or raise an error that lists everything wrong."""
        for role in self.names:
            if role not in ROLES:
                allowed = ", ".join(ROLES)
                self.fault("", f"found a name for {role!r}; names can be given for {allowed}")
        database = _parse(self.path)
        struct = ffi.new("rthyb_codec *", {"format": lib.RTHYB_WIRE_TABLE})
        frames = {}
        for lead, (part, _) in _LEADS.items():
            message = self.message_with(database, lead)
            if message is not None:
                frames[lead] = message.name
                self.fill_message(getattr(struct, part), message, lead)
                if lead == "x_cmd":
                    self.fill_notices(struct, message)
        if self.reset_state is not None and "state" not in self.found:
            self.fault(
                frames.get("x_cmd", ""), "has no state in which link.reset_state could be sent"
            )
        if frames.get("x_cmd", "") in (frames.get("x_meas"), frames.get("f_meas")):
            self.fault(
                frames["x_cmd"], "contains both command and feedback; each needs a frame of its own"
            )
        for role, name in self.names.items():
            if role in ROLES and not ROLES[role].least_bits and role not in self.found:
                self.fault(
                    name,
                    "found no signal of this name in the frame with the values; it is needed "
                    f"for {role}",
                )
        if self.problems:
            raise InputError(self.problems)
        return Codec(struct)

    def fault(self, where: str, message: str) -> None:
        """Record an error of the file, or of the signal or frame ``where``."""
        place = f"{self.path.name}: {where}" if where else self.path.name
        problem = Problem(place, message)
        if problem not in self.problems:
            self.problems.append(problem)

    def name(self, role: str) -> tuple[str, str]:
        """Return frame name, or "", and signal name for a role."""
        frame, _, signal = self.names.get(role, role).rpartition(".")
        return frame, signal

    def message_with(self, database: Database, lead: str) -> Message | None:
        frame, signal = self.name(lead)
        having = [
            message
            for message in database.messages
            if frame in ("", message.name) and any(s.name == signal for s in message.signals)
        ]
        if len(having) == 1:
            return having[0]
        meaning = ROLES[lead].meaning
        if having:
            listed = ", ".join(f"{message.name}.{signal}" for message in having)
            self.fault(
                signal, f"{meaning} is ambiguous: found {listed}; give the name of one of them"
            )
            return None
        every = sorted({s.name for message in database.messages for s in message.signals})
        near = difflib.get_close_matches(signal, every, 1)
        hint = f"did you mean {near[0]}? " if near else ""
        where = f" in the frame {frame}" if frame else ""
        self.fault(
            signal,
            f"no signal of this name exists{where}, but {meaning} is needed; {hint}rename the "
            "signal in the file, or give its name",
        )
        return None

    def fill_message(self, c: Any, message: Message, lead: str) -> None:
        allowed = (*range(1, 9), 12, 16, 20, 24, 32, 48, 64)
        if message.length not in allowed:
            self.fault(
                message.name,
                f"found {message.length} bytes; a CAN frame has 1 to 8, a CAN FD frame also "
                "12, 16, 20, 24, 32, 48 or 64",
            )
            return
        if message.is_multiplexed():
            self.fault(message.name, "is multiplexed; every frame must contain every signal")
            return
        c.id = message.frame_id | (ID_EXTENDED if message.is_extended_frame else 0)
        c.length = message.length
        c.fd = bool(message.is_fd) or message.length > 8
        c.crc_at = -1
        signals = {s.name: s for s in message.signals}
        for role in (lead, *_LEADS[lead][1]):
            self.fill_role(c, message, signals, role)
        if lead == "x_cmd":
            self.fill_rest(c, message)

    def fill_role(self, c: Any, message: Message, signals: Mapping[str, Signal], role: str) -> None:
        frame, name = self.name(role)
        signal = signals.get(name) if frame in ("", message.name) else None
        needed = ROLES[role]
        where = f"{message.name}.{name}"
        if signal is None:
            if needed.least_bits:
                self.fault(where, f"is missing: {needed.meaning} must be in this frame")
            return
        self.found.add(role)
        if role == "crc8":
            self.fill_crc(c, signal, where)
        elif needed.unit is None:
            self.fill_whole(c.field[needed.field], signal, needed, where)
        else:
            self.fill_value(c.field[needed.field], signal, needed, where)

    def fill_rest(self, c: Any, message: Message) -> None:
        """Set signals that the controller does not use to their start values."""
        start = {s.name: s.raw_initial or 0 for s in message.signals}
        try:
            data = message.encode(start, scaling=False, strict=False)
        except Exception as error:  # the packing library raises errors of its own
            self.fault(message.name, f"a start value does not fit its signal: {error}")
            return
        ffi.memmove(c.fill, data, len(data))

    def fill_notices(self, struct: Any, message: Message) -> None:
        """Set the raw states for resetting and leaving the drive."""
        signal = next((s for s in message.signals if s.name == self.name("state")[1]), None)
        if signal is None:
            return
        named = {str(text).lower(): int(raw) for raw, text in (signal.choices or {}).items()}
        reset = named.get(RESET_NAME) if self.reset_state is None else self.reset_state
        leaving = named.get(LEAVING_NAME)
        most = 2**signal.length - 1
        for raw, name in ((reset, RESET_NAME), (leaving, LEAVING_NAME)):
            if raw is not None and not OWN_STATES <= raw <= most:
                where = f"{message.name}.{signal.name}"
                self.fault(
                    where,
                    f"found {raw} for {name}; 0 to {OWN_STATES - 1} are the controller's own "
                    f"states, and {signal.length} bits hold {most} at most",
                )
        if reset is not None and reset == leaving:
            self.fault(
                message.name,
                f"found {reset} for both {RESET_NAME} and {LEAVING_NAME}; the two must differ",
            )
        struct.reset, struct.leaving = reset or 0, leaving or 0

    def fill_crc(self, c: Any, signal: Signal, where: str) -> None:
        top = signal.start if signal.byte_order == "big_endian" else signal.start + 7
        if signal.length != 8 or top % 8 != 7:
            self.fault(
                where, f"found {signal.length} bits from bit {signal.start}; a whole byte is needed"
            )
        c.crc_at = top // 8

    def fill_whole(self, c: Any, signal: Signal, role: SignalRole, where: str) -> None:
        plain = not signal.is_signed and not signal.is_float
        if not plain or signal.scale != 1 or signal.offset != 0:
            self.fault(where, f"{role.meaning} must be unsigned with factor 1 and offset 0")
        if not max(1, role.least_bits) <= signal.length <= 32:
            least = max(1, role.least_bits)
            self.fault(where, f"found {signal.length} bits; {role.meaning} has {least} to 32")
        _fill_place(c, signal)

    def fill_value(self, c: Any, signal: Signal, role: SignalRole, where: str) -> None:
        self.fill_number(c, signal, self.unit_factor(signal, role, where), where)

    def fill_number(self, c: Any, signal: Signal, factor: float, where: str) -> None:
        """Set position, range and scale of a number; ``factor`` multiplies the file's scale."""
        bits = (32, 64) if signal.is_float else range(1, EXACT_BITS + 1)
        if signal.length not in bits:
            allowed = "32 or 64 as a float" if signal.is_float else f"1 to {EXACT_BITS}"
            self.fault(where, f"found {signal.length} bits; allowed are {allowed}")
        if signal.scale == 0:
            self.fault(where, "found factor 0, which is not allowed")
            return
        _fill_place(c, signal)
        c.scale, c.offset = signal.scale * factor, signal.offset * factor
        c.low, c.high = _raw_range(signal)
        least, most = _width(signal)
        if c.low > most or c.high < least:
            self.fault(where, f"found {signal.length} bits for [{signal.minimum}|{signal.maximum}]")
        for raw, text in (signal.choices or {}).items():
            if str(text) == NONE_NAME and not signal.is_float and least <= raw <= most:
                c.has_none, c.none = 1, raw

    def unit_factor(self, signal: Signal, role: SignalRole, where: str) -> float:
        """Return the factor from the signal's unit to SI."""
        assert role.unit is not None
        text = signal.unit or ""
        try:
            found = units.unit(text)
        except units.UnitError as error:
            self.fault(where, str(error))
            return 1.0
        if found.dimension != units.unit(role.unit).dimension:
            self.fault(
                where,
                f'found the unit "{text}"; {role.meaning} needs {units.dimension_name(role.unit)}, '
                f'such as "{role.unit}"',
            )
        return float(found.factor)


def _parse(path: Path) -> Database:
    try:
        import cantools
    except ImportError:
        raise InputError(
            "reading a DBC file needs cantools: pip install 'rthyb-rt[wire]'", str(path)
        ) from None
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", str(path)) from error
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        text = content.decode("cp1252", errors="replace")  # the encoding of most tools
    try:
        return cantools.database.load_string(text, database_format="dbc")
    except Exception as error:  # cantools has no common base class for errors in damaged files
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"is not a DBC file that cantools can read: {reason}", str(path)
        ) from error


def _fill_place(c: Any, signal: Signal) -> None:
    c.kind = lib.RTHYB_SIGNED if signal.is_signed else lib.RTHYB_UNSIGNED
    if signal.is_float:
        c.kind = lib.RTHYB_FLOAT
    c.start, c.length = signal.start, signal.length
    c.big_endian = signal.byte_order == "big_endian"


def _width(signal: Signal) -> tuple[float, float]:
    """Return the smallest and largest raw value that the signal's bits can hold."""
    if signal.is_float:
        return -float("inf"), float("inf")
    if signal.is_signed:
        return -(2.0 ** (signal.length - 1)), 2.0 ** (signal.length - 1) - 1
    return 0.0, 2.0**signal.length - 1


def _raw_range(signal: Signal) -> tuple[float, float]:
    """Return the range of a signal as raw values; a missing bound is infinite."""
    ends = [-float("inf"), float("inf")]
    for i, end in enumerate((signal.minimum, signal.maximum)):
        if end is not None:
            raw = (end - signal.offset) / signal.scale
            ends[i] = raw if signal.is_float else float(round(raw))
        elif signal.scale < 0:
            ends[i] = -ends[i]
    return min(ends), max(ends)
