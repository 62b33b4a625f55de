"""A recording of the tick through a fresh station: the same rows to the last byte.

Controller and drive run in lockstep on the stepped clock, with everything that the tick can meet;
what they wrote down is then the only input of the second pass.
"""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import loop_bench
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from link_tools import users_table
from loop_bench import FLAGS, K_N_PER_M, Bench, watched

from rthyb_rt import core
from rthyb_rt.core import loop, wire

MOUNTED = core.WireCalibration(
    x_gain=-2.0, x_offset_m=0.004, f_gain=-0.5, f_offset_n=12.0, cmd_gain=-0.5, cmd_offset_m=0.002
)

FLOATS = """VERSION ""
NS_ :
BS_:
BU_: PC
BO_ 512 SetValues: 8 PC
 SG_ x_cmd : 0|32@1- (1,0) [0|0] "m" PC
 SG_ seq : 32|8@1+ (1,0) [0|255] "" PC
 SG_ state : 40|8@1+ (1,0) [0|255] "" PC
 SG_ crc8 : 56|8@1+ (1,0) [0|255] "" PC

BO_ 768 ActualValues: 12 PC
 SG_ x_meas : 0|32@1- (1,0) [0|0] "m" PC
 SG_ f_meas : 32|32@1- (1,0) [0|0] "N" PC
 SG_ count : 64|8@1+ (1,0) [0|255] "" PC
 SG_ status : 72|8@1+ (1,0) [0|255] "" PC
 SG_ echo : 80|8@1+ (1,0) [0|255] "" PC
 SG_ crc8 : 88|8@1+ (1,0) [0|255] "" PC

VAL_ 512 state 11 "RESET" 12 "LEAVING" ;
SIG_VALTYPE_ 512 x_cmd : 1;
SIG_VALTYPE_ 768 x_meas : 1;
SIG_VALTYPE_ 768 f_meas : 1;
"""


@pytest.fixture(scope="module")
def floats(tmp_path_factory: pytest.TempPathFactory) -> wire.Codec:
    """Frames of 32-bit floats, finer than a record near zero and coarser elsewhere."""
    return users_table(tmp_path_factory.mktemp("dbc"), FLOATS)


@pytest.fixture(scope="module")
def own_dbc(tmp_path_factory: pytest.TempPathFactory) -> wire.Codec:
    """The frames of hw/rthyb.dbc, as a user's own file describes them."""
    text = (Path(__file__).parents[1] / "hw" / "rthyb.dbc").read_text(encoding="ascii")
    return users_table(tmp_path_factory.mktemp("dbc"), text)


def replay(
    bench: Bench,
    rows: np.ndarray | None = None,
    parameters: list[tuple[int, core.Parameters]] | None = None,
) -> np.ndarray:
    assert bench.codec is not None
    return core.Station(bench.config, bench.ag).replay(
        bench.rows() if rows is None else rows,
        wire.Codec.of(bench.codec.table),  # as a recording holds it
        bench.calibration,
        parameters or [],
    )


def first_difference(recorded: np.ndarray, replayed: np.ndarray) -> int | None:
    """Index of the first row that differs by a bit or is missing; None: there is none."""
    differ = (bytes_of(recorded)[: replayed.size] != bytes_of(replayed)).any(axis=1)
    if differ.any():
        return int(np.argmax(differ))
    return None if replayed.size == recorded.size else int(replayed.size)


def bytes_of(rows: np.ndarray) -> np.ndarray:
    """Every field, (n, bytes), without what lies between fields."""
    packed = rows.astype(
        [(name, core.RECORD_DTYPE[name]) for name in core.RECORD_DTYPE.names or ()]
    )
    return packed.view(np.uint8).reshape(rows.size, packed.dtype.itemsize)


def assert_the_same(bench: Bench, **options: Any) -> None:
    rows, again = bench.rows(), replay(bench, **options)
    n = first_difference(rows, again)
    if n is None:
        return
    assert n < again.size, f"row {n} of {rows.size} did not come out"
    names = [name for name in core.RECORD_DTYPE.names or () if rows[n][name] != again[n][name]]
    pytest.fail(
        f"row {n}: " + ", ".join(f"{k} {rows[n][k]!r} became {again[n][k]!r}" for k in names)
    )


