"""Real time at the rate of a user's drive: tests, small motions and commissioning, tick by tick.

What needs no clock goes on the stepped one. What is refused is refused with both figures.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Rthyb
from commissioning_bench import COLUMN, STIFFNESS_N_PER_M, at
from realtime_bench import SHORT, STATE

from rthyb_rt import config, core
from rthyb_rt.config import busload
from rthyb_rt.config.rigfile import default_lead_us
from rthyb_rt.core import FLAGS, loop
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, realtime
from rthyb_rt.lab.end_reasons import TimingError
from rthyb_rt.record import recording
from rthyb_rt.rig import identification, virtual_rig
from rthyb_rt.rig.commissioning import certificate, guide, jogging, stops
from rthyb_rt.rig.links import opening
from rthyb_rt.rig.virtual_rig import parse_faults

RATES = (256, 512, 1000, 2048, 4096)
LAG = COLUMN.replace(
    'kind = "pure-delay"\ndelay_samples = 12',
    'kind = "second-order"\nnatural_frequency_hz = 12\ndamping_ratio = 0.9',
)
AT_RATE = """schema = "rthyb-rig/1"
rig = {{ name = "r", load_cell = "specimen", elastic_stiffness_n_per_m = 5e5 }}
actuator = {{ kind = "pure-delay", delay_samples = 8 }}
specimen = [{{ element = "stiffness", k_n_per_m = 5e5 }}]
[link]
{link}
sample_rate_hz = {rate_hz}
"""


def rig_at(rate_hz: int, text: str = LAG) -> config.RigFile:
    return config.parse_rig(text, "rig.toml", {"link.sample_rate_hz": str(rate_hz)})


def link_at(rate_hz: int, link: str) -> config.RigFile:
    return config.parse_rig(AT_RATE.format(rate_hz=rate_hz, link=link), "rig.toml")


def short_test(rate_hz: float, rig: config.RigFile | None = None) -> experiment.Setup:
    changes = SHORT | {"test.sample_rate_hz": str(rate_hz)}
    test = config.load_test(config.builtin_test_path(), changes)
    rig = rig or config.load_rig(config.find_rig(test.rig))
    return experiment.prepare(test, rig, real_time=True)


def run(
    setup: experiment.Setup, *, plan: virtual_rig.RigPlan | None = None, skip: int = 0
) -> recording.RecordedTest:
    """Run a test with a drive in step; ``skip``: ticks slept through before every one at rest."""
    plan = plan or virtual_rig.RigPlan(rate=setup.rate)
    ours, theirs = opening.socket_pair()
    with ours, theirs, virtual_rig.in_step(setup.rig, theirs, plan) as drive:
        assert isinstance(drive, loop.Drive)

        def tick() -> None:
            drive.tick()
            if skip and session and drive.received_state in ("IDLE", "ZEROED"):
                session[0].loop._ticker.missed += skip
                for _ in range(skip):
                    drive.tick()

        session: list[realtime.Session] = []
        return realtime.run(setup, ours, clock="stepped", before_tick=tick, answered=session.append)


# ---- a test -------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [256, 512, 2048, 4096])
def test_a_test_in_real_time_goes_at_its_rate(rate_hz: int) -> None:
    setup = short_test(rate_hz)
    rec = run(setup)
    assert rec.meta["end_reason"] == "completed"
    assert rec.fs_hz == rate_hz
    rows = rec.samples
    running = rows[rows["state"] == STATE["RUNNING"]]
    assert running.size == pytest.approx(1.5 * rate_hz, abs=2)
    np.testing.assert_array_equal(
        rows["due_ns"], [int(n) * 10**9 // rate_hz for n in rows["tick"].tolist()]
    )
    behind_s = np.count_nonzero(rows["tick"] > running["tick"][-1]) / rate_hz
    assert behind_s >= 103 / 1024
    assert not (rows["flags"] & FLAGS["slip"]).any()


@pytest.mark.parametrize("rate_hz", [256, 4096])
def test_its_recording_is_replayed_bit_for_bit(rate_hz: int) -> None:
    rec = run(short_test(rate_hz))
    found = realtime.replay(rec)
    assert found.identical


@pytest.mark.long
def test_through_a_command_and_its_report(rthyb: Rthyb, tmp_path: Path) -> None:
    out = tmp_path / "run"
    answer = rthyb(
        "run", "--realtime", "--clock", "stepped", "--set", "test.sample_rate_hz=512",
        *(part for key, value in SHORT.items() for part in ("--set", f"{key}={value}")),
        "--out", out, "--json",
    )  # fmt: skip
    assert answer.code == 0, answer.err
    rec = recording.read(out / recording.FILE_NAME)
    assert rec.fs_hz == 512
    assert rthyb("replay", out).code == 0


# ---- another rate than the drive's --------------------------------------------------------------


def test_a_test_at_another_rate_than_its_drive_is_refused_with_both() -> None:
    rig = link_at(2048, 'kind = "socket"\nchannel = "/nowhere"')
    with pytest.raises(InputError, match=r"found 1024 Hz; the drive .* sampled at 2048 Hz"):
        short_test(1024, rig)
    assert short_test(2048, rig).rate.hz == 2048


def test_a_rate_that_is_no_whole_number_is_for_virtual_time() -> None:
    with pytest.raises(InputError, match=r"found 1000\.5 Hz; .* whole number"):
        short_test(1000.5)


@pytest.mark.parametrize(("drive_hz", "test_hz"), [(2048, 1024), (256, 1024), (1024, 512)])
def test_a_drive_that_samples_at_another_rate_is_named(drive_hz: int, test_hz: int) -> None:
    """On the stepped clock, with as many of the drive's samples a tick as both rates say."""
    setup = short_test(test_hz)
    ours, theirs = opening.socket_pair()
    plan = virtual_rig.RigPlan(rate=config.Rate(float(drive_hz)))
    with ours, theirs, virtual_rig.in_step(setup.rig, theirs, plan) as drive:
        due = [0.0]

        def tick() -> None:
            due[0] += drive_hz / test_hz
            while due[0] >= 1.0:
                drive.tick()
                due[0] -= 1.0

        with pytest.raises(InputError, match=rf"about {drive_hz // 100}.*runs at {test_hz} Hz"):
            realtime.run(setup, ours, clock="stepped", before_tick=tick)


