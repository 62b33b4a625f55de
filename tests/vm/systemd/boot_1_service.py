"""A day of the service under systemd, from its installation to the moment when the power fails."""

from __future__ import annotations

import grp
import json
import os
import pwd
import re
import signal
import stat
import time
from contextlib import closing, suppress
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import h5py
import numpy as np
import pytest
from realtime_bench import STATE, moment_s, require_calm, until
from stalls import Stalled
from test_links_socketcan import Adapter
from test_service_daemon import assert_drive_heard
from vm.systemd import lab as labs
from vm.systemd.lab import (
    LIVE,
    LIVE_USER,
    LOOKER,
    OPERATOR,
    RECORDER,
    RINGS,
    RUNS,
    SERVICE,
    STRANGER,
    Ask,
    Lab,
    as_user,
    at_terminal,
    ctl,
    lab,
    repeated,
    run,
    shown,
    systemctl,
)
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from rthyb_rt.core import loop, ticker
from rthyb_rt.lab import realtime
from rthyb_rt.service.control import Client, Refusal
from rthyb_rt.service.growing import PART_NAME
from rthyb_rt.service.ring_recorder import read_status

COMMANDS = {
    "Load": {"test_toml": "", "record": {}},
    "Zero": {},
    "Arm": {"digest": ""},
    "Start": {"token": ""},
    "Resume": {},
    "Reset": {},
    "Reload": {},
    "Hold": {},
    "Stop": {},
    "GetStatus": {},
    "GetRig": {},
    "GetMetrics": {},
}
FOR_LOOKERS = ("Hold", "Stop", "GetStatus", "GetRig", "GetMetrics")


def asked(user: str) -> dict[str, str]:
    """Have a user give every command there is; return what became of each."""
    with at_terminal(user) as given:
        return {name: given(name, **parameters) for name, parameters in COMMANDS.items()}


def rights(path: Path) -> tuple[str, str, str]:
    found = path.stat()
    return stat.filemode(found.st_mode), path.owner(), path.group()


# ---- installation -------------------------------------------------------------------------------


def test_service_is_installed_enabled_and_started() -> None:
    said = labs.install()
    assert "Wrote /etc/systemd/system/rthyb.service" in said
    assert "warning" not in said
    assert grp.getgrnam("rthyb-operator").gr_gid != grp.getgrnam("rthyb").gr_gid
    assert rights(RINGS) == ("drwxr-xr-x", "rthyb", "rthyb")
    assert rights(RUNS) == ("drwxr-s---", "rthyb", "rthyb")
    labs.add_users()
    systemctl("enable", "--now", RECORDER, SERVICE)
    assert systemctl("is-active", RECORDER, SERVICE).split() == ["active", "active"]
    labs.assert_idle_unless_stalled()
    assert systemctl("--failed", "--no-legend", "--plain") == ""


def test_device_rule_opens_the_device_to_the_group() -> None:
    """Kernels that sleep have /dev/cpu_dma_latency; another misc device plays it where not."""
    device = Path("/dev/cpu_dma_latency")
    if not device.exists():
        rules = Path("/etc/udev/rules.d/70-rthyb.rules").read_text(encoding="utf-8")
        assert rules.count(device.name) == 1
        device = Path("/dev/hwrng")
        assert rights(device)[1:] == ("root", "root")
        Path("/run/udev/rules.d").mkdir(parents=True, exist_ok=True)
        played = rules.replace("cpu_dma_latency", device.name.replace("hwrng", "hw_random"))
        Path("/run/udev/rules.d/71-played.rules").write_text(played, encoding="utf-8")
        run("udevadm", "control", "--reload")
        run("udevadm", "trigger", "--settle", "--subsystem-match=misc")
    assert rights(device) == ("crw-rw----", "root", "rthyb")