# ---- what a test can meet -----------------------------------------------------------------------


def to_the_end(bench: Bench) -> None:
    bench.running(0)
    bench.until("RAMP_OUT")
    bench.until("IDLE")
    bench.steps(20)


def with_faults(bench: Bench) -> None:
    bench.running()
    for kind, ticks, value in (
        ("drop", 2, 1.0),
        ("delay", 3, 2.0),
        ("duplicate", 2, 1.0),
        ("reorder", 4, 1.0),
        ("corrupt", 3, 1.0),
        ("drop", 15, 0.5),
        ("force", 1, 5e3),
        ("jump", 1, 0.05),
        ("stuck", 8, 1.0),
    ):
        bench.fault(kind, ticks, value)  # type: ignore[arg-type]
        bench.steps(30)
    bench.until("IDLE")


def with_skips(bench: Bench) -> None:
    bench.running()
    for skipped in (1, 3, 10, 0, 2):
        bench.step(skipped=skipped)
        bench.steps(7)
    bench.step(skipped=11)
    bench.until("IDLE")
    bench.steps(5)


def stalled(bench: Bench) -> None:
    bench.running()
    bench.step(skipped=60)
    bench.steps(60)
    bench.step("reset", skipped=5)
    bench.steps(1100)  # the skips of a second ago are forgotten
    bench.running(50)


def asleep_for_long(bench: Bench) -> None:
    bench.running()
    bench.step(skipped=3000)
    bench.steps(30)


def held_and_resumed(bench: Bench) -> None:
    bench.running(700)
    bench.step("hold")
    bench.step("resume")  # refused: it still brakes
    bench.steps(600)
    bench.step("resume", skipped=2)
    bench.until("RUNNING")
    bench.steps(200)
    bench.step("stop")
    bench.until("IDLE")


def tripped(bench: Bench) -> None:
    bench.running(500)
    bench.fault("not-finite", 1)
    bench.steps(40)
    bench.step("start")
    bench.step("reset")
    for _ in range(4):
        bench.step("zero")
    bench.steps(10)
    bench.running(300)
    bench.step("trip")
    bench.steps(30)


def without_link(bench: Bench) -> None:
    bench.running(400)
    bench.fault("silence", 30)
    bench.steps(40)
    bench.step("reset")
    bench.steps(20)


def unplugged(bench: Bench) -> None:
    bench.running(200)
    bench.unplug()
    bench.far.close()
    for _ in range(40):
        bench.tick()


def drive_stops(bench: Bench) -> None:
    bench.running(300)
    bench.fault("drop-command", 25)
    bench.steps(60)


def slipping(bench: Bench) -> None:
    bench.running()
    bench.drive_ticks()
    bench.steps(loop.SLIP_VOTES + 40)
    bench.tick()
    bench.steps(loop.SLIP_VOTES + 40)
    assert bench.loop.counters()["slips"] == 2


def silent_operator(bench: Bench) -> None:
    bench.running()
    for _ in range(loop.HEARTBEAT_TICKS + 40):
        bench.step(beat=False)
    bench.steps(20)


def armed_too_long(bench: Bench) -> None:
    bench.steps(8)
    bench.step("zero")
    bench.until("ZEROED")
    bench.step("arm")
    bench.until("ZEROED")
    bench.step("zero")
    bench.until("ZEROED")
    bench.step("stop")
    bench.steps(5)


SCRIPTS: list[Callable[[Bench], None]] = [
    to_the_end,
    with_faults,
    with_skips,
    stalled,
    asleep_for_long,
    held_and_resumed,
    tripped,
    without_link,
    unplugged,
    drive_stops,
    slipping,
    silent_operator,
    armed_too_long,
]
WATCHED = {
    "watches": {
        "sensor_jump": core.Watch(0.003, "indicate"),
        "position": core.Watch(0.05, "trip"),
        "tracking": core.Watch(0.004, "indicate"),
        "energy": core.Watch(1e4, "hold"),
    }
}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda f: f.__name__)
def test_every_row_comes_out_again_to_the_last_byte(script: Callable[[Bench], None]) -> None:
    with Bench(**WATCHED) as bench:
        script(bench)
        assert_the_same(bench)