def test_drives_of_two_axes_at_two_rates_are_refused() -> None:
    text = (Path(__file__).parents[1] / "hw" / "rigs" / "two-axis-frame.toml").read_text("utf-8")
    given = config.parse_any_rig(text, "rig.toml")
    assert isinstance(given, config.AxesRig)
    names = given.names
    axes = [
        axis.model_dump(exclude_none=True)
        | {"link": {"kind": "socket", "channel": f"/{name}", "sample_rate_hz": hz}}
        for axis, name, hz in zip(given.axis, names, (1024, 2048), strict=True)
    ]
    document = given.model_dump(by_alias=True, exclude_none=True) | {"axis": axes}
    with pytest.raises(Exception, match=r"1024 Hz \(axis .*and 2048 Hz"):
        config.AxesRig.model_validate(document)


# ---- what the bus and this PC allow -------------------------------------------------------------


def test_a_classic_bus_is_refused_at_2048_hz_with_its_load_and_what_it_has_room_for() -> None:
    link = 'kind = "can"\nchannel = "can0"\nbitrate = 1000000'
    assert link_at(1900, link).rate.hz == 1900
    with pytest.raises(InputError, match=r"2048 times per second.* 83 %.*room for 1975 Hz"):
        link_at(2048, link)
    # Less than 80 % at 1024 Hz on half the bit rate of the last one that is enough there.
    assert busload.bus_load(busload.OWN_FRAMES, 1_000_000, rate_hz=1975) <= busload.MAX_SHARE
    assert busload.bus_load(busload.OWN_FRAMES, 1_000_000, rate_hz=1976) > busload.MAX_SHARE


