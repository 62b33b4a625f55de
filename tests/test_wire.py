"""The wire: frames against cantools and struct, framing against cobs and binascii, bookkeeping."""

from __future__ import annotations

import binascii
import functools
import itertools
import math
import random
import re
import struct
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cobs import cobs
from hypothesis import given, settings
from hypothesis import strategies as st
from rthyb_rt._core import ffi

from rthyb_rt import core
from rthyb_rt.core import dbc, wire
from rthyb_rt.core.wire import Frame, Reading, Setpoint, Wire
from rthyb_rt.errors import InputError

cantools = pytest.importorskip("cantools")

ROOT = Path(__file__).resolve().parents[1]
OWN_DBC = ROOT / "hw" / "rthyb.dbc"
OWN = cantools.database.load_file(OWN_DBC)
MOST = 2**31 - 1

CODECS = {"can": wire.can(), "serial": wire.serial(), "own dbc": dbc.load(OWN_DBC)}
every_codec = pytest.mark.parametrize("name", CODECS)

displacements = st.floats(-3.0, 3.0) | st.integers(-MOST, MOST).map(lambda raw: raw * 1e-9)
forces = st.floats(-3e6, 3e6) | st.integers(-MOST, MOST).map(lambda raw: raw * 1e-3)
setpoints = st.builds(Setpoint, displacements, st.integers(0, 0xFFFF), st.integers(0, 7))
readings = st.builds(
    Reading, displacements, forces, *[st.integers(0, 255)] * 2, st.sampled_from([0, 1])
)


def names(verdict: int) -> list[str]:
    return wire.verdict_names(verdict)


def crc_bit_by_bit(data: bytes, width: int, polynomial: int, start: int) -> int:
    crc, top = start, 1 << (width - 1)
    for byte in data:
        crc ^= byte << (width - 8)
        for _ in range(8):
            crc = (crc << 1 ^ (polynomial if crc & top else 0)) & ((1 << width) - 1)
    return crc


def crc8(data: bytes) -> int:
    return crc_bit_by_bit(data, 8, 0x1D, 0xFF) ^ 0xFF


def raw(value: float, unit: float) -> int:
    """As the wire has it: nearest whole number, saturating, the most negative one for no number."""
    if not math.isfinite(value):
        return -(2**31)
    return round(max(-MOST, min(MOST, value / unit)))


# ---- checksums and COBS -------------------------------------------------------------------------


def test_checksums_have_the_check_values_of_their_catalogue() -> None:
    assert wire.crc8(b"123456789") == 0x4B
    assert wire.crc16(b"123456789") == 0x29B1


@given(st.binary(max_size=80))
def test_checksums_agree_with_a_bitwise_one_and_with_binascii(data: bytes) -> None:
    assert wire.crc8(data) == crc8(data)
    assert wire.crc16(data) == binascii.crc_hqx(data, 0xFFFF)
    assert wire.crc16(data) == crc_bit_by_bit(data, 16, 0x1021, 0xFFFF)


@given(st.lists(st.sampled_from([0, 0, 1, 255]) | st.integers(0, 255), max_size=253).map(bytes))
def test_cobs_agrees_with_the_cobs_package(data: bytes) -> None:
    assert wire.cobs_encode(data) == cobs.encode(data) + b"\0"


def test_packet_too_long_for_one_cobs_block_is_refused() -> None:
    assert cobs.decode(wire.cobs_encode(b"\1" * 253)[:-1]) == b"\1" * 253
    with pytest.raises(core.CoreError, match="at most 253"):
        wire.cobs_encode(b"\1" * 254)


# ---- our own frames -----------------------------------------------------------------------------


@given(setpoints)
def test_command_frame_is_laid_out_as_documented(setpoint: Setpoint) -> None:
    frame, sent_m = CODECS["can"].encode_setpoint(setpoint)
    x = raw(setpoint.x_m, 1e-9)
    body = struct.pack("<iHB", x, setpoint.seq, setpoint.state)
    assert frame == Frame(0x101, body + bytes([crc8(b"\x01" + body)]))
    assert sent_m == x * 1e-9
    assert CODECS["can"].decode_setpoint(frame) == (0, Setpoint(sent_m, *setpoint_rest(setpoint)))


def setpoint_rest(setpoint: Setpoint) -> tuple[int, int]:
    return setpoint.seq, setpoint.state


@given(readings)
def test_feedback_frames_are_laid_out_as_documented(reading: Reading) -> None:
    frames = CODECS["can"].encode_feedback(reading)
    tail = bytes([reading.echo, reading.count, reading.status])
    assert reading.x_m is not None
    assert reading.f_n is not None
    parts = ((0x181, raw(reading.x_m, 1e-9)), (0x182, raw(reading.f_n, 1e-3)))
    for frame, (can_id, number) in zip(frames, parts, strict=True):
        body = struct.pack("<i", number) + tail
        assert frame == Frame(can_id, body + bytes([crc8(bytes([can_id & 0xFF]) + body)]))


@given(setpoints, readings)
def test_serial_packets_are_laid_out_as_documented(setpoint: Setpoint, reading: Reading) -> None:
    assert reading.x_m is not None
    assert reading.f_n is not None
    command = struct.pack("<BiHB", 1, raw(setpoint.x_m, 1e-9), *setpoint_rest(setpoint))
    feedback = struct.pack("<Bii", 0x81, raw(reading.x_m, 1e-9), raw(reading.f_n, 1e-3))
    feedback += bytes([reading.echo, reading.count, reading.status])
    sent = [CODECS["serial"].encode_setpoint(setpoint)[0]]
    sent += CODECS["serial"].encode_feedback(reading)
    for packet, frame in zip((command, feedback), sent, strict=True):
        crc = struct.pack("<H", binascii.crc_hqx(packet, 0xFFFF))
        assert frame == Frame(0, cobs.encode(packet + crc) + b"\0")
    assert [len(frame.data) for frame in sent] == [12, 16]


@given(setpoints, readings)
def test_cantools_reads_what_was_sent_and_writes_what_is_read(
    setpoint: Setpoint, reading: Reading
) -> None:
    frame, sent_m = CODECS["can"].encode_setpoint(setpoint)
    decoded = OWN.decode_message(frame.id, frame.data, decode_choices=False)
    assert decoded["x_cmd"] == pytest.approx(sent_m, abs=1e-15)
    assert (decoded["seq"], decoded["state"]) == setpoint_rest(setpoint)
    for frame, key, unit in zip(
        CODECS["can"].encode_feedback(reading), ("x_meas", "f_meas"), (1e-9, 1e-3), strict=True
    ):
        decoded = OWN.decode_message(frame.id, frame.data, decode_choices=False)
        value = reading.x_m if key == "x_meas" else reading.f_n
        assert value is not None
        assert decoded[key] == pytest.approx(raw(value, unit) * unit, rel=1e-12, abs=1e-15)
        assert OWN.encode_message(frame.id, decoded) == frame.data


