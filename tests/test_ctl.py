"""`rthyb ctl` as an operator types it, against a daemon on the stepped clock."""

from __future__ import annotations

import json
import os
import re
import stat
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Rthyb
from realtime_bench import PROGRAM, until
from service_bench import await_state, rig_file, served, status

from rthyb_rt import config
from rthyb_rt.cli import ctl
from rthyb_rt.config import RigFile
from rthyb_rt.config.limits import looser
from rthyb_rt.core import STATES
from rthyb_rt.lab import realtime
from rthyb_rt.record import recording
from rthyb_rt.rig.commissioning import certificate
from rthyb_rt.service import disk, metrics, ring_recorder
from rthyb_rt.service.control import Client
from rthyb_rt.service.daemon import Daemon
from rthyb_rt.service.peers import Peer
from rthyb_rt.service.ring_recorder import Status, read_index

pytestmark = pytest.mark.alone

SHORT = [
    *("--set", "test.duration_s=1.5", "--set", "ground_motion.start_s=1.5"),
    *("--set", "limits.ramp_in_s=0.25", "--set", "limits.tare_s=0.125"),
]
LONG = [
    *SHORT[4:],
    *("--set", "test.duration_s=120", "--set", "limits.armed_timeout_s=3600"),
]
"""Nobody waits for its end."""


@pytest.fixture
def daemon(place: Path) -> Iterator[Daemon]:
    with served(place) as made:
        yield made


def to_arm(rthyb: Rthyb, *settings: str) -> None:
    for words in (("load", *settings), ("zero",), ("arm",)):
        answer = rthyb("ctl", *words)
        assert answer.code == 0, answer.err


# ---- the operator's first ten minutes -----------------------------------------------------------


def test_operator_runs_a_test_and_is_told_what_comes_next(
    rthyb: Rthyb, place: Path, daemon: Daemon
) -> None:
    assert rthyb("ctl", "status").out.splitlines()[3].split() == [
        *("Test", "none", "to", "load", "one:", "rthyb", "ctl", "load", "TEST.toml"),
    ]
    loaded = rthyb("ctl", "load", *SHORT)
    assert re.fullmatch(r"Loaded section5-t0.5, \w{12}; next: rthyb ctl zero\n", loaded.out)
    zeroed = r"Zeroed, tare [-\u2212]?\d\S* mm, [-\u2212]?\d\S* kN; next: rthyb ctl arm\n"
    assert re.fullmatch(zeroed, rthyb("ctl", "zero").out)
    armed = rthyb("ctl", "arm")
    assert armed.out == "Armed section5-t0.5, for 30 s; next: rthyb ctl start\n"
    (kept,) = place.glob("rthyb-token-*")
    assert stat.S_IMODE(kept.stat().st_mode) == 0o600
    assert rthyb("ctl", "start").out.startswith("Started; ")
    while status(place)["last"] is None:
        pass
    shown = rthyb("ctl", "status").out
    assert re.search(r"^Last test +section5-t0.5 +completed$", shown, re.M)
    assert re.search(r"^State +IDLE +allowed now: load, zero, stop, reload$", shown, re.M)


def test_a_building_of_ten_storeys_runs_through_the_service(
    rthyb: Rthyb, place: Path, daemon: Daemon
) -> None:
    example = config.builtin_test_path().with_name("ten-storeys.toml")
    to_arm(rthyb, str(example), *SHORT)
    assert rthyb("ctl", "start").out.startswith("Started; ")
    while status(place)["last"] is None:
        pass
    assert re.search(r"^Last test +ten-storeys +completed$", rthyb("ctl", "status").out, re.M)


def test_every_answer_comes_as_json_too(rthyb: Rthyb, place: Path, daemon: Daemon) -> None:
    digest = rthyb("ctl", "load", *LONG, "--json").json["digest"]
    found = rthyb("ctl", "status", "--json")
    assert found.json["test"]["digest"] == digest
    assert found.json["schema"] == "rthyb-status/1"
    assert found.json["allowed"] == ["load", "zero", "stop", "reload"]
    assert rthyb("ctl", "zero", "--json").json["state"] == "ZEROED"
    token = rthyb("ctl", "arm", "--digest", str(digest)[:8], "--json").json["token"]
    assert rthyb("ctl", "start", "--token", token, "--json").json["ok"]
    await_state(place, "RUNNING")
    assert rthyb("ctl", "hold", "--json").json["command"] == "hold"
    while rthyb("ctl", "resume", "--json").code:
        pass
    assert rthyb("ctl", "stop", "--json").json["ok"]
    await_state(place, "IDLE")


