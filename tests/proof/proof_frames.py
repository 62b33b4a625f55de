"""A storm of a million bad frames during a test changes nothing but the counters.

Two tests side by side on the stepped clock, one in the storm: their records are identical to the
last bit. The bad frames are genuine ones with flipped bits, random ones with our identifiers,
frames with other identifiers and of a wrong length. An independent CRC decides which must be
rejected.
"""

from __future__ import annotations

import os
import socket
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from proof import structure
from proof.conftest import Note

from rthyb_rt import core
from rthyb_rt.core import loop, wire

FRAMES = 1_000_000
A_TICK = 140
TICKS = FRAMES // A_TICK + 1
OURS = (wire.ACT_FB, wire.LC_FB)
FEEDBACK_TYPE, FEEDBACK_BYTES = 0x81, 12
"""First byte and length of a feedback on the serial line, without its CRC."""
CAN_FRAME = struct.Struct("=IB3x8s")


def crc8(ids: np.ndarray, data: np.ndarray) -> np.ndarray:
    """CRC-8/SAE-J1850 of the low byte of the identifier and the bytes, (n,) and (n, 7) -> (n,)."""
    crc = np.full(ids.size, 0xFF, np.uint8)
    for column in (ids.astype(np.uint8), *data.T):
        crc ^= column
        for _ in range(8):
            crc = np.where(crc & 0x80, (crc << 1) ^ 0x1D, crc << 1).astype(np.uint8)
    return crc ^ 0xFF


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def genuine_can(chance: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Identifiers and bytes of frames that a drive would send, (n,) and (n, 8)."""
    ids = chance.choice(OURS, n).astype(np.uint32)
    data = chance.integers(0, 256, (n, 8), np.uint8)
    data[:, :4] = chance.integers(-(10**7), 10**7, n).astype("<i4").view(np.uint8).reshape(n, 4)
    data[:, 6] = 0
    data[:, 7] = crc8(ids, data[:, :7])
    return ids, data


def bad_can(n: int) -> tuple[list[bytes], dict[str, int]]:
    """Return n packets that every controller must reject, and the number of each kind."""
    chance = np.random.default_rng(1)
    ids, data = genuine_can(chance, n)
    lengths = np.full(n, 8)
    kind = chance.choice(4, n, p=(0.5, 0.2, 0.2, 0.1))
    turned, random, strange, cut = (kind == k for k in range(4))
    for _ in range(3):  # one to three bits, or the same bit twice, in which case it is fixed below
        bit = chance.integers(0, 64, n)
        data[turned, bit[turned] // 8] ^= (1 << (bit[turned] % 8)).astype(np.uint8)
    data[random] = chance.integers(0, 256, (int(random.sum()), 8), np.uint8)
    lengths[cut] = chance.choice([0, 1, 4, 7, 9, 64, 255], int(cut.sum()))
    ids[strange] = chance.integers(0, 1 << 11, int(strange.sum()))
    ids[strange & np.isin(ids, OURS)] = 0x7FF
    damaged = turned | random
    whole = damaged & (data[:, 7] == crc8(ids, data[:, :7]))
    data[whole, 7] ^= 0x55
    packets = [
        CAN_FRAME.pack(i, length, row.tobytes())
        for i, length, row in zip(ids.tolist(), lengths.tolist(), data, strict=True)
    ]
    counted = {"bad_crc": damaged, "other_id": strange, "bad_length": cut}
    return packets, {name: int(mask.sum()) for name, mask in counted.items()}


def cobs(data: bytes) -> bytes:
    """Consistent overhead byte stuffing, with the 0 that ends the packet."""
    return b"".join(bytes([len(part) + 1]) + part for part in data.split(b"\0")) + b"\0"


def bad_serial(n: int) -> tuple[list[bytes], dict[str, int]]:
    """Return n packets that every controller must reject, and the number of each kind."""
    chance = np.random.default_rng(2)
    body = chance.integers(0, 256, (n, FEEDBACK_BYTES), np.uint8)
    wrong = chance.integers(1, 1 << 16, n)
    size = chance.integers(1, FEEDBACK_BYTES + 1, n)
    genuine = chance.random(n) < 0.5
    body[genuine, 0], size[genuine] = FEEDBACK_TYPE, FEEDBACK_BYTES
    bits = chance.integers(0, 8 * (FEEDBACK_BYTES + 2), (n, 3))
    packets = []
    for i, (row, length) in enumerate(zip(body, size.tolist(), strict=True)):
        data = bytearray(row[:length].tobytes())
        crc = crc16(bytes(data)) ^ (0 if genuine[i] else int(wrong[i]))
        data += crc.to_bytes(2, "little")
        for bit in set(bits[i].tolist()) if genuine[i] else ():
            data[bit // 8] ^= 1 << (bit % 8)
        packets.append(cobs(bytes(data)))
    return packets, {"bad_crc": n}


class Pair:
    """Controller and drive in lockstep over a socket pair without delay."""

    def __init__(self, medium: str) -> None:
        stream = medium == "serial"
        kind: loop.Kind = "stream" if stream else "can"
        codec = wire.serial() if stream else wire.can()
        family = socket.SOCK_STREAM if stream else socket.SOCK_SEQPACKET
        self._ends = socket.socketpair(socket.AF_UNIX, family)
        for end in self._ends:
            end.setblocking(False)
        links = [loop.Link(kind, end.fileno()) for end in self._ends]
        self.station = core.Station(structure.station(), structure.shaking(TICKS / 1024 + 2.0))
        self.wire = wire.Wire(codec)
        self.loop = loop.Loop(self.station, self.wire, links[0])
        self.drive = loop.Drive(structure.rig(), codec, links[1], log_ticks=TICKS + 4096)
        self.parts: list[np.ndarray] = []

    def step(self, storm: list[bytes], command: core.Command = "none") -> None:
        """One tick; half of the storm arrives before the drive's frames, half after."""
        far, half = self._ends[1].fileno(), len(storm) // 2
        for packet in storm[:half]:
            os.write(far, packet)
        self.drive.tick()
        for packet in storm[half:]:
            os.write(far, packet)
        if command != "none":
            self.loop.command(command)
        self.loop.beat()
        self.loop.step()
        self.parts.append(self.loop.records)

    def close(self) -> None:
        """Close the socket pair."""
        for end in self._ends:
            end.close()


@pytest.fixture(params=["can", "serial"])
def medium(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def pairs(medium: str) -> Iterator[tuple[Pair, Pair]]:
    """One pair for the storm, one for comparison."""
    made = Pair(medium), Pair(medium)
    yield made
    for pair in made:
        pair.close()


def script(tick: int) -> core.Command:
    """Run a test from tick 400 to the end."""
    commands: dict[int, Any] = {5: "zero", 90: "arm", 95: "start"}
    return commands.get(tick, "none")


MAKERS: dict[str, Callable[[int], tuple[list[bytes], dict[str, int]]]] = {
    "can": bad_can,
    "serial": bad_serial,
}


def test_a_million_bad_frames_change_no_bit_of_any_record(
    pairs: tuple[Pair, Pair], medium: str, note: Note
) -> None:
    packets, expected = MAKERS[medium](FRAMES)
    stormy, calm = pairs
    begin = time.monotonic()
    for tick in range(TICKS):
        storm = packets[tick * A_TICK : (tick + 1) * A_TICK]
        stormy.step(storm, script(tick))
        calm.step([], script(tick))
    rows, other = (np.concatenate(pair.parts) for pair in pairs)
    assert rows.tobytes() == other.tobytes()
    assert stormy.drive.log.tobytes() == calm.drive.log.tobytes()
    assert stormy.loop.state == "RUNNING"
    assert np.ptp(rows["x_meas_m"]) > 1e-3
    found, plain = stormy.wire.counters(), calm.wire.counters()
    extra = {name: found[name] - plain[name] for name in found if found[name] != plain[name]}
    assert extra.pop("frames") == FRAMES
    assert extra == expected
    note("storm", f"{medium}: bad frames", FRAMES, "", "no bit of a record changed")
    note("storm", f"{medium}: a frame", (time.monotonic() - begin) / FRAMES * 1e6, "us")