@given(setpoints | st.builds(Setpoint, st.floats(allow_nan=False, allow_infinity=False)))
def test_own_dbc_by_table_gives_the_bytes_of_the_fixed_codec(setpoint: Setpoint) -> None:
    assert CODECS["own dbc"].encode_setpoint(setpoint) == CODECS["can"].encode_setpoint(setpoint)


@given(readings | st.builds(Reading, st.floats(), st.floats(), st.integers(0, 255)))
def test_own_dbc_by_table_gives_the_feedback_of_the_fixed_codec(reading: Reading) -> None:
    frames = CODECS["can"].encode_feedback(reading)
    assert CODECS["own dbc"].encode_feedback(reading) == frames
    for frame in frames:
        by_table = CODECS["own dbc"].decode_feedback(frame)
        assert repr(by_table) == repr(CODECS["can"].decode_feedback(frame))


@given(
    st.sampled_from([0x101, 0x181, 0x182, 0x183, 0x101 | wire.ID_EXTENDED]),
    st.binary(max_size=10),
    st.booleans(),
)
def test_own_dbc_by_table_judges_any_frame_as_the_fixed_codec(
    can_id: int, data: bytes, good_crc: bool
) -> None:
    if good_crc and len(data) == 8:
        data = data[:7] + bytes([crc8(bytes([can_id & 0xFF]) + data[:7])])
    frame = Frame(can_id, data)
    table, fixed = CODECS["own dbc"], CODECS["can"]
    assert table.decode_feedback(frame) == fixed.decode_feedback(frame)
    assert table.decode_setpoint(frame) == fixed.decode_setpoint(frame)


def test_states_and_identifiers_of_the_dbc_are_those_of_the_core() -> None:
    choices = OWN.get_message_by_name("ACT_CMD").get_signal_by_name("state").choices
    assert [str(choices[i]) for i in range(8)] == list(core.STATES)
    ids = {message.name: message.frame_id for message in OWN.messages}
    assert ids == {"ACT_CMD": wire.ACT_CMD, "ACT_FB": wire.ACT_FB, "LC_FB": wire.LC_FB}
    assert CODECS["own dbc"].command_id == CODECS["can"].command_id == wire.ACT_CMD
    assert CODECS["own dbc"].feedback_ids == CODECS["can"].feedback_ids
    assert not CODECS["own dbc"].is_fd


@every_codec
def test_command_beyond_the_frame_saturates_and_never_wraps(name: str) -> None:
    for x_m in (3.0, 1e300):
        for sign in (1.0, -1.0):
            _, sent_m = CODECS[name].encode_setpoint(Setpoint(sign * x_m))
            assert sent_m == sign * MOST * 1e-9


@every_codec
@pytest.mark.parametrize("x_m", [math.nan, math.inf, -math.inf])
def test_command_that_is_not_finite_never_becomes_a_frame(name: str, x_m: float) -> None:
    w = Wire(CODECS[name])
    with pytest.raises(core.CoreError, match="finite"):
        w.command(x_m, 4)
    assert w.counters()["sent"] == 0
    assert w.struct.seq == 0


def test_frame_without_a_number_says_so() -> None:
    nothing = Frame(0x181, (body := struct.pack("<i", -(2**31)) + b"\0\7\0") + bytes([0]))
    nothing = Frame(0x181, body + bytes([crc8(b"\x81" + body)]))
    for name in ("can", "own dbc"):
        assert names(CODECS[name].decode_feedback(nothing)[0]) == ["not_finite"]
    decoded = OWN.decode_message(0x181, nothing.data)
    assert str(decoded["x_meas"]) == dbc.NONE_NAME


def test_every_one_and_two_bit_error_of_a_can_frame_is_noticed() -> None:
    good = CODECS["can"].encode_feedback(Reading(-0.0123456, 8765.4, 17, 200))[0]
    word = int.from_bytes(good.data, "little")
    flips = [1 << bit for bit in range(64)]
    flips += [a | b for a, b in itertools.combinations(flips, 2)]
    for name in ("can", "own dbc"):
        for flip in flips:
            damaged = Frame(good.id, (word ^ flip).to_bytes(8, "little"))
            assert names(CODECS[name].decode_feedback(damaged)[0]) == ["crc"]


def test_frame_under_another_identifier_is_noticed_by_its_checksum() -> None:
    x, f = CODECS["can"].encode_feedback(Reading(0.001, 0.001, 1, 2))
    assert x.data[:7] != f.data[:7]
    assert names(CODECS["can"].decode_feedback(Frame(wire.LC_FB, x.data))[0]) == ["crc"]


# ---- serial framing -----------------------------------------------------------------------------


def serial_bytes(n: int) -> bytes:
    """Return sample n of a drive."""
    (frame,) = CODECS["serial"].encode_feedback(Reading(n * 1e-6, -n * 1.0, n & 255, n & 255))
    return frame.data


def pieces(data: bytes, seed: int) -> Iterator[bytes]:
    rng = random.Random(seed)
    while data:
        n = rng.randint(1, 40)
        yield data[:n]
        data = data[n:]


@pytest.mark.parametrize("seed", range(5))
def test_stream_cut_anywhere_gives_every_sample(seed: int) -> None:
    w = Wire(CODECS["serial"])
    for piece in pieces(b"".join(serial_bytes(n) for n in range(1, 501)), seed):
        w.feed(piece)
    counters = w.counters()
    assert (counters["pairs"], counters["missed"], counters["frames"]) == (500, 0, 500)
    assert w.take().x_m == 500e-6


@given(st.binary(max_size=60))
def test_decoder_is_in_step_at_the_first_zero_after_any_noise(noise: bytes) -> None:
    w = Wire(CODECS["serial"])
    w.feed(noise + b"\0")
    before = w.counters()["pairs"]
    assert names(w.feed(serial_bytes(before + 100))) == ["pair"]


def test_every_one_and_two_bit_error_of_a_serial_packet_is_noticed() -> None:
    good = serial_bytes(0x1234)
    word = int.from_bytes(good, "little")
    flips = [1 << bit for bit in range(8 * len(good))]
    flips += [a | b for a, b in itertools.combinations(flips, 2)]
    w = Wire(CODECS["serial"])
    start = bytes(ffi.buffer(w.struct))
    for flip in flips:
        ffi.memmove(w.struct, start, len(start))
        verdict = w.feed((word ^ flip).to_bytes(len(good), "little") + b"\0")
        assert verdict
        assert not verdict & wire.VERDICTS["pair"]