def test_can_adapter_that_is_plugged_in_is_set_up_and_pulled_out_it_leaves_nothing_failed() -> None:
    """By udev and rthyb-can@: with the bit rate of its file, and down after a bus-off."""
    unit = "rthyb-can@can0.service"
    setting = Path("/etc/rthyb/can-can0.conf")
    setting.write_text("BITRATE=800000\n", encoding="ascii")
    up = r"<[^>]*\bUP\b"

    def is_state(state: str) -> bool:
        return shown(unit, "ActiveState") == state

    with closing(Adapter()) as adapter:
        name = adapter.name
        assert name == "can0"
        until(lambda: is_state("active"), unit)
        found = labs.interface(name)
        assert re.search(f"{up}.* bitrate 800000 ", found), found
        assert "restart-ms 0 " in found
        setting.unlink()
        systemctl("restart", unit)
        assert " bitrate 1000000 " in labs.interface(name)
        systemctl("stop", unit)
        assert not re.search(up, labs.interface(name))
        systemctl("start", unit)
    until(lambda: is_state("inactive"), "the end of its unit")
    assert systemctl("--failed", "--no-legend", "--plain") == ""
    with closing(Adapter()):
        until(lambda: is_state("active"), "its unit, once more")
        assert re.search(f"{up}.* bitrate 1000000 ", labs.interface(name))
    until(lambda: is_state("inactive"), "the end of its unit")
    # Virtual interfaces are nobody's business.
    units = systemctl("list-units", "--all", "--no-legend", "--plain", "rthyb-can@*")
    assert "vcan" not in units, units


def test_daemon_has_real_time_and_no_other_privilege() -> None:
    with lab("privileges") as made:
        assert {"fifo", "memory_locked"} <= set(made.status()["privileges"])
        pid = made.main_pid()
        processes = Path("/sys/fs/cgroup/system.slice", SERVICE, "cgroup.procs")
        assert processes.read_text(encoding="ascii").split() == [str(pid)]
        said = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
        facts = dict(re.findall(r"^(\w+):\s+(.*)$", said, re.M))
        assert facts["Uid"].split() == [str(Path("/var/lib/rthyb").stat().st_uid)] * 4
        assert {facts[f"Cap{kind}"] for kind in ("Inh", "Prm", "Eff", "Bnd", "Amb")} == {"0" * 16}
        assert (facts["NoNewPrivs"], facts["Seccomp"]) == ("1", "2")
        threads = [int(task) for task in os.listdir(f"/proc/{pid}/task")]
        fifo = [os.sched_getparam(tid).sched_priority for tid in threads if is_fifo(tid)]
        assert fifo == [ticker.PRIORITY]


def is_fifo(tid: int) -> bool:
    return os.sched_getscheduler(tid) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO


# ---- who may do what ----------------------------------------------------------------------------


def test_users_outside_the_groups_are_refused_every_command_that_is_not_theirs() -> None:
    with lab("users"):
        assert set(asked(STRANGER).values()) == {"NotPermitted"}
        # Whoever broke into the live view would have the rights of its user, and no more.
        for user in (LOOKER, LIVE_USER):
            answers = asked(user).items()
            refused = {name for name, answer in answers if answer == "NotPermitted"}
            assert refused == set(COMMANDS) - set(FOR_LOOKERS)
        assert "NotPermitted" not in asked(OPERATOR).values()
        for user in (STRANGER, LOOKER, LIVE_USER):
            for path in (*RINGS.glob("ring.*"), labs.RIG):
                assert as_user(user, "sh", "-c", f": >>{path}").returncode
        assert as_user(STRANGER, "ls", str(RUNS)).returncode
        assert as_user(LOOKER, "ls", str(RUNS)).returncode == 0


def test_operator_runs_a_test_that_another_may_hold_and_stop_but_not_go_on_with() -> None:
    def attempt(made: Lab) -> None:
        def told(user: str, *words: str) -> dict[str, object]:
            code, answer, err = ctl(user, *words)
            if code and made.ended_early():
                raise Stalled(err)
            assert code == 0, err
            return answer

        def does(ask: Ask, name: str) -> None:
            answer = ask(name)
            if answer != "done" and made.ended_early():
                raise Stalled(f"{name}: {answer}")
            assert answer == "done"

        short = ("--set", "test.duration_s=30", "--set", "limits.ramp_in_s=0.25")
        told(OPERATOR, "load", *short)
        told(OPERATOR, "zero")
        until(made._recorder_is_there, "the recorder")
        code, _, err = ctl(LOOKER, "arm")
        assert (code, "group rthyb-operator" in err) == (5, True)
        told(OPERATOR, "arm")
        run_id = str(made.status()["run_id"])
        with at_terminal(LOOKER) as looker, at_terminal(OPERATOR) as operator:
            told(OPERATOR, "start")
            made.await_state("RUNNING")
            does(looker, "Hold")
            made.await_state("HOLD")
            assert looker("Resume") == "NotPermitted"
            time.sleep(1.0)
            does(operator, "Resume")
            made.await_state("RUNNING")
            time.sleep(0.5)
            does(looker, "Stop")
        made.await_state("IDLE")
        rec = made.recorded(run_id)
        require_calm(rec)
        assert rec.meta["end_reason"] == "stopped by the operator"
        assert rec.meta["interrupted"]
        assert realtime.replay(rec).identical
        assert rec.samples["x_num_m"][-1] == 0.0
        folder = next(path for path in RUNS.glob("*/recording.h5") if path.stat().st_size).parent
        assert rights(folder / "recording.h5") == ("-rw-r-----", "rthyb", "rthyb")
        assert as_user(LOOKER, "test", "-r", str(folder / "recording.h5")).returncode == 0
        assert as_user(STRANGER, "test", "-r", str(folder / "recording.h5")).returncode
        words = labs.journal(SERVICE)
        for change in ("IDLE -> ZEROED", "ARMED -> RAMP_IN", "RUNNING -> HOLD"):
            assert change in words

    repeated("operator", attempt)