def test_trip_is_reset(rthyb: Rthyb, place: Path, daemon: Daemon) -> None:
    to_arm(rthyb, *LONG)
    assert rthyb("ctl", "start").code == 0
    assert rthyb("ctl", "stop", "--now").out == "Tripped\n"
    refused = rthyb("ctl", "stop")
    assert refused.code == 5
    assert "the state is TRIPPED; stop is allowed in IDLE, ZEROED" in refused.err
    assert "remove the cause, then reset" in refused.err
    while status(place)["run_id"]:
        pass
    found = rthyb("ctl", "status").out
    assert "TRIPPED, the operator" in found
    assert " of 120.0 s" not in found  # how it ended is in the row of the last test
    assert rthyb("ctl", "reset").out == "Reset\n"
    assert status(place)["state"] == "IDLE"


def test_test_goes_through_the_socket_whole_and_into_the_recording(
    rthyb: Rthyb, place: Path
) -> None:
    """With a recorder of the daemon's own; the record is a file that the daemon never sees."""
    with served(place, recorder="own"):
        times = [f"{0.02 * n:.2f} {0.1 if n % 50 < 25 else -0.1}" for n in range(200)]
        Path("record.txt").write_text("\n".join(times) + "\n", encoding="utf-8")
        given = ["--set", "ground_motion.record=record.txt", "--set", "ground_motion.units=g"]
        to_arm(rthyb, *SHORT[4:], *given, "--set", "test.duration_s=1")
        Path("record.txt").unlink()
        run_id = status(place)["run_id"]
        assert rthyb("ctl", "start").code == 0
        while not (found := [e for e in read_index(place / "runs") if e["run_id"] == run_id]):
            pass
    rec = recording.open_run(place / "runs" / found[0]["folder"])
    assert rec.ground_motion["name"] == "record"
    assert rec.meta["end_reason"] == "completed"
    assert realtime.replay(rec).identical
    assert config.parse_test(rec.test_toml, "recording").ground_motion.units == "g"


# ---- refusals -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("zero", "no test is loaded: load one first"),
        ("arm", "arm is allowed in ZEROED"),
        ("start", "start is allowed in ARMED"),
        ("hold", "hold is allowed in RUNNING"),
        ("resume", "resume is allowed in HOLD"),
        ("reset", "there is nothing to reset"),
        ("reload", "without a rig file that it could read again"),
    ],
)
def test_refusal_is_exit_5_and_says_why(
    rthyb: Rthyb, daemon: Daemon, command: str, message: str
) -> None:
    answer = rthyb("ctl", command)
    assert answer.code == 5
    assert message in answer.err
    assert "the state is IDLE" in answer.err


@pytest.mark.parametrize(
    "command", ["status", "load", "zero", "arm", "start", "hold", "resume", "stop", "reset"]
)
def test_no_service_is_exit_4_and_says_what_to_do(rthyb: Rthyb, place: Path, command: str) -> None:
    answer = rthyb("ctl", command)
    assert answer.code == 4
    assert f"{place}/control.sock: the service cannot be reached" in answer.err
    assert "systemctl status rthyb" in answer.err


def test_faulty_test_is_exit_3_with_every_fault(rthyb: Rthyb, daemon: Daemon) -> None:
    answer = rthyb("ctl", "load", "--set", "controller.w1=0.5")
    assert answer.code == 3
    assert "controller.w1" in answer.err
    shipped = rthyb("ctl", "load", *SHORT, "--set", "rig.rig.seed=3")
    assert shipped.code == 2
    assert "the rig is that of the service" in shipped.err


def test_fault_between_test_and_the_services_rig_is_exit_3(rthyb: Rthyb, place: Path) -> None:
    rig = rig_file({"rig.limits.command_position_m": '{ value = "5 mm", action = "trip" }'})
    with served(place, rig=rig):
        answer = rthyb("ctl", "load", *SHORT)
        assert answer.code == 3
        assert "limits.command_position_m" in answer.err
        assert "a test may not allow more" in answer.err
        assert status(place)["test"] is None