@pytest.mark.parametrize(
    ("line", "verdict"),
    [
        (b"\0\0\0", []),
        (b"\5\1\2\0", ["framing"]),
        (b"\3\1\2\0", ["length"]),
        (b"\4\1\2\3\0", ["crc"]),
        (b"\x11" + b"\1" * 16 + b"\0", ["length"]),
        (b"\xff" * 300 + b"\0", ["length"]),
        (serial_bytes(7)[:-3] + b"\0", ["framing"]),
        (wire.cobs_encode(b"\x77\1" + struct.pack("<H", wire.crc16(b"\x77\1"))), ["id"]),
        (wire.cobs_encode(b"\x81\1" + struct.pack("<H", wire.crc16(b"\x81\1"))), ["length"]),
        (wire.serial().encode_setpoint(Setpoint(0.0))[0].data, ["id"]),
    ],
)
def test_what_is_no_packet_is_counted_by_its_fault(line: bytes, verdict: list[str]) -> None:
    w = Wire(CODECS["serial"])
    assert names(w.feed(line)) == verdict
    assert w.counters()["pairs"] == 0
    assert w.counters()["frames"] == len(verdict)
    assert names(w.feed(serial_bytes(1))) == ["pair"]


def test_drive_reads_commands_from_the_line() -> None:
    w, deframer = Wire(CODECS["serial"]), wire.Deframer()
    line = b"noise\0" + b"".join(w.command(k * 1e-3, 4)[0].data for k in range(3))
    got = list(deframer.feed(line))
    assert names(got[0][0]) == ["framing"]
    assert [names(verdict) for verdict, _ in got[1:]] == [["packet"]] * 3
    read = [CODECS["serial"].decode_setpoint(packet) for _, packet in got[1:]]
    assert [(v, s.seq, s.state) for v, s in read] == [(0, 1, 4), (0, 2, 4), (0, 3, 4)]
    assert read[2][1].x_m == pytest.approx(2e-3, abs=1e-9)


# ---- which frames make a sample -----------------------------------------------------------------


class Drive:
    """Sends sample after sample, each with its own number as displacement and force."""

    def __init__(self, codec: wire.Codec = CODECS["can"], start: int = 1) -> None:
        self.codec = codec
        self.n = start

    def frames(self, **changed: Any) -> list[Frame]:
        """Return the frames of the next sample."""
        values = {"x_m": self.n * 1e-6, "f_n": float(self.n), "count": self.n & 255} | changed
        self.n += 1
        return self.codec.encode_feedback(Reading(**values))


def receive(w: Wire, *frames: Frame) -> list[list[str]]:
    return [names(w.receive(frame)) for frame in frames]


def sample_of(w: Wire) -> int | None:
    """Take a tick's pair; return the sample's number, None if there is no new pair."""
    feedback = w.take()
    if feedback.lost:
        return None
    assert feedback.f_n == round(feedback.x_m * 1e9) // 1000
    return int(feedback.f_n)


def test_two_frames_of_one_count_make_a_pair() -> None:
    w, drive = Wire(CODECS["can"]), Drive()
    x, f = drive.frames()
    assert receive(w, x, f) == [["half"], ["pair"]]
    assert sample_of(w) == 1
    x, f = drive.frames()
    assert receive(w, f, x) == [["half"], ["pair"]]
    assert sample_of(w) == 2
    assert w.counters()["lone"] == 0


def test_lone_frame_is_a_lost_one() -> None:
    w, drive = Wire(CODECS["can"]), Drive()
    receive(w, *drive.frames())
    assert sample_of(w) == 1
    receive(w, drive.frames()[0])
    assert sample_of(w) is None
    receive(w, *drive.frames())
    assert sample_of(w) == 3
    counters = w.counters()
    assert (counters["lone"], counters["missed"], counters["stale"]) == (1, 1, 1)


def test_halves_of_different_instants_are_never_joined() -> None:
    w, drive = Wire(CODECS["can"]), Drive()
    x1, _ = drive.frames()
    _, f2 = drive.frames()
    assert receive(w, x1, f2) == [["half"], ["half"]]
    assert sample_of(w) is None


def test_half_does_not_wait_for_the_same_count_one_round_later() -> None:
    w, drive = Wire(CODECS["can"]), Drive()
    receive(w, drive.frames()[0])
    for _ in range(21):
        assert sample_of(w) is None
    assert receive(w, Drive(start=1 + 256).frames()[1]) == [["half"]]
    assert w.counters()["lone"] == 1


NOTICES = {name: number for number, name in wire.NOTICES.items()}


def told(codec: wire.Codec, name: str) -> tuple[int, int]:
    """Return the state that leaves for what a drive is told, and what comes of it there."""
    frame, _ = codec.encode_setpoint(Setpoint(1e-3, 7, NOTICES[name]))
    return frame.data[6], codec.decode_setpoint(frame)[1].state


def test_reset_and_leaving_are_states_of_our_own_frames() -> None:
    for codec in (CODECS["can"], dbc.load(OWN_DBC)):
        assert told(codec, "RESET") == (8, NOTICES["RESET"])
        assert told(codec, "LEAVING") == (9, NOTICES["LEAVING"])
        assert codec.has_reset


def test_state_that_resets_a_users_drive_is_named_in_the_dbc_or_in_the_rig_file(
    tmp_path: Path,
) -> None:
    path = tmp_path / "drive.dbc"
    path.write_text(OWN_TEXT + 'VAL_ 257 state 0 "Idle" 32 "Reset" ;\n', encoding="utf-8")
    named = dbc.load(path)
    assert told(named, "RESET") == (32, NOTICES["RESET"])
    assert told(named, "LEAVING") == (0, 0), "a drive that has no word for it hears IDLE"
    assert told(dbc.load(path, reset_state=33), "RESET") == (33, NOTICES["RESET"])
    path.write_text(OWN_TEXT, encoding="utf-8")
    silent = dbc.load(path)
    assert not silent.has_reset
    assert told(silent, "RESET") == (0, 0)
    # What this program calls RESET is nothing to a drive that has another word for it, or none.
    frame, _ = dbc.load(path, reset_state=8).encode_setpoint(Setpoint(1e-3, 7, NOTICES["RESET"]))
    assert frame.data[6] == 8
    assert silent.decode_setpoint(frame)[1].state not in (*NOTICES.values(), *range(8))