@pytest.mark.parametrize("script", SCRIPTS[:7], ids=lambda f: f.__name__)
def test_so_it_does_behind_a_sensor_that_is_mounted_the_other_way_round(
    script: Callable[[Bench], None],
) -> None:
    with Bench(calibration=MOUNTED, **WATCHED) as bench:
        script(bench)
        assert_the_same(bench)


@pytest.mark.parametrize("script", SCRIPTS[:7], ids=lambda f: f.__name__)
@pytest.mark.parametrize("calibration", [core.IDENTITY, MOUNTED], ids=["as it is", "turned"])
def test_so_it_does_with_the_frames_of_any_dbc(
    script: Callable[[Bench], None], calibration: core.WireCalibration, floats: wire.Codec
) -> None:
    with Bench(codec=floats, calibration=calibration, **WATCHED) as bench:
        script(bench)
        assert_the_same(bench)


def test_so_it_does_over_a_serial_line() -> None:
    with Bench("pty") as bench:
        with_faults(bench)
        assert_the_same(bench)


def test_commands_that_did_not_leave_are_not_sent_again() -> None:
    with Bench(send_buffer=1) as bench:
        bench.running(700)
        for _ in range(15):  # the drive does not read meanwhile
            bench.tick()
        bench.steps(30)
        assert bench.loop.counters()["not_sent"] > 0
        assert_the_same(bench)


def test_test_that_stays_where_it_stops_is_replayed() -> None:
    with Bench(stay=True) as bench:
        bench.running(700)
        bench.step("stop")
        bench.until("IDLE")
        bench.running(300)
        assert_the_same(bench)


@pytest.mark.parametrize("name", ["position", "force", "tracking", "sensor_stuck"])
@pytest.mark.parametrize("reaction", core.REACTIONS)
def test_limits_act_again_as_they_did(name: str, reaction: core.Reaction) -> None:
    values = {"position": 5e-4, "force": 300.0, "tracking": 2e-4, "sensor_stuck": 20.0}
    with Bench(seconds=1.0, **watched(name, values[name], reaction)) as bench:
        bench.steps(8)
        for command in ("zero", "arm", "start"):
            bench.step(command)  # type: ignore[arg-type]
            bench.steps(70 if command == "zero" else 1)
        bench.steps(900)
        bench.fault("stuck", 200)
        bench.steps(400)
        assert_the_same(bench)


def test_parameters_that_changed_in_mid_run_change_again_where_they_did() -> None:
    with Bench(seconds=3.0) as bench:
        published = []
        bench.running(300)
        limited = {"acceleration_limit_m_per_s2": 50.0}
        first = dataclasses.replace(core.Parameters.of(bench.config), **limited)
        for changes in (
            {"adapt": False},
            {"velocity_limit_m_per_s": 0.004, "acceleration_limit_m_per_s2": 2.0},
            {"watches": {"position": core.Watch(4e-4, "ramp-out")}},
            {"path_velocity_m_per_s": 0.05},
        ):
            one = dataclasses.replace(first, **changes)  # type: ignore[arg-type]
            published.append((bench.loop.set_parameters(one), one))
            bench.step(skipped=2)
            bench.steps(150)
        bench.until("IDLE")
        bench.running(100)
        assert set(bench.rows()["generation"]) == {0, 1, 2, 3, 4}
        assert bench.loop.state == "RUNNING"
        assert_the_same(bench, parameters=published)
        n = first_difference(bench.rows(), replay(bench, parameters=published[:1]))
        assert n == int(np.argmax(bench.rows()["generation"] == 2))


KINDS = ["drop", "corrupt", "duplicate", "reorder", "jump", "delay", "not-finite", "stuck"]