def test_second_operator_does_not_start_what_another_has_armed(
    rthyb: Rthyb, place: Path, daemon: Daemon
) -> None:
    to_arm(rthyb, *LONG)
    for kept in place.glob("rthyb-token-*"):
        kept.unlink()
    answer = rthyb("ctl", "start")
    assert answer.code == 5
    me = re.escape(Peer(0, os.geteuid(), frozenset()).user)
    assert re.search(rf"armed by {me}, process \d+, and only that user may start it", answer.err)
    assert status(place)["state"] == "ARMED"
    assert re.search(rf"^Armed by +{me}", rthyb("ctl", "status").out, re.M)
    assert rthyb("ctl", "arm").code == 5
    assert rthyb("ctl", "stop").code == 0


def test_nothing_is_armed_that_would_not_be_recorded(rthyb: Rthyb, place: Path) -> None:
    with served(place, recorder="service"):
        assert rthyb("ctl", "load", *SHORT).code == 0
        assert rthyb("ctl", "zero").code == 0
        answer = rthyb("ctl", "arm")
        assert answer.code == 5
        assert "the recorder does not respond" in answer.err
        assert "does not respond" in rthyb("ctl", "status").out


@pytest.mark.parametrize(("law", "answered"), [("none", 0), ("amb", 5)])
def test_room_for_what_a_law_reports_is_asked_for_before_a_test_is_armed(
    rthyb: Rthyb, place: Path, monkeypatch: pytest.MonkeyPatch, law: str, answered: int
) -> None:
    """As much room as the rows of a law that reports nothing: too little for one that does."""
    with served(place, recorder="service") as daemon:
        assert rthyb("ctl", "load", *SHORT, "--set", f"controller.type={law}").code == 0
        assert rthyb("ctl", "zero").code == 0
        assert daemon.engine.loaded is not None
        free = disk.needed_bytes(daemon.engine.loaded.setup.ticks)

        def said(_: Path) -> Status:
            run_id = daemon.engine.run_id
            return Status(1, time.monotonic(), str(place / "runs"), free, run_id=run_id)

        monkeypatch.setattr(ring_recorder, "read_status", said)
        answer = rthyb("ctl", "arm")
        assert answer.code == answered, answer.err
        if answered:
            assert "the recording may need" in answer.err
            assert "free some space" in answer.err


def test_limits_are_reloaded(rthyb: Rthyb, place: Path) -> None:
    now = {"rig.limits.tracking_error_m": '{ value = "3 mm", action = "hold" }'}
    with served(place, read_rig=lambda: rig_file(now)) as daemon:
        before = rthyb("ctl", "load", *SHORT, "--json").json["digest"]
        assert rthyb("ctl", "reload").out == "Limits reloaded\n"
        assert "\\b" not in rthyb("ctl", "--help").out
        limit = daemon.engine.rig.limits.tracking_error_m
        assert limit is not None
        assert limit.value == 3e-3
        assert rthyb("ctl", "status", "--json").json["test"]["digest"] != before


def limited(mm: float) -> str:
    """Return the text of a real rig's file with a limit on the tracking error."""
    limit = f'{{ value = "{mm} mm", action = "hold" }}'
    link = '\n[link]\nkind = "socket"\nchannel = "wire"\n'
    return config.dump(rig_file({"rig.limits.tracking_error_m": limit})) + link