def reload_says(text: str) -> str:
    """Have systemd reload a rig file; return the daemon's word on it."""
    before = len(labs.journal(SERVICE))
    labs.RIG.write_text(text, encoding="utf-8")
    systemctl("reload", SERVICE)

    def word() -> str | None:
        found = re.search(r"(?:not reloaded: |limits reloaded).*", labs.journal(SERVICE)[before:])
        return found and found[0]

    return str(until(word, "what became of the reload"))


def test_limits_are_reloaded_by_systemctl_and_end_the_next_test() -> None:
    """A file with a typing error changes nothing, and no limit changes under a test that moves."""
    good = labs.rig_text()

    def attempt(made: Lab) -> None:
        try:
            reloads(made)
        finally:
            labs.RIG.write_text(good, encoding="utf-8")

    def reloads(made: Lab) -> None:
        pid, before = made.main_pid(), len(labs.journal(SERVICE))
        run_id = made.run_until("RUNNING", 300)
        # As `systemctl reload` does it, whose start would be a stall.
        os.kill(pid, signal.SIGHUP)
        time.sleep(0.5)
        with suppress(Refusal), Client(made.socket) as client:
            client.call("Stop")
        made.await_state("IDLE")
        require_calm(made.recorded(run_id))
        said = labs.journal(SERVICE)[before:]
        assert "not reloaded" in said, said
        assert "the state is RUNNING" in said, said
        told = reload_says(f"{good}\n[limit]\n")
        if "TRIPPED" in told:
            raise Stalled(told)
        assert told.startswith("not reloaded"), told
        assert f"{labs.RIG}" in told
        assert shown(SERVICE, "ActiveState") == "active"
        assert made.main_pid() == pid
        tight = '{ value = "0.05 mm", action = "ramp-out" }'
        told = reload_says(labs.rig_text({"rig.limits.tracking_error_m": tight}))
        if "TRIPPED" in told:
            raise Stalled(told)
        assert "tracking_error_m" in told
        run_id = made.run_until("RAMP_IN", 0, {"limits.ramp_in_s": "3"})
        made.await_state("IDLE")
        rec = made.recorded(run_id)
        require_calm(rec)
        assert rec.meta["real_time"]["cause"] == "tracking"
        assert realtime.replay(rec).identical

    repeated("reload", attempt)


# ---- the live view ------------------------------------------------------------------------------


def answers(url: str) -> int:
    """Return with what status an address answers."""
    try:
        with urlopen(url, timeout=20.0) as page:
            return int(page.status)
    except HTTPError as error:
        return error.code