@pytest.mark.long
@given(
    script=st.lists(
        st.tuples(
            st.sampled_from(core.COMMANDS),
            st.integers(0, 30),
            st.sampled_from(KINDS),
            st.integers(1, 30),
            st.integers(1, 120),
        ),
        max_size=10,
    )
)
@settings(max_examples=40, deadline=None)
def test_any_script_is_replayed(script: list[Any]) -> None:
    with Bench(seconds=0.5, tare_ticks=4, ramp_in_ticks=8, calibration=MOUNTED) as bench:
        bench.running(20)
        for command, skipped, kind, ticks, after in script:
            bench.fault(kind, ticks, 2.0)
            bench.step(command, skipped=skipped)
            bench.steps(after)
            if bench.loop.state == "ZEROED":
                bench.step("arm")
                bench.step("start")
        assert_the_same(bench)


def bad_day(bench: Bench, pick: random.Random) -> None:
    """Commands, faults and skips of every kind, drawn by lot."""
    kinds = [*KINDS, "drop-command", "silence"]
    bench.steps(8)
    for _ in range(pick.randrange(3, 10)):
        bench.fault(pick.choice(kinds), pick.randrange(1, 25), 2.0)  # type: ignore[arg-type]
        bench.step(
            pick.choice(core.COMMANDS), skipped=pick.choice([0, 0, 1, 3, pick.randrange(30)])
        )
        bench.steps(pick.randrange(1, 40))
        if pick.random() < 0.7:
            bench.step("reset" if bench.loop.state == "TRIPPED" else "zero")
            bench.steps(pick.randrange(1, 30))
        if bench.loop.state == "ZEROED":
            bench.step("arm")
            bench.step("start")
            bench.steps(pick.randrange(60))


def drawn(pick: random.Random) -> tuple[core.RigConfig, core.WireCalibration, int]:
    """A rig with noise, how it is mounted, and for how many ticks it is tared."""
    servo = core.ServoConfig("pure-delay", delay_samples=6)
    specimen = (core.element("stiffness", k_n_per_m=K_N_PER_M),)
    noise = core.SensorConfig(noise_std=pick.choice([0.0, 1e-9, 2e-6]))
    cell = core.SensorConfig(noise_std=5.0, bias=45.0)
    rig = core.RigConfig(
        servo, specimen, displacement=noise, force=cell, seed=pick.randrange(10**6)
    )
    tilted = core.WireCalibration(
        x_gain=pick.uniform(0.5, 2.0),
        x_offset_m=pick.uniform(-0.01, 0.01),
        cmd_gain=pick.uniform(0.5, 2.0),
        cmd_offset_m=pick.uniform(-0.01, 0.01),
    )
    return rig, pick.choice([core.IDENTITY, MOUNTED, tilted]), pick.choice([1, 2, 4, 20])


@pytest.mark.parametrize("first", [0, pytest.param(300, marks=pytest.mark.long)])
def test_bad_days_over_a_users_dbc_are_replayed_from_what_the_recording_holds(
    first: int, own_dbc: wire.Codec, floats: wire.Codec, monkeypatch: pytest.MonkeyPatch
) -> None:
    for seed in range(first, first + 300):
        pick = random.Random(seed)
        rig, calibration, tare_ticks = drawn(pick)
        monkeypatch.setattr(loop_bench, "rig", lambda *_, rig=rig: core.VirtualRig(rig))
        monkeypatch.setattr(loop_bench, "ORIGIN_M", pick.uniform(-0.05, 0.05))
        with Bench(
            seconds=0.3,
            codec=pick.choice([own_dbc, floats]),
            tare_ticks=tare_ticks,
            ramp_in_ticks=8,
            calibration=calibration,
            **WATCHED,
        ) as bench:
            bad_day(bench, pick)
            assert first_difference(bench.rows(), replay(bench)) is None, f"seed {seed}"


# ---- what must not pass -------------------------------------------------------------------------


@pytest.mark.parametrize("at", [None, 0, 100])
def test_table_of_signals_that_is_none_is_refused(at: int | None, floats: wire.Codec) -> None:
    table = bytearray(floats.table)
    if at is None:
        table.pop()
    else:
        table[at : at + 60] = b"\xff" * 60
    with pytest.raises(core.CoreError, match="table of signals"):
        wire.Codec.of(bytes(table))