@pytest.mark.parametrize(
    ("values", "reset_state", "message"),
    [
        ('3 "reset"', None, "found 3 for reset; 0 to 7 are the controller's own states"),
        ('8 "idle"', 256, "found 256 for reset; 0 to 7 .*8 bits hold 255 at most"),
        ('9 "leaving"', 9, "found 9 for both reset and leaving"),
    ],
)
def test_state_that_cannot_reset_a_drive_is_refused(
    tmp_path: Path, values: str, reset_state: int | None, message: str
) -> None:
    path = tmp_path / "drive.dbc"
    path.write_text(f"{OWN_TEXT}VAL_ 257 state {values} ;\n", encoding="utf-8")
    with pytest.raises(InputError, match=message):
        dbc.load(path, reset_state=reset_state)


def short_count(bits: int) -> wire.Codec:
    """Return our own frames with a shorter count in both feedbacks, as a table."""
    text, n = re.subn(r"count : 40\|8", f"count : 40|{bits}", OWN_TEXT)
    assert n == 2
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "short.dbc"
        path.write_text(text, encoding="utf-8")
        return dbc.load(path)


def test_displacement_never_meets_the_force_of_the_next_round_of_a_short_count() -> None:
    """With 4 bits the displacement of tick 20 met the force of tick 36, and passed for fresh."""
    with pytest.raises(InputError, match=r"found 4 bits; the drive's count of samples has 5"):
        short_count(4)
    codec = short_count(5)
    for skipped in (0, 10, 15):
        w = Wire(codec)
        w.receive(codec.encode_feedback(Reading(1e-3, 0.0, count=20))[0])
        # The displacements of a whole round are lost, and this PC skips some of its ticks.
        for _ in range(32 - skipped):
            assert w.take().lost
        late = codec.encode_feedback(Reading(0.0, 5e3, count=20 + 32))[1]
        assert names(w.receive(late)) == ["half"]
        assert w.take().lost


def test_late_half_completes_its_pair_a_tick_later() -> None:
    w, drive = Wire(CODECS["can"]), Drive()
    x, f = drive.frames()
    receive(w, x)
    assert sample_of(w) is None
    assert receive(w, f) == [["pair"]]
    assert sample_of(w) == 1


def test_newest_pair_of_a_tick_wins() -> None:
    w, drive = Wire(CODECS["can"]), Drive()
    for _ in range(3):
        receive(w, *drive.frames())
    assert sample_of(w) == 3
    assert sample_of(w) is None
    assert w.counters()["superseded"] == 2
    assert w.counters()["missed"] == 0


@pytest.mark.parametrize("name", ["can", "own dbc"])
def test_duplicates_change_nothing(name: str) -> None:
    w, drive = Wire(CODECS[name]), Drive()
    x, f = drive.frames()
    assert receive(w, x, x, f, f, x) == [["half"], ["duplicate"], ["pair"], *[["duplicate"]] * 2]
    assert sample_of(w) == 1
    assert sample_of(w) is None
    assert w.counters()["duplicate"] == 3


def test_older_frames_are_not_taken() -> None:
    w, drive = Wire(CODECS["can"]), Drive()
    old, new = drive.frames(), drive.frames()
    receive(w, *new)
    assert receive(w, *old) == [["reordered"]] * 2
    assert sample_of(w) == 2
    assert w.counters()["reordered"] == 2


def test_older_half_does_not_push_a_newer_one_out() -> None:
    w, drive = Wire(CODECS["can"]), Drive()
    old, new = drive.frames(), drive.frames()
    assert receive(w, new[0], old[0], new[1]) == [["half"], ["reordered"], ["pair"]]
    assert sample_of(w) == 2


def test_counts_go_round_without_a_gap() -> None:
    w, drive = Wire(CODECS["can"]), Drive()
    for n in range(1, 1001):
        receive(w, *drive.frames())
        feedback = w.take()
        assert feedback.samples == n
        assert feedback.lost == 0
    assert w.counters()["missed"] == 0


def test_drive_that_repeats_one_sample_is_stuck_and_stays_so() -> None:
    w, drive = Wire(CODECS["can"]), Drive()
    frames = drive.frames()
    receive(w, *frames)
    assert sample_of(w) == 1
    for _ in range(300):
        receive(w, *frames)
        assert sample_of(w) is None
    assert receive(w, *frames) == [["duplicate", "stuck"]] * 2
    assert receive(w, *drive.frames())[1] == ["pair"]
    assert w.counters()["stuck"] == 602 - 5


def test_drive_switched_on_again_is_taken_after_twenty_ticks() -> None:
    w, drive = Wire(CODECS["can"]), Drive(start=100)
    receive(w, *drive.frames())
    assert sample_of(w) == 100
    again = Drive(start=5)
    taken = []
    for _ in range(25):
        receive(w, *again.frames())
        taken.append(sample_of(w))
    assert taken[:20] == [None] * 20
    assert taken[20:] == [25, 26, 27, 28, 29]


def test_reading_that_the_drive_calls_invalid_is_not_taken() -> None:
    w, drive = Wire(CODECS["can"]), Drive()
    verdicts = receive(w, *drive.frames(status=wire.DEVICE_INVALID))
    assert verdicts == [["invalid"]] * 2
    assert core.status_names(w.take().lost) == ["out_of_range"]
    receive(w, *drive.frames(status=wire.DEVICE_STOPPED))
    feedback = w.take()
    assert (feedback.lost, feedback.status) == (0, wire.DEVICE_STOPPED)


@every_codec
def test_reading_without_a_number_is_told_to_the_gate(name: str) -> None:
    w, drive = Wire(CODECS[name]), Drive(CODECS[name])

    def arrive(frames: list[Frame]) -> None:
        for frame in frames:
            if CODECS[name].is_serial:
                w.feed(frame.data)
            else:
                w.receive(frame)

    arrive(drive.frames())
    assert w.take().lost == 0
    arrive(drive.frames(f_n=math.nan))
    feedback = w.take()
    assert feedback.lost == wire.LOST | core.STATUS["not_finite"]
    assert feedback.f_n == 1.0
    arrive(drive.frames())
    assert w.take().lost == 0


# ---- how old the answer is ----------------------------------------------------------------------


def delays(link: int, ticks: int, codec: wire.Codec = CODECS["can"]) -> list[int | None]:
    """Commands reach the drive `link` samples late; a tick sees the sample of its own instant."""
    w, drive = Wire(codec), Drive(codec)
    commands: list[Frame] = []
    seen = []
    for n in range(ticks):
        at = n - 1 - link  # the command for this instant was made one tick ago
        echo = codec.decode_setpoint(commands[at])[1].seq if at >= 0 else 0
        receive(w, *drive.frames(echo=echo & 255, count=n & 255))
        seen.append(w.take().delay)
        commands.append(w.command(0.0, 4)[0])
    return seen


