"""Real-time recordings: what a PC or a drive that stalls does to the rows is undone."""

from __future__ import annotations

from dataclasses import dataclass, field

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from rthyb_rt.core import FLAGS
from rthyb_rt.diagnose import drive_clock, reading

BLIND, LOST, DRIVE_STALLS = "the PC stalls", "a pair is lost", "the drive stalls"
"""What may happen in a tick. Commands that are sent while the drive stalls wait for it."""


@dataclass
class Session:
    """A PC and a drive, tick by tick: what was recorded, and what the drive did."""

    tick: list[int] = field(default_factory=list)
    count: list[int] = field(default_factory=list)
    echo: list[int] = field(default_factory=list)
    arrived: list[bool] = field(default_factory=list)
    sent: list[bool] = field(default_factory=list)
    followed: list[int] = field(default_factory=list)  # row of the command, for each sample

    @staticmethod
    def of(events: list[str], bits: int = 8) -> Session:
        """The drive samples once a tick; what it reads in row n was sent in row n or before."""
        out, waiting, newest, numbers = Session(), [], 0, 0
        for row, event in enumerate(events):
            out.tick.append(1000 + row)
            out.sent.append(event != BLIND)
            if event != BLIND:
                numbers += 1
                waiting.append((numbers, row))
            samples = event != DRIVE_STALLS
            if samples and waiting:
                newest, place = waiting.pop(0)
            if samples:
                out.followed.append(place)
            arrived = samples and event not in (LOST, BLIND)
            out.arrived.append(arrived)
            out.count.append((70 + len(out.followed)) % (1 << bits) if arrived else 0)
            out.echo.append((30 + newest) % (1 << bits) if arrived else 0)
        return out

    def clock(self) -> drive_clock.DriveClock | None:
        ints = [np.array(a, dtype=np.int64) for a in (self.tick, self.count, self.echo)]
        return drive_clock.drive_clock(*ints, np.array(self.arrived), np.array(self.sent))


def stalled() -> list[str]:
    """Half a second with each kind of stall, and lost pairs beside them."""
    events = ["" for _ in range(600)]
    events[40:43] = [LOST] * 3
    events[100:106] = [BLIND] * 6
    events[200:205] = [DRIVE_STALLS] * 5
    events[400:404] = [BLIND] * 4
    return events


@pytest.mark.parametrize("bits", [8, 16])
def test_without_stalls_nothing_changes(bits: int) -> None:
    events = ["" for _ in range(900)]
    events[50:53] = [LOST] * 3
    assert Session.of(events, bits).clock() is None


@pytest.mark.parametrize("bits", [8, 16])
def test_a_drive_that_stalls_is_followed_in_its_own_time(bits: int) -> None:
    session = Session.of(stalled(), bits)
    clock = session.clock()
    assert clock is not None
    # It is that of the drive: a PC that stalls beside a running drive shifts nothing.
    assert clock.shifts == 1
    assert clock.measured.size == len(session.followed)
    shown = np.flatnonzero(clock.measured >= 0)
    low = np.array(session.count)[clock.measured[shown]]
    assert np.array_equal((low - 71 - shown) % (1 << bits), np.zeros(shown.size))
    assert np.array_equal(clock.commanded[shown], np.array(session.followed)[shown])


@hypothesis.given(
    st.lists(st.tuples(st.integers(5, 390), st.integers(1, 6),
                       st.sampled_from([BLIND, LOST, DRIVE_STALLS])), max_size=5),
)  # fmt: skip
def test_readings_and_commands_are_where_the_drive_had_them(
    stalls: list[tuple[int, int, str]],
) -> None:
    events = ["" for _ in range(400)]
    for first, length, what in stalls:
        events[first : first + length] = [what] * len(events[first : first + length])
    session = Session.of(events)
    clock = session.clock()
    if clock is None:
        assert len(session.followed) == len(events) or len(set(events)) == 1
        return
    shown = np.flatnonzero(clock.measured >= 0)
    low = np.array(session.count)[clock.measured[shown]]
    assert np.array_equal((low - 71 - shown) % 256, np.zeros(shown.size))
    assert np.array_equal(clock.commanded[shown], np.array(session.followed)[shown])


@pytest.mark.parametrize(
    "count", [np.zeros(300), 2 * np.arange(300), np.arange(300) // 4, np.full(300, 7)],
    ids=["none", "every other", "every fourth", "stuck"],
)  # fmt: skip
def test_a_count_that_does_not_number_samples_is_not_used(count: np.ndarray) -> None:
    tick, all_of_them = np.arange(300), np.ones(300, dtype=np.bool_)
    low = count.astype(np.int64) % 256
    assert drive_clock.drive_clock(tick, low, low, all_of_them, all_of_them) is None


def test_a_recording_with_stalls_is_read_in_the_time_of_the_drive() -> None:
    """A sine that a stall interrupts in the rows is whole again, and a note says so."""
    session = Session.of(stalled())
    n = len(session.tick)
    t = np.arange(n) / 1024.0
    flags = np.where(np.array(session.arrived), 1, FLAGS["predicted"])
    flags = np.where(np.array(session.sent), flags, flags | FLAGS["blind"]).astype(np.uint32)
    kinds = [("tick", "<u8"), ("flags", "<u4"), ("count", "<u2"), ("echo", "<u2")]
    samples = np.array(
        list(zip(session.tick, flags, session.count, session.echo, strict=True)), kinds
    )

    class Recorded:
        fs_hz = 1024.0

        def __init__(self) -> None:
            self.samples = samples

        def running(self) -> np.ndarray:
            return np.ones(n, dtype=np.bool_)

    sample_of = np.cumsum([e != DRIVE_STALLS for e in stalled()]) - 1
    moved = np.sin(2 * np.pi * 5.0 * sample_of / 1024.0)
    measured = np.where(session.arrived, moved, np.nan)
    channels = {"x_meas": measured, "f_meas": 3.0 * measured, "x_cmd": np.arange(n, dtype=float)}
    notes: list[str] = []
    time, placed = reading._by_the_drive(Recorded(), None, t, channels, set(), notes)
    good = np.isfinite(placed["x_meas"])
    assert good.sum() == sum(session.arrived)
    assert placed["x_meas"][good] == pytest.approx(np.sin(2 * np.pi * 5.0 * time[good]), abs=1e-12)
    assert np.array_equal(placed["f_meas"][good], 3.0 * placed["x_meas"][good])
    assert np.array_equal(placed["x_cmd"][good], np.array(session.followed)[good])
    assert len(notes) == 1
    assert "shifted once" in notes[0]