def test_real_rig_takes_limits_within_those_commissioned_and_no_others(
    rthyb: Rthyb, place: Path, tmp_path: Path
) -> None:
    """What a test may do without a commissioning, a reload may: no limit is ever wider."""
    path = tmp_path / "rig.toml"
    path.write_text(limited(3))
    rig = config.load_rig(path)
    made = certificate.Certificate(rig.rig.name, certificate.rig_hash(rig), False, "wire")
    for name in certificate.STEPS:
        made = made.with_step(certificate.CheckedStep(name, True, certificate.now()))
    certificate.write(certificate.place(path), made)
    with served(
        place,
        rig=rig,
        read_rig=lambda: config.load_rig(path),
        demand=lambda found: certificate.demand(found, path),
    ) as daemon:

        def reload(text: str) -> tuple[int, float | None, str]:
            path.write_text(text)
            answer = rthyb("ctl", "reload")
            limit = daemon.engine.rig.limits.tracking_error_m
            return answer.code, limit and limit.value, answer.err

        assert reload(limited(1))[:2] == (0, 1e-3)
        # Those commissioned count, not those of the last reload.
        assert reload(limited(2))[:2] == (0, 2e-3)
        for text in (limited(4), limited(2).replace('action = "hold"', 'action = "none"')):
            code, value, said = reload(text)
            assert (code, value) == (5, 2e-3)
            assert "limits.tracking_error_m would allow more than was commissioned" in said
            assert "rthyb commission" in said
        code, value, said = reload(limited(1).replace("noise_std_n = ", "noise_std_n = 1"))
        assert (code, value) == (5, 2e-3)
        assert "sensors" in said
        assert reload(limited(3))[:2] == (0, 3e-3)


def test_limits_are_looser_that_allow_more_or_are_gone() -> None:
    def limits(**given: Any) -> config.Limits:
        return config.Limits.model_validate(given)

    before = limits(force_n=100.0, command_velocity_m_per_s=0.1, tare_s=1.0)
    assert looser(before, before) == []
    assert looser(before.model_copy(update={"energy_error_j": None}), before) == []
    assert looser(limits(force_n=99.0, command_velocity_m_per_s=0.1, tare_s=2.0), before) == []
    assert looser(limits(force_n=101.0, command_velocity_m_per_s=0.1, tare_s=0.5), before) == [
        "force_n",
        "tare_s",
    ]
    assert looser(limits(), before) == ["command_velocity_m_per_s", "force_n", "tare_s"]
    assert looser(limits(), limits(force_n={"value": 5.0, "enable": False})) == []


def test_rig_file_is_not_even_read_while_a_test_moves(rthyb: Rthyb, place: Path) -> None:
    """Work beside a running test is a risk of late ticks."""
    looked: list[str] = []

    def read() -> RigFile:
        looked.append("read")
        return rig_file()

    with served(place, read_rig=read):
        to_arm(rthyb, *LONG)
        assert rthyb("ctl", "start").code == 0
        await_state(place, "RUNNING")
        answer = rthyb("ctl", "reload")
        assert answer.code == 5
        assert "limits can be changed only at rest or in HOLD" in answer.err
        assert not looked
        assert rthyb("ctl", "stop").code == 0
        await_state(place, "IDLE")
        assert rthyb("ctl", "reload").code == 0
        assert looked


# ---- figures ------------------------------------------------------------------------------------


def test_metrics_are_prometheus_text(rthyb: Rthyb, place: Path, daemon: Daemon) -> None:
    text = rthyb("ctl", "metrics").out
    sample = re.compile(r'^[a-z_]+(\{[a-z]+="[^"]*"(,[a-z]+="[^"]*")*\})? -?[0-9.e+-]+$')
    named = set()
    for line in text.splitlines():
        if line.startswith("# "):
            named.add(line.split()[2])
            continue
        assert sample.match(line), line
        assert line.split("{")[0].split()[0] in named
    assert text.count("rthyb_state{") == len(STATES)
    assert 'rthyb_state{state="IDLE"} 1\n' in text
    assert re.search(r"^rthyb_ticks_total [1-9]\d*$", text, re.M)
    assert metrics._labels({"a": 'x"\\\n'}) == '{a="x\\"\\\\\\n"}'


def test_zero_that_ends_in_a_trip_or_is_stopped_is_no_success(
    rthyb: Rthyb, place: Path, daemon: Daemon
) -> None:
    for now, said in (
        (True, "the rig is TRIPPED, cause: the operator"),
        (False, "stopped by an op"),
    ):
        assert rthyb("ctl", "load", *LONG, "--set", "limits.tare_s=5").code == 0
        told: list[bool] = []

        def interfere(now: bool = now, told: list[bool] = told) -> None:
            while not status(place)["run_id"]:
                time.sleep(0.01)
            with Client(place / "control.sock") as client:
                client.call("Stop", now=now)
            told.append(now)

        other = threading.Thread(target=interfere)
        other.start()
        answer = rthyb("ctl", "zero")
        other.join()
        assert told == [now]
        assert answer.code == 1, answer.out
        assert "not zeroed" in answer.err
        assert said in answer.err
        if now:
            assert rthyb("ctl", "reset").code == 0
            until(lambda: not status(place)["run_id"], "the end of what was tripped")