@pytest.mark.parametrize("link", [0, 1, 2, 17, 100])
def test_echo_gives_the_delay_of_the_link_in_whole_samples(link: int) -> None:
    seen = delays(link, 700)
    assert seen[: link + 1] == [None] * (link + 1)
    assert seen[link + 1 :] == [link] * (700 - link - 1)


def test_delay_is_not_known_before_a_command_was_echoed() -> None:
    w, drive = Wire(CODECS["can"]), Drive()
    receive(w, *drive.frames(echo=200))
    assert w.take().delay is None
    w.command(0.0, 0)
    receive(w, *drive.frames(echo=200))
    assert w.take().delay is None  # what a controller before us has sent
    receive(w, *drive.frames(echo=1))
    assert w.take().delay == 0


def test_answer_grows_older_while_nothing_comes() -> None:
    w, drive = Wire(CODECS["can"]), Drive()
    w.command(0.0, 4)
    receive(w, *drive.frames(echo=1))
    ages = []
    for _ in range(5):
        feedback = w.take()
        ages.append((feedback.age, feedback.delay, feedback.lost))
        w.command(0.0, 4)
    assert ages == [(0, 0, 0), *[(n, n, wire.LOST) for n in range(1, 5)]]


# ---- a bad line against a second bookkeeping ----------------------------------------------------

fates = st.lists(
    st.tuples(
        st.sampled_from(["well"] * 6 + ["lost", "twice", "late", "damaged"]),
        st.sampled_from(["well"] * 6 + ["lost", "twice", "late", "damaged"]),
    ),
    max_size=120,
)


def through(line: list[Frame], frame: Frame, fate: str, late: list[Frame]) -> None:
    if fate == "late":
        late.append(frame)
        return
    if fate == "damaged":
        frame = Frame(frame.id, frame.data[:3] + bytes([frame.data[3] ^ 0x10]) + frame.data[4:])
    line += [frame] * {"lost": 0, "twice": 2}.get(fate, 1)


@settings(max_examples=200)
@given(fates)
def test_bad_line_loses_samples_but_never_mixes_or_reorders_them(
    fate_of: list[tuple[str, str]],
) -> None:
    w, drive = Wire(CODECS["can"]), Drive()
    late: list[Frame] = []
    receive(w, *drive.frames())
    last = sample_of(w)
    assert last == 1
    for fate_x, fate_f in fate_of:
        line, late = late, []
        for frame, fate in zip(drive.frames(), (fate_x, fate_f), strict=True):
            through(line, frame, fate, late)
        receive(w, *line)
        sample = sample_of(w)  # asserts that both values are of one instant
        if sample is not None:
            assert last < sample < drive.n
            last = sample
        if {fate_x, fate_f} <= {"well", "twice"}:
            assert sample == drive.n - 1
    counters = w.counters()
    damaged = sum(fate == "damaged" for pair in fate_of for fate in pair)
    assert counters["bad_crc"] == damaged
    assert counters["pairs"] + counters["missed"] == last
    assert counters["stale"] == 1 + len(fate_of) - counters["pairs"] + counters["superseded"]


@given(st.integers(0, 2**29), st.binary(max_size=64), st.booleans())
def test_bad_frame_changes_nothing_but_its_counter(can_id: int, data: bytes, known: bool) -> None:
    w, drive = Wire(CODECS["can"]), Drive()
    receive(w, *drive.frames(), drive.frames()[0])
    frame = Frame(wire.LC_FB if known else can_id, data)
    before, counted = memory(w), w.counters()
    verdict = names(w.receive(frame))
    after = {key: n for key, n in w.counters().items() if n != counted[key]}
    if verdict in (["id"], ["length"], ["crc"]):
        assert memory(w) == before
        key = {"id": "other_id", "length": "bad_length", "crc": "bad_crc"}[verdict[0]]
        assert after == {"frames": 4, key: 1}
    else:
        assert known


def memory(w: Wire) -> bytes:
    """Return the wire's memory without its counters."""
    whole = bytes(ffi.buffer(w.struct))
    counters = dict(ffi.typeof(w.struct[0]).fields)["counters"]
    end = counters.offset + ffi.sizeof(counters.type)
    return whole[: counters.offset] + whole[end:]


def test_frame_longer_than_any_is_refused() -> None:
    w = Wire(CODECS["can"])
    assert names(w.receive(Frame(wire.ACT_FB, bytes(100)))) == ["length"]


# ---- any DBC ------------------------------------------------------------------------------------


def signal_line(
    name: str,
    start: int,
    length: int,
    order: str,
    sign: str,
    factor: float,
    offset: float,
    unit: str,
) -> str:
    return f' SG_ {name} : {start}|{length}@{order}{sign} ({factor!r},{offset!r}) [0|0] "{unit}" PC'


def dbc_text(*messages: str, tail: str = "") -> str:
    return "\n".join(['VERSION ""', "BU_: PC", *messages, tail, ""])


def message_text(can_id: int, name: str, length: int, *signals: str) -> str:
    return "\n".join([f"BO_ {can_id} {name}: {length} PC", *signals, ""])


@st.composite
def layouts(draw: st.DrawFn) -> tuple[str, dict[str, tuple[float, float]]]:
    """A DBC whose signals lie anywhere, of any size, order, sign and scale; their raw ranges."""
    ranges: dict[str, tuple[float, float]] = {}
    floats: list[str] = []

    def message(can_id: int, name: str, *roles: str) -> str:
        room = 0
        lines = []
        for role in draw(st.permutations(roles)):
            value = role in ("x_cmd", "x_meas", "f_meas")
            is_float = value and draw(st.booleans())
            least = 5 if role == "count" else 4
            bits = draw(
                st.sampled_from([32, 64]) if is_float else st.integers(least, 53 if value else 32)
            )
            shift = draw(st.integers(0, 7))
            n_bytes = (shift + bits + 7) // 8
            big = draw(st.booleans())
            start = 8 * room + (7 - shift if big else shift)
            room += n_bytes
            signed = value and draw(st.booleans())
            factor = draw(st.sampled_from([1.0, -0.5, 1e-3, 2.5e-7])) if value else 1.0
            offset = draw(st.sampled_from([0.0, -3.25, 100.0])) if value else 0.0
            unit = {"x": "mm", "f": "kN"}[role[0]] if value else ""
            lines.append(
                signal_line(
                    role,
                    start,
                    bits,
                    "0" if big else "1",
                    "-" if signed else "+",
                    factor,
                    offset,
                    unit,
                )
            )
            if is_float:
                floats.append(f"SIG_VALTYPE_ {can_id} {role} : {1 if bits == 32 else 2};")
            low = -(2.0 ** (bits - 1)) if signed else 0.0
            ranges[role] = (-1e9, 1e9) if is_float else (low, low + 2.0**bits - 1)
        length = next(n for n in (*range(1, 9), 12, 16, 20, 24, 32, 48, 64) if n >= room)
        return message_text(can_id, name, length, *lines)

    parts = [message(0x120, "CMD", "x_cmd", "seq", "state")]
    if draw(st.booleans()):
        parts.append(message(0x210, "BOTH", "x_meas", "f_meas", "count", "echo"))
    else:
        parts.append(message(0x80000000 | 0x18FF0001, "POS", "x_meas", "count", "echo", "status"))
        parts.append(message(0x7FF, "FORCE", "f_meas", "count"))
    return dbc_text(*parts, tail="\n".join(floats)), ranges


