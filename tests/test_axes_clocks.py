"""Two drives on one clock or on two: what ARM accepts, what trips, and which axis is named."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace

import pytest
from axes_bench import FLAGS, NAMES, config
from test_axes_loop import Lab

from rthyb_rt import core

EITHER = pytest.mark.parametrize("axis", [0, 1], ids=NAMES)


@pytest.fixture
def owned() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def zeroed(owned: ExitStack) -> Lab:
    lab = Lab(owned)
    for _ in range(5):
        lab.step()
    lab.step("zero")
    lab.until("ZEROED")
    return lab


def refused(lab: Lab, command: core.Command) -> bool:
    lab.step(command)
    return bool(lab.rows[-1]["flags"][-1] & FLAGS["refused"])


def drift(lab: Lab, axis: int, ticks: int, every: int) -> None:
    """The clock of one drive gains a sample in so many ticks."""
    for n in range(1, ticks + 1):
        if n % every == 0:
            lab.drives.drives[axis]._c.tick += 1
        lab.step()


@EITHER
def test_arm_is_refused_to_a_drive_whose_clock_has_drifted_since_it_was_heard_first(
    axis: int, owned: ExitStack
) -> None:
    lab = zeroed(owned)
    drift(lab, axis, 700, 300)
    assert lab.loop.state == "ZEROED"
    assert refused(lab, "arm")
    assert lab.loop.state == "ZEROED"
    name, ticks, most = lab.station.refusal
    assert (name, most) == ("apart", 20.0)
    assert ticks >= 20.0
    assert lab.station.refusal_axis == axis
    lab.assert_replays()


@EITHER
def test_zero_makes_no_one_clock_of_two(axis: int, owned: ExitStack) -> None:
    """The tare lasts a second at most: two clocks look like one meanwhile."""
    lab = zeroed(owned)
    drift(lab, axis, 700, 300)
    lab.step("zero")
    lab.until("ZEROED")
    assert refused(lab, "arm")
    assert lab.station.refusal_axis == axis


@EITHER
def test_drives_that_come_apart_while_armed_trip_and_the_cause_names_the_axis(
    axis: int, owned: ExitStack
) -> None:
    lab = zeroed(owned)
    lab.step("arm")
    lab.drives.drives[axis]._c.tick += 2
    states = [lab.step() for _ in range(25)]
    assert states.index("TRIPPED") in (19, 20)
    assert (lab.loop.cause, lab.station.cause_axis) == ("apart", axis)
    lab.assert_replays()


@EITHER
def test_a_clock_that_drifts_during_the_test_trips_it(axis: int, owned: ExitStack) -> None:
    """Sample by sample, each of them by itself no more than jitter."""
    lab = Lab(owned, seconds=4.0).running()
    drift(lab, axis, 1000, 400)
    assert lab.loop.state == "TRIPPED"
    assert (lab.loop.cause, lab.station.cause_axis) == ("apart", axis)


@EITHER
def test_after_a_trip_and_a_reset_the_clocks_are_compared_anew(axis: int, owned: ExitStack) -> None:
    lab = zeroed(owned)
    lab.step("arm")
    lab.drives.drives[axis]._c.tick += 7
    lab.until("TRIPPED")
    for _ in range(60):
        lab.step()
    assert not refused(lab, "reset")
    for _ in range(20):
        lab.step()
    lab.step("zero")
    lab.until("ZEROED")
    assert not refused(lab, "arm")
    for _ in range(100):
        assert lab.step() == "ARMED"
    lab.assert_replays()


@EITHER
def test_a_drive_that_was_switched_on_again_at_rest_begins_its_count_anew(
    axis: int, owned: ExitStack
) -> None:
    lab = Lab(owned)
    for _ in range(100):
        lab.step()
    lab.fault(axis, "silence", 40)
    for _ in range(40):
        lab.step()
    lab.drives.drives[axis]._c.tick += 77
    for _ in range(100):
        lab.step()
    lab.step("reset")  # silent for 40 ticks, it has heard none either
    for _ in range(30):
        lab.step()
    lab.step("zero")
    lab.until("ZEROED")
    assert not refused(lab, "arm")


@EITHER
@pytest.mark.parametrize("first", [1, -1])
def test_one_late_sample_when_the_drives_are_heard_first_is_no_measure_of_the_rest(
    axis: int, first: int, owned: ExitStack
) -> None:
    """The counts may be one apart either way from what they are as a rule."""
    lab = Lab(owned)
    count = lab.drives.drives[axis]._c
    count.tick += 1000 + first
    for _ in range(2):
        lab.step()
    count.tick -= first  # the jitter of the first two ticks is over
    for _ in range(100):
        lab.step()
    lab.step("zero")
    lab.until("ZEROED")
    count.tick -= first
    for _ in range(60):
        lab.step()
    assert not refused(lab, "arm")
    for _ in range(60):
        assert lab.step() == "ARMED"


def test_arm_waits_until_the_clocks_have_been_compared(owned: ExitStack) -> None:
    """Nothing is known of them before the first 64 ticks with a pair of every axis."""
    lab = Lab(owned, replace(config(), tare_ticks=4))
    for _ in range(5):
        lab.step()
    lab.step("zero")
    lab.until("ZEROED")
    assert refused(lab, "arm")
    assert lab.station.refusal == ("apart", 0.0, 20.0)
    assert lab.station.refusal_axis is None
    for _ in range(64):
        lab.step()
    assert not refused(lab, "arm")
    lab.assert_replays()