def test_a_serial_line_is_refused_at_4096_hz_with_the_baud_rate_that_is_enough() -> None:
    serial = 'kind = "serial"\nchannel = "/dev/ttyUSB0"'
    assert link_at(2048, serial).link is not None
    with pytest.raises(InputError, match=r"at 4096 Hz need 1146880 Bd, 125 %.*1500000 Bd"):
        link_at(4096, serial)
    assert link_at(4096, serial + "\nbitrate = 1500000").rate.hz == 4096


@pytest.mark.parametrize(("rate_hz", "lead_us"), [(256, 200), (1024, 200), (2048, 195), (4096, 98)])
def test_the_lead_of_the_link_clock_fits_the_period(rate_hz: int, lead_us: float) -> None:
    socket = 'kind = "socket"\nchannel = "/nowhere"\nclock = "link"'
    found = link_at(rate_hz, socket).link
    assert found is not None
    assert found.lead_us == default_lead_us(rate_hz) == lead_us
    loop.Phase(found.lead_us, rate_hz)
    if lead_us < 200:
        with pytest.raises(InputError, match=r"found 300 us; at sample_rate_hz"):
            link_at(rate_hz, socket + "\nlead_us = 300")


def test_a_pc_that_does_not_wake_up_for_the_rate_is_refused_before_anything_moves() -> None:
    with pytest.raises(
        TimingError, match=r"does not wake up in time for 2048 Hz: of \d+ ticks at rest \d+ "
    ):
        run(short_test(2048), skip=1)


def test_at_1024_hz_a_pc_that_was_late_at_rest_begins_as_ever_and_completes() -> None:
    """Ticks skipped before START are not counted against the test."""
    rec = run(short_test(1024), skip=1)
    assert rec.meta["end_reason"] == "completed"


# ---- small motions and commissioning ------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", RATES)
def test_a_jog_is_as_fast_at_every_rate(rate_hz: int) -> None:
    with at(rig_at(rate_hz)) as there:
        jogged = jogging.jog(there.connection, 2e-3, 4e-3)
        log = there.drive.log
    assert (jogged.cause, jogged.state, jogged.faults) == ("completed", "IDLE", ())
    assert jogged.moved_m == pytest.approx(2e-3, abs=10e-6)
    assert jogged.stiffness_n_per_m == pytest.approx(STIFFNESS_N_PER_M, rel=0.01)
    speed = np.abs(np.diff(log["target_m"])) * rate_hz
    assert 0.9 * 4e-3 < speed[log["state"][1:] == STATE["RUNNING"]].max() <= 4e-3 * 1.02


@pytest.mark.long
@pytest.mark.parametrize("rate_hz", [256, 2048])
def test_a_rig_is_commissioned_at_its_rate(rate_hz: int) -> None:
    with at(rig_at(rate_hz)) as there:
        found = guide.commission(there.connection, guide.CommissioningSettings(distance_m=1e-3))
    assert {name: step.faults for name, step in found.steps.items()} == dict.fromkeys(
        certificate.STEPS, ()
    )
    assert found.sample_rate_hz == rate_hz
    assert found.steps["link"].figures["rate_hz"] == pytest.approx(rate_hz, rel=0.01)
    assert found.steps["watchdog"].figures["drive_ticks"] == max(1, round(20 / 1024 * rate_hz))