def test_live_view_is_a_unit_of_its_own_that_may_look_hold_and_stop() -> None:
    """Its address is for group rthyb, its port for this PC, and its rights are a looker's."""
    address = Path("/run/rthyb-live/url")

    def heard(page: ClientConnection, kind: str) -> dict[str, Any]:
        while True:
            said = page.recv(timeout=20.0)
            found = json.loads(said) if isinstance(said, str) else {}
            if found.get("kind") == kind:
                return dict(found)

    def attempt(made: Lab) -> None:
        systemctl("start", LIVE)
        until(address.is_file, "the page's address")
        url = address.read_text(encoding="ascii").strip()
        assert rights(address)[1:] == ("rthyb-live", "rthyb")
        assert as_user(LOOKER, "cat", str(address)).stdout.strip() == url
        assert as_user(STRANGER, "cat", str(address)).returncode
        assert (answers(url), answers(url + "live.js")) == (200, 200)
        assert answers("http://127.0.0.1:8717/") == 403
        wrong = url.replace(url.split("/")[3], "x" * 32)
        assert answers(wrong) == 403
        said = Path(f"/proc/{made.main_pid(LIVE)}/status").read_text(encoding="ascii")
        facts = dict(re.findall(r"^(\w+):\s+(.*)$", said, re.M))
        assert facts["Uid"].split() == [str(pwd.getpwnam("rthyb-live").pw_uid)] * 4
        assert facts["CapEff"] == "0" * 16
        assert (facts["NoNewPrivs"], facts["Seccomp"]) == ("1", "2")
        listening = Path("/proc/net/tcp").read_text(encoding="ascii")
        assert re.findall(r"^ *\d+: (\S+) \S+ 0A", listening, re.M) == ["0100007F:220D"]

        at = url.replace("http", "ws") + "socket"
        with pytest.raises(InvalidStatus), connect(at, origin=Origin("http://example.org")):
            pass
        with connect(at, origin=Origin("http://127.0.0.1:8717"), max_queue=None) as page:
            assert heard(page, "hello")["commands"] == ["hold", "stop"]
            run_id = made.run_until("RUNNING", 200, {"test.duration_s": "30"})
            for command, state in (("hold", "HOLD"), ("resume", "HOLD"), ("stop", "IDLE")):
                page.send(json.dumps({"command": command}))
                answer = heard(page, "answer")
                if not answer["ok"] and command != "resume" and made.ended_early():
                    raise Stalled(answer["text"])
                assert answer["ok"] == (command != "resume"), answer
                made.await_state(state)
        rec = made.recorded(run_id)
        require_calm(rec)
        assert rec.meta["end_reason"] == "stopped by the operator"
        assert STATE["HOLD"] in rec.samples["state"]
        assert realtime.replay(rec).identical

    try:
        repeated("live", attempt)
    finally:
        systemctl("stop", LIVE, check=False)
    assert not address.exists()
    assert shown(LIVE, "Result") == "success"


# ---- what goes wrong ----------------------------------------------------------------------------

# A process that is started while the test runs is a stall on this one processor, whose kernel lets
# nobody in before its work is done. So everything is looked up before.


def assert_broken_off(run_id: str, made: Lab, log: np.ndarray) -> None:
    """The recording holds all up to the kill; the drive stopped by itself, in time.

    A daemon that hung may come to a last tick before the signal ends it: that one trips.
    """
    rec = made.recorded(run_id)
    trips = np.count_nonzero(rec.samples["state"] == STATE["TRIPPED"])
    if rec.samples["state"][-1 - trips] != STATE["RUNNING"]:
        raise Stalled("before it was killed")
    assert rec.meta["end_reason"] == ("tripped" if trips else "its process ended early")
    assert rec.meta["missing_rows"] == []
    ticks = rec.samples["tick"].astype(np.int64)
    gaps = np.flatnonzero(np.diff(ticks) > 1) if trips else ticks[:0]
    before = ticks[: gaps[0] + 1] if gaps.size else ticks
    np.testing.assert_array_equal(before, np.arange(before.size))
    assert realtime.replay(rec).identical
    told = (log["state"] == STATE["RUNNING"]) & (log["frames"] > 0)
    last = int(np.flatnonzero(told)[-1])
    stops = np.flatnonzero(log["phase"][last:] != loop.PHASES.index("following"))
    assert stops[0] <= loop.WATCHDOG_TICKS
    heard = np.count_nonzero((log["state"] == STATE["RUNNING"]) & (log["frames"] == 1))
    compared = assert_drive_heard(rec, log)
    assert heard - 2 <= compared
    print(f"{ticks.size} rows, {compared} commands as the drive decoded them")


def back_in_idle(made: Lab, restarts: int) -> None:
    """systemd has started the daemon anew, and it does nothing by itself."""
    until(lambda: made.restarts() > restarts, "a restart")
    until(lambda: shown(SERVICE, "ActiveState") == "active", "the service")
    after = made.status()
    if after["state"] == "TRIPPED":
        raise Stalled("tripped at rest")
    assert (after["state"], after["test"], after["run_id"]) == ("IDLE", None, "")


def test_killed_daemon_comes_back_in_idle_and_its_test_is_recorded_to_the_last_tick() -> None:
    def attempt(made: Lab) -> None:
        folder = RINGS.stat().st_ino
        daemon, restarts = made.main_pid(), made.restarts()
        run_id = made.run_until("RUNNING", 700)
        os.kill(daemon, signal.SIGKILL)
        back_in_idle(made, restarts)
        assert RINGS.stat().st_ino == folder
        assert_broken_off(run_id, made, made.end_drive())

    repeated("killed-daemon", attempt)