@pytest.mark.parametrize("digest", ["", "a", "ABCDEF01", "xyz45678"])
def test_digest_of_less_than_eight_digits_names_no_test(
    rthyb: Rthyb, place: Path, daemon: Daemon, digest: str
) -> None:
    """An empty variable of somebody's script must not arm whatever is loaded."""
    assert rthyb("ctl", "load", *LONG).code == 0
    assert rthyb("ctl", "zero").code == 0
    answer = rthyb("ctl", "arm", "--digest", digest)
    assert answer.code == 2
    assert "at least the first 8 digits" in re.sub(r"\s+", " ", answer.err)
    assert rthyb("ctl", "arm").code == 0
    assert rthyb("ctl", "start", "--token", "").code == 5
    assert status(place)["state"] == "ARMED"


def test_ground_motion_too_long_for_the_socket_is_refused_with_what_fits(
    rthyb: Rthyb, place: Path, daemon: Daemon, tmp_path: Path
) -> None:
    rows = np.sin(np.arange(600_000) * 1e-3) / 3.0
    (tmp_path / "long.txt").write_text(
        "time_s acc_g\n" + "".join(f"{k * 0.005:.3f} {a:.16g}\n" for k, a in enumerate(rows)),
        encoding="ascii",
    )
    answer = rthyb("ctl", "load", "--set", f'ground_motion.record="{tmp_path}/long.txt"')
    assert answer.code == 3
    assert re.search(
        r"its 600000 points make a message of .* MB, .* at most 8.3 MB, about \d{6} points",
        answer.err,
    )
    assert status(place)["test"] is None


def test_watch_ends_with_whoever_read_it(place: Path, daemon: Daemon) -> None:
    """`rthyb ctl status --watch | grep -m1 IDLE` waits in a script."""
    command = [*PROGRAM, "ctl", "status", "--watch", "--every", "0.05"]
    made = subprocess.Popen(command, stdout=subprocess.PIPE, env=dict(os.environ))
    assert made.stdout is not None
    assert made.stdout.readline().startswith(b"IDLE")
    made.stdout.close()
    assert made.wait(60.0) == 0


def test_metrics_go_to_a_file_for_who_collects_files(place: Path) -> None:
    with served(place, metrics=place / "rthyb.prom"):
        while not (place / "rthyb.prom").exists():
            pass
        assert (place / "rthyb.prom").read_text().startswith("# HELP rthyb_up")
    # It would say of a service that has ended that it is up.
    assert not (place / "rthyb.prom").exists()


def test_watch_shows_line_after_line_without_a_terminal(
    rthyb: Rthyb, daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks = iter([None, None])

    def pause(_: float) -> None:
        if next(looks, "over") == "over":
            raise KeyboardInterrupt

    monkeypatch.setattr(ctl.time, "sleep", pause)
    lines = rthyb("ctl", "status", "--watch").out.splitlines()
    assert len(lines) == 3
    assert all(re.match(r"IDLE, -?\d+\.\d+ mm, -?\d+\.\d+ kN, ", line) for line in lines)
    looks = iter([None])
    lines = rthyb("ctl", "status", "--watch", "--json").out.splitlines()
    assert [json.loads(line)["state"] for line in lines] == ["IDLE", "IDLE"]


def test_socket_is_found_where_it_is(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert ctl.place(Path("given")) == Path("given")
    assert ctl.place(None) == place / "control.sock"
    monkeypatch.delenv("RTHYB_SOCKET")
    assert ctl.place(None).name == "control.sock"


def test_help_of_every_command_has_its_example_or_its_meaning(rthyb: Rthyb) -> None:
    shown = rthyb("ctl", "--help").out
    for name in ("status", "load", "zero", "arm", "start", "hold", "resume", "stop", "reset"):
        assert re.search(rf"^  {name} +\w", shown, re.M)
        assert rthyb("ctl", name, "--help").code == 0