@pytest.fixture(scope="module")
def recorded() -> Bench:
    with Bench(**WATCHED) as bench:
        bench.running(200)
        bench.fault("drop", 2)
        bench.step(skipped=3)
        bench.steps(200)
        return bench


def flip(bench: Bench, row: int, name: str, bit: int) -> np.ndarray:
    rows = bench.rows()
    raw = rows[name][row : row + 1].copy()
    image = raw.view(np.uint8)
    image[bit // 8] ^= 1 << bit % 8
    rows[name][row] = raw[0]
    return rows


OUTPUTS = (
    "generation",
    "state",
    "code",
    "ag_mps2",
    "x_num_m",
    "x_plc_m",
    "x_cmd_m",
    "x_meas_m",
    "f_meas_n",
    "alpha",
    "beta",
    "k_t_n_per_m",
    "energy_error_j",
    "tracking_indicator_m2",
)


@pytest.mark.long
@pytest.mark.parametrize("name", [*OUTPUTS, "x_read_m", "f_read_n"])
@pytest.mark.parametrize("row", [30, 450, 470, -2])
def test_flipped_bit_is_found_in_its_row(recorded: Bench, name: str, row: int) -> None:
    row %= recorded.rows().size
    blind = recorded.rows()["flags"][row] & FLAGS["blind"]
    assert not blind
    # What is finer than the tare is not seen of a reading.
    lowest = 12 if name in ("x_read_m", "f_read_n") else 0
    for bit in (lowest, 8 * core.RECORD_DTYPE[name].itemsize - 1):
        rows = flip(recorded, row, name, bit)
        assert first_difference(rows, replay(recorded, rows)) == row


@pytest.mark.parametrize("name", [*OUTPUTS, "x_read_m", "tick"])
def test_flipped_bit_is_found_in_a_blind_row(recorded: Bench, name: str) -> None:
    row = int(np.argmax(recorded.rows()["flags"] & FLAGS["blind"] != 0)) + 1
    rows = flip(recorded, row, name, 1)
    assert first_difference(rows, replay(recorded, rows)) == row


@pytest.mark.parametrize("name", core.FLAGS)
def test_flipped_flag_is_found_in_its_row(recorded: Bench, name: str) -> None:
    row = recorded.rows().size - 50
    rows = flip(recorded, row, "flags", core.FLAGS[name].bit_length() - 1)
    again = replay(recorded, rows)
    # That the count slipped is told by this bit alone; whether a command left shows in what the
    # drive had in the next tick.
    found = first_difference(rows, again)
    assert found == {"slip": None, "not_sent": row + 1}.get(name, row)


def test_row_that_is_missing_is_found(recorded: Bench) -> None:
    rows = recorded.rows()
    cut = np.delete(rows, 300)
    assert first_difference(cut, replay(recorded, cut)) == 300


def test_rows_that_make_no_tick_do_not_come_out(recorded: Bench) -> None:
    rows = recorded.rows()
    blind = int(np.argmax(rows["flags"] & FLAGS["blind"] != 0))
    assert replay(recorded, rows[: blind + 2]).size == blind
    backwards = rows.copy()
    backwards["tick"][100] = 7
    assert replay(recorded, backwards).size == 100


def test_station_that_has_ticked_replays_nothing(recorded: Bench) -> None:
    station = core.Station(recorded.config, recorded.ag)
    station.tick(lost=True)
    with pytest.raises(core.CoreError, match="new station"):
        station.replay(recorded.rows())


def test_other_settings_are_found(recorded: Bench) -> None:
    other = dataclasses.replace(recorded.config, ramp_in_ticks=255)
    again = core.Station(other, recorded.ag).replay(recorded.rows(), recorded.codec)
    started = int(np.argmax(recorded.rows()["state"] == core.STATES.index("RAMP_IN")))
    assert first_difference(recorded.rows(), again) == started + 1