def test_killed_together_the_recording_goes_on_from_the_ring() -> None:
    """What the file has at the kill opens with plain h5py; the ring has the rest."""

    def attempt(made: Lab) -> None:
        pids, restarts = [made.main_pid(unit) for unit in (RECORDER, SERVICE)], made.restarts()
        run_id = made.run_until("RUNNING", 900)
        for pid in pids:
            os.kill(pid, signal.SIGKILL)
        until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids), "their end")
        status = read_status(RINGS)
        assert status is not None
        with h5py.File(Path(status.folder) / PART_NAME, "r") as file:
            before = file["samples"][:]
        back_in_idle(made, restarts)
        rec = made.recorded(run_id)
        assert 512 < before.size < rec.samples.size
        for field in before.dtype.names:
            np.testing.assert_array_equal(rec.samples[field][: before.size], before[field])
        assert_broken_off(run_id, made, made.end_drive())
        print(f"{before.size} rows in the file, {rec.samples.size - before.size} from the ring")

    repeated("killed-both", attempt)


def test_killed_recorder_is_started_again_and_no_row_is_lost() -> None:
    """Its start is work enough to have the test ramped out here, for skipped ticks."""

    def attempt(made: Lab) -> None:
        recorder = made.main_pid(RECORDER)
        run_id = made.run_until("RUNNING", 300)
        os.kill(recorder, signal.SIGKILL)

        def again() -> bool:
            found = read_status(RINGS)
            return found is not None and found.pid != recorder

        until(again, "another recorder")
        if not made.over():
            with Client(made.socket) as client, suppress(Refusal):
                client.call("Stop")
        rec = made.recorded(run_id)
        log = made.end_drive()
        assert rec.meta["missing_rows"] == []
        tripped = np.flatnonzero(rec.samples["state"] == STATE["TRIPPED"])
        if tripped.size:
            at_s = moment_s(rec, int(tripped[0]))
            raise Stalled("stalled", at_s, at_s)
        ticks = rec.samples["tick"].astype(np.int64)
        np.testing.assert_array_equal(ticks, np.arange(ticks.size))
        assert realtime.replay(rec).identical
        assert assert_drive_heard(rec, log) > 300

    repeated("killed-recorder", attempt)


def test_stop_of_the_unit_while_a_test_runs_ends_at_rest_with_status_0() -> None:
    def attempt(made: Lab) -> None:
        with labs.stop_at_a_word() as word:
            daemon = Path(f"/proc/{made.main_pid()}")
            run_id = made.run_until("RUNNING", 300)
            word.touch()
            until(lambda: not daemon.exists(), "the end of the service")
        # A machine that stalls trips the test: the unit fails then, and the attempt is in vain.
        over = ("inactive", "failed")
        until(lambda: shown(SERVICE, "ActiveState") in over, "systemd's word on it")
        ended = {name: shown(SERVICE, name) for name in ("Result", "ExecMainStatus")}
        rec = made.recorded(run_id)
        require_calm(rec)
        assert ended == {"Result": "success", "ExecMainStatus": "0"}
        assert RINGS.is_dir()
        log = made.end_drive()
        assert rec.meta["end_reason"] == "stopped by the operator"
        assert rec.meta["missing_rows"] == []
        assert (rec.samples["state"][-1], rec.samples["x_num_m"][-1]) == (STATE["IDLE"], 0.0)
        assert realtime.replay(rec).identical
        told = log["state"][log["frames"] > 0]
        begins = np.flatnonzero(told == STATE["RUNNING"])[0]
        assert STATE["TRIPPED"] not in told[begins:]

    repeated("stopped", attempt)


def test_daemon_that_hangs_is_ended_by_the_watchdog_and_comes_back_in_idle() -> None:
    def attempt(made: Lab) -> None:
        daemon, restarts = made.main_pid(), made.restarts()
        run_id = made.run_until("RUNNING", 400)
        begin = time.monotonic()
        os.kill(daemon, signal.SIGSTOP)
        back_in_idle(made, restarts)
        print(f"back after {time.monotonic() - begin:.1f} s")
        assert "Watchdog timeout" in labs.journal(SERVICE)
        assert_broken_off(run_id, made, made.end_drive())

    repeated("hanging", attempt)


# ---- the power fails ----------------------------------------------------------------------------


def test_power_fails_while_a_test_runs(request: pytest.FixtureRequest) -> None:
    """The next boot looks at what is left."""

    def about() -> dict[str, Any]:
        rows = read_status(RINGS)
        assert rows is not None
        return {"rows": rows.rows, "folder": rows.folder}

    labs.end_boot_in_motion(request, "cut", 1600, about)