@pytest.mark.long
@settings(max_examples=150, deadline=None)
@given(layouts(), st.data())
def test_any_layout_packs_and_unpacks_as_cantools_does(
    tmp_path_factory: pytest.TempPathFactory,
    layout: tuple[str, dict[str, tuple[float, float]]],
    data: st.DataObject,
) -> None:
    text, ranges = layout
    path = tmp_path_factory.getbasetemp() / "layout.dbc"
    path.write_text(text, encoding="ascii")
    database, codec = cantools.database.load_string(text), dbc.load(path)

    def physical(role: str) -> float:
        """Draw a value that the signal can hold, in its own unit."""
        signal = next(s for m in database.messages for s in m.signals if s.name == role)
        drawn = data.draw(st.floats(*ranges[role], width=32 if signal.is_float else 64))
        number = drawn if signal.is_float else max(ranges[role][0], float(math.floor(drawn)))
        return number * signal.scale + signal.offset

    counts = {key: data.draw(st.integers(0, 15)) for key in ("seq", "count", "echo")}
    counts["state"] = data.draw(st.integers(0, 7))
    values = (
        {role: physical(role) for role in ("x_cmd", "x_meas", "f_meas")} | counts | {"status": 0}
    )
    si = {"x_cmd": 1e-3, "x_meas": 1e-3, "f_meas": 1e3}
    frame, sent_m = codec.encode_setpoint(
        Setpoint(values["x_cmd"] * 1e-3, counts["seq"], counts["state"])
    )
    frames = [
        frame,
        *codec.encode_feedback(
            Reading(
                values["x_meas"] * 1e-3, values["f_meas"] * 1e3, counts["echo"], counts["count"]
            )
        ),
    ]
    assert len(frames) == len(database.messages)
    for got in frames:
        message = database.get_message_by_frame_id(got.id & ~wire.ID_EXTENDED)
        assert bool(got.id & wire.ID_EXTENDED) == message.is_extended_frame
        assert (len(got.data), got.fd) == (message.length, message.length > 8)
        decoded = message.decode(got.data)
        ours = si_values(codec, got)
        for signal in message.signals:
            role = signal.name
            value = decoded[role]
            tolerance = abs(signal.scale) * (1.0 if not signal.is_float else 1e-6 * 1e9)
            assert value == pytest.approx(values[role], rel=1e-6, abs=0.51 * tolerance)
            if role in si:
                assert ours[role] == pytest.approx(value * si[role], rel=1e-9, abs=1e-9)
    assert sent_m == si_values(codec, frame)["x_cmd"]


def si_values(codec: wire.Codec, frame: Frame) -> dict[str, float]:
    """Return what the table reads out of a frame, whichever it is."""
    verdict, setpoint = codec.decode_setpoint(frame)
    if verdict == 0:
        return {"x_cmd": setpoint.x_m}
    verdict, reading = codec.decode_feedback(frame)
    assert verdict == 0
    found = {"x_meas": reading.x_m, "f_meas": reading.f_n}
    return {role: value for role, value in found.items() if value is not None}


VENDOR = dbc_text(
    message_text(
        0x200,
        "SetValues",
        8,
        ' SG_ Enable : 0|2@1+ (1,0) [0|3] "" PC',
        ' SG_ Setpoint : 7|24@0- (0.5,0) [-50000|50000] "um" PC'.replace("7|24", "15|24"),
        ' SG_ Alive : 32|8@1+ (1,0) [0|255] "" PC',
    ),
    message_text(
        0x300,
        "ActualValues",
        8,
        ' SG_ Position : 0|24@1- (0.5,0) [-60000|60000] "um" PC',
        ' SG_ Load : 24|16@1- (2,0) [0|0] "N" PC',
        ' SG_ Count : 48|16@1+ (1,0) [0|65535] "" PC',
    ),
    tail="\n".join(
        [
            'BA_DEF_ SG_ "GenSigStartValue" INT 0 255;',
            'BA_DEF_DEF_ "GenSigStartValue" 0;',
            'BA_ "GenSigStartValue" SG_ 512 Enable 3;',
            'VAL_ 768 Load -32768 "not_a_number" ;',
        ]
    ),
)
VENDOR_NAMES = {
    "x_cmd": "Setpoint",
    "seq": "Alive",
    "x_meas": "ActualValues.Position",
    "f_meas": "Load",
    "count": "Count",
}


@pytest.fixture
def vendor(tmp_path: Path) -> wire.Codec:
    path = tmp_path / "vendor.dbc"
    path.write_text(VENDOR, encoding="ascii")
    return dbc.load(path, VENDOR_NAMES)


def test_drive_of_another_make_is_driven_by_its_own_names_and_units(vendor: wire.Codec) -> None:
    frame, sent_m = vendor.encode_setpoint(Setpoint(-0.0123, 300))
    decoded = cantools.database.load_string(VENDOR).decode_message(frame.id, frame.data)
    assert decoded == {"Enable": 3, "Setpoint": -12300.0, "Alive": 300 & 255}
    assert sent_m == pytest.approx(-0.0123, abs=1e-15)
    assert vendor.feedback_ids == (0x300,)


def test_range_in_the_dbc_bounds_commands_and_readings(vendor: wire.Codec) -> None:
    assert vendor.encode_setpoint(Setpoint(0.08))[1] == pytest.approx(0.05)
    w = Wire(vendor)
    good = vendor.encode_feedback(Reading(0.0, 10.0, count=1))[0]
    beyond = bytearray(good.data)
    beyond[0:3] = (120002).to_bytes(3, "little")
    assert receive(w, Frame(0x300, bytes(beyond))) == [["range"]]
    assert core.status_names(w.take().lost) == ["out_of_range"]
    assert receive(w, good) == [["pair"]]
    assert w.take().delay is None  # this drive has no echo