def test_a_certificate_holds_at_its_rate_alone(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(LAG, encoding="utf-8")
    made_at = rig_at(1024)
    step = certificate.CheckedStep("link", True, certificate.now())
    known = certificate.Certificate("column", certificate.rig_hash(made_at), False, "a link")
    certificate.write(certificate.place(path), known.with_step(step))
    assert certificate.standing(made_at, path).holds is not None
    stands = certificate.standing(rig_at(2048), path)
    assert stands.holds is None
    assert "at 1024 Hz, but is now to run at 2048 Hz (link.sample_rate_hz)" in stands.why_not


def test_a_certificate_of_before_there_were_rates_is_of_1024_hz(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    known = certificate.Certificate("column", certificate.rig_hash(rig_at(1024)), False, "a link")
    document = known.as_json()
    assert document.pop("sample_rate_hz") == 1024
    place = certificate.place(path)
    place.write_text(config_json(document), encoding="utf-8")
    assert certificate.read(place).sample_rate_hz == 1024


def config_json(document: dict[str, Any]) -> str:
    import json

    return json.dumps(document)


@pytest.mark.parametrize("rate_hz", [256, 512, 2048])
def test_a_sweep_over_the_link_at_the_drives_rate_finds_what_it_finds_at_1024_hz(
    rate_hz: int,
) -> None:
    sweep = identification.SweepPlan((1.0, 4.0), 0.5e-3)
    with at(rig_at(rate_hz)) as there:
        found = identification.identify_live(there.connection, sweep)
    known = identification.identify(rig_at(1024), sweep)
    assert found.recording is not None
    assert found.recording.fs_hz == rate_hz
    assert found.link_delay_samples == 0.0
    before, now = (
        identification.identified_rig(rig_at(1024), one).identified for one in (known, found)
    )
    assert before is not None
    assert now is not None
    assert now.delay_at_frequency_s == pytest.approx(before.delay_at_frequency_s, abs=6e-5)
    assert now.amplitude == pytest.approx(before.amplitude, rel=3e-3)
    # Each command is held for a sample of the rate.
    assert found.alpha == pytest.approx(known.alpha + 512.0 / rate_hz - 0.5, abs=0.15)
    assert found.k_e_n_per_m == pytest.approx(STIFFNESS_N_PER_M, rel=3e-3)


def test_a_sweep_in_virtual_time_is_that_of_1024_hz_whatever_the_drives_rate() -> None:
    sweep = identification.SweepPlan((1.0, 2.0), 1e-3)
    one, other = (identification.identify(rig_at(hz), sweep) for hz in (1024, 2048))
    assert one.delay_s == other.delay_s


def test_faults_of_a_virtual_rig_begin_at_their_second() -> None:
    (fault,), _ = parse_faults(["drop@2.5:0.1=0.5"], rate=config.Rate(2048.0))
    assert (fault.first, fault.ticks) == (5120, 205)
    (shortest,), _ = parse_faults(["silence@1:0.000001"], rate=config.Rate(256.0))
    assert (shortest.first, shortest.ticks) == (256, 1)


# ---- what a drive did after a trip --------------------------------------------------------------


@pytest.mark.parametrize("ticks_at_rest", [100, 130, 200, 250, 300, 600])
def test_a_drive_that_stops_at_once_passes_however_long_it_has_followed(ticks_at_rest: int) -> None:
    """An echo of one byte comes round: one of before the trip is none of the command of it."""
    rows = np.zeros(ticks_at_rest + 20, core.RECORD_DTYPE)
    n = np.arange(rows.size)
    rows["state"] = np.where(n >= ticks_at_rest, STATE["TRIPPED"], STATE["IDLE"])
    # The command of a row is heard of in the next; three of them say TRIPPED, then there are none.
    silent = np.where(n >= ticks_at_rest + 3, FLAGS["not_sent"], 0)
    stopped = np.where(n > ticks_at_rest, FLAGS["stopped"], 0)
    rows["flags"] = FLAGS["fresh"] | silent | stopped
    rows["echo"] = np.minimum(n, ticks_at_rest + 3) % 256
    rows["count"] = n % 256
    found = stops.after_trip(rows)
    assert (found.stopped, found.gap) == (True, False)
    assert found.ticks is not None
    assert found.ticks <= stops.TRIP_TICKS