@pytest.mark.parametrize("name", ["can", "serial"])
@given(x=st.integers(-MOST, MOST), f=st.integers(-MOST, MOST))
def test_what_our_own_frames_hold_is_taken_to_the_last_bit(name: str, x: int, f: int) -> None:
    codec, w = CODECS[name], Wire(CODECS[name])
    for frame in codec.encode_feedback(Reading(x * 1e-9, f * 1e-3, count=1)):
        if codec.is_serial:
            w.feed(frame.data)
        else:
            w.receive(frame)
    taken = w.take()
    assert (taken.x_m, taken.f_n) == (x * 1e-9, f * 1e-3)


FLOATS = dbc_text(
    message_text(
        0x200,
        "SetValues",
        8,
        ' SG_ Setpoint : 0|32@1- (1,0) [0|0] "m" PC',
        ' SG_ Alive : 32|8@1+ (1,0) [0|255] "" PC',
    ),
    message_text(
        0x300,
        "ActualValues",
        12,
        ' SG_ Position : 0|32@1- (1,0) [0|0] "m" PC',
        ' SG_ Load : 32|32@1- (1,0) [0|0] "N" PC',
        ' SG_ Count : 64|16@1+ (1,0) [0|65535] "" PC',
    ),
    tail="""SIG_VALTYPE_ 512 Setpoint : 1;
SIG_VALTYPE_ 768 Position : 1;
SIG_VALTYPE_ 768 Load : 1;""",
)


@given(x_m=st.floats(-4.0, 4.0, width=32), f_n=st.floats(-4e6, 4e6, width=32))
def test_reading_finer_than_our_own_frames_is_taken_to_the_last_bit(x_m: float, f_n: float) -> None:
    codec = float_codec()
    w = Wire(codec)
    w.receive(codec.encode_feedback(Reading(x_m, f_n, count=1))[0])
    taken = w.take()
    assert (taken.x_m, taken.f_n) == (x_m, f_n)


@functools.cache
def float_codec() -> wire.Codec:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "floats.dbc"
        path.write_text(FLOATS, encoding="ascii")
        return dbc.load(path, VENDOR_NAMES)


def test_value_named_not_a_number_is_none_in_any_dbc(vendor: wire.Codec) -> None:
    frame = vendor.encode_feedback(Reading(0.0, math.nan, count=1))[0]
    assert frame.data[3:5] == b"\x00\x80"
    assert names(vendor.decode_feedback(frame)[0]) == ["not_finite"]
    with pytest.raises(core.CoreError, match="not finite"):
        vendor.encode_feedback(Reading(math.nan, 0.0, count=1))


def test_float_signal_that_is_nan_or_infinite_is_not_taken(tmp_path: Path) -> None:
    text = OWN_DBC.read_text(encoding="utf-8").replace("32@1- (0.001,0)", "32@1- (1,0)")
    text = re.sub(r"VAL_ 386 .*", "SIG_VALTYPE_ 386 f_meas : 1;", text)
    text = text.replace("[-2147483.647|2147483.647]", "[0|0]")
    path = tmp_path / "float.dbc"
    path.write_text(text, encoding="utf-8")
    codec = dbc.load(path)
    for value in (math.nan, math.inf, -math.inf):
        body = struct.pack("<f", value) + b"\0\1\0"
        frame = Frame(wire.LC_FB, body + bytes([crc8(b"\x82" + body)]))
        assert names(codec.decode_feedback(frame)[0]) == ["not_finite"]
    (_, frame) = codec.encode_feedback(Reading(0.0, math.nan))
    assert math.isnan(struct.unpack("<f", frame.data[:4])[0])


OWN_TEXT = OWN_DBC.read_text(encoding="utf-8").split('CM_ "')[0]
"""Without comments and value tables, which would name what a fault has taken away."""

FAULTS = {
    "no command": (r" SG_ x_cmd .*\n", "", "x_cmd: no signal of this name"),
    "misspelt": ("f_meas", "fmeas", "did you mean fmeas?"),
    "no seq": (r" SG_ seq .*\n", "", "ACT_CMD.seq: is missing"),
    "no count": (r"(LC_FB.*\n.*\n.*\n) SG_ count .*\n", r"\1", "LC_FB.count: is missing"),
    "unit": (r'"N" CONTROLLER', '"mm" CONTROLLER', 'unit "mm"; the measured force needs a force'),
    "no unit": (r'"N" CONTROLLER', '"" CONTROLLER', 'found the unit ""'),
    "unknown unit": (r'"N" CONTROLLER', '"furlong" CONTROLLER', '"furlong" is not known'),
    "signed count": (r"count : 40\|8@1\+", "count : 40|8@1-", "must be unsigned"),
    "few bits": (
        r"seq : 32\|16",
        "seq : 32|3",
        "found 3 bits; the command's sequence number has 4",
    ),
    "short count": (
        r"(LC_FB.*\n.*\n.*\n SG_ count : 40)\|8",
        r"\1|4",
        "LC_FB.count: found 4 bits; the drive's count of samples has 5 to 32",
    ),
    "wide": (r"x_cmd : 0\|32@1- (.*)\n.*\n.*\n", r"x_cmd : 0|54@1- \1\n", "1 to 53"),
    "crc place": (
        r"state : 48\|8(.*)\n SG_ crc8 : 56",
        r"state : 48|4\1\n SG_ crc8 : 52",
        "a whole byte is needed",
    ),
    "crc size": (r"crc8 : 56\|8", "crc8 : 56|7", "a whole byte is needed"),
    "factor": (r"x_meas : 0\|32@1- \(1E-009", "x_meas : 0|32@1- (0", "factor"),
    "multiplexed": (r"seq( .*\n SG_ state)", r"seq M\1 m0", "is multiplexed"),
    "length": ("ACT_CMD: 8", "ACT_CMD: 9", "found 9 bytes"),
    "range": (r"f_meas (.*)\[.*\]", r"f_meas \1[1e9|2e9]", "found 32 bits for [1000000000"),
    "outside": (r"crc8 : 56\|8", "crc8 : 60|8", "is not a DBC file that cantools can read"),
    "two frames": ("f_meas : 0", "x_meas : 0", "x_meas: the measured displacement is ambiguous"),
    "one frame": (r"BO_ 385 .*\n( SG_ x_meas : )0\|32(.*)\n(.*\n){4}", "", "x_meas: no signal"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_dbc_that_cannot_serve_is_refused_with_the_reason(case: str, tmp_path: Path) -> None:
    pattern, replacement, message = FAULTS[case]
    text, n = re.subn(pattern, replacement, OWN_TEXT)
    assert n
    path = tmp_path / "faulty.dbc"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        dbc.load(path)
    assert message in str(caught.value)
    assert str(caught.value).startswith(("faulty.dbc", str(path)))


def test_all_faults_of_a_dbc_are_named_at_once(tmp_path: Path) -> None:
    path = tmp_path / "faulty.dbc"
    text = OWN_TEXT.replace("seq :", "number :").replace('"N"', '"kg"').replace("x_meas", "pos")
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        dbc.load(path, {"speed": "v", "status": "nowhere"})
    where = [problem.where for problem in caught.value.problems]
    assert where == [
        "faulty.dbc",
        "faulty.dbc: ACT_CMD.seq",
        "faulty.dbc: x_meas",
        "faulty.dbc: LC_FB.f_meas",
        "faulty.dbc: nowhere",
    ]


def test_command_and_feedback_in_one_frame_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "one.dbc"
    path.write_text(VENDOR, encoding="ascii")
    with pytest.raises(InputError, match="each needs a frame of its own"):
        dbc.load(path, VENDOR_NAMES | {"x_meas": "Setpoint"})


@pytest.mark.parametrize(
    "content", [b"", b"\xff\xfe\x00", b"BO_ 1 nonsense", OWN_TEXT.encode()[:500]]
)
def test_file_that_is_no_dbc_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "not.dbc"
    path.write_bytes(content)
    with pytest.raises(InputError):
        dbc.load(path)
    with pytest.raises(InputError, match="cannot be read"):
        dbc.load(tmp_path)


def test_missing_cantools_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "cantools", None)
    with pytest.raises(InputError, match=r"pip install 'rthyb-rt\[wire\]'"):
        dbc.load(OWN_DBC)


@pytest.mark.parametrize(
    ("part", "change"),
    [
        ("command", {"length": 9}),
        ("command", {"length": 12}),
        ("command", {"id": 0x800}),
        ("command", {"id": wire.ACT_FB}),
        ("force", {"crc_at": 8}),
        ("force", {"crc_at": -2}),
    ],
)
def test_table_that_does_not_fit_is_refused_by_the_core(part: str, change: dict[str, int]) -> None:
    struct_ = ffi.new("rthyb_codec *", CODECS["own dbc"].struct[0])
    for key, value in change.items():
        setattr(getattr(struct_, part), key, value)
    with pytest.raises(core.CoreError):
        wire.Codec(struct_)


@pytest.mark.parametrize(
    "change",
    [
        {"start": 33},
        {"start": -1},
        {"length": 0},
        {"length": 54},
        {"kind": 3},
        {"kind": 2, "length": 31},
        {"scale": 0.0},
        {"scale": math.nan},
        {"offset": math.inf},
        {"big_endian": 1, "start": 48},
        {"low": 1e12},
    ],
)
def test_signal_that_does_not_fit_is_refused_by_the_core(change: dict[str, float]) -> None:
    struct_ = ffi.new("rthyb_codec *", CODECS["own dbc"].struct[0])
    for key, value in change.items():
        setattr(struct_.displacement.field[0], key, value)
    with pytest.raises(core.CoreError):
        wire.Codec(struct_)


# ---- the guide ----------------------------------------------------------------------------------

PAGE = (ROOT / "docs" / "wire.md").read_text(encoding="utf-8")


def test_example_bytes_of_the_guide_are_those_of_the_codecs() -> None:
    setpoint = Setpoint(1e-3, 1, core.STATES.index("RUNNING"))
    frame, _ = CODECS["can"].encode_setpoint(setpoint)
    assert f"`{frame.id:X}#{frame.data.hex().upper()}`" in PAGE
    line, _ = CODECS["serial"].encode_setpoint(setpoint)
    assert f"`{line.data.hex(' ').upper()}`" in PAGE


def test_guide_lists_every_signal_with_whether_it_is_needed() -> None:
    rows = dict(re.findall(r"^\| `(\w+)` \| (?:the|a|each)[^|]*\| (yes|no)", PAGE, re.MULTILINE))
    assert rows == {name: "yes" if role.least_bits else "no" for name, role in dbc.ROLES.items()}


def test_messages_of_the_guide_are_those_of_the_loader(tmp_path: Path) -> None:
    path = tmp_path / "drive.dbc"
    text = VENDOR.replace("(2,0)", "(0.01,0)").replace('"N"', '"mm"').replace("Alive", "Life")
    path.write_text(text, encoding="ascii")
    with pytest.raises(InputError) as caught:
        dbc.load(path, {role: name for role, name in VENDOR_NAMES.items() if role != "seq"})
    assert str(caught.value) in PAGE
    block, _ = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    path.write_text(VENDOR, encoding="ascii")
    made: dict[str, Any] = {}
    exec(block.replace('"drive.dbc"', repr(str(path))), made)
    assert made["codec"].feedback_ids == (0x300,)


# ---- the core's promises ------------------------------------------------------------------------

SOURCES = [ROOT / "csrc" / name for name in ("framing.c", "codec.c", "wire.c")]


def compiled(*arguments: str | Path) -> None:
    command = ["gcc", "-std=c11", f"-I{ROOT / 'csrc'}", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_a_million_frames_of_all_kinds_break_nothing(tmp_path: Path) -> None:
    """The invariants are in tests/fuzz/fuzz_wire.c; built with ASan and UBSan."""
    program = tmp_path / "fuzz_wire"
    sanitizers = "-fsanitize=address,undefined,float-cast-overflow"
    alone = ["-DRTHYB_FUZZ_ALONE", ROOT / "tests" / "fuzz" / "fuzz_wire.c"]
    compiled(
        "-O1", "-g", sanitizers, "-fno-sanitize-recover=all", *alone, *SOURCES, "-lm", "-o", program
    )
    done = subprocess.run(
        [program, "8000", "20121"], capture_output=True, text=True, timeout=120, check=False, env={}
    )
    assert done.returncode == 0, done.stderr
    frames, pairs = map(int, done.stdout.split())
    assert frames > 1_000_000
    assert pairs > 100_000


def test_wire_asks_nothing_of_the_system_and_keeps_no_global(tmp_path: Path) -> None:
    defined, needed = set(), set()
    for source in SOURCES:
        target = tmp_path / f"{source.stem}.o"
        compiled("-O3", "-fno-pic", "-fno-stack-protector", "-c", source, "-o", target)
        listing = subprocess.run(["nm", target], capture_output=True, text=True, check=True)
        for line in listing.stdout.splitlines():
            kind, name = line.split()[-2:]
            assert kind in "TtrRU", line
            (needed if kind == "U" else defined).add(name)
    outside = needed - defined
    assert outside <= {
        "memcpy",
        "memset",
        "memcmp",
        "memmove",
        "lrint",
        "llrint",
        "nextafterf",
        "ldexp",
        "fmin",
        "fmax",
    }
