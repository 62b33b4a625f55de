"""`rthyb run --realtime` and `rthyb rig`: two processes, real frames, signals, kill -9."""

from __future__ import annotations

import itertools
import json
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from command_line import Rthyb
from realtime_bench import PATIENCE_S, ROWS, STALLED, STATE, process, require_calm
from realtime_lab import (
    NOT_SENT,
    Lab,
    TooEarly,
    assert_whole,
    cause_of,
    memory_folder,
    repeated,
)
from stalls import Stalled

from rthyb_rt.core import loop
from rthyb_rt.lab import realtime
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.virtual_rig import serving

pytestmark = pytest.mark.alone

FAREWELL = 3
"""Frames by which a controller that goes takes leave of its drive; they are in no row."""


@pytest.fixture
def runtime() -> Iterator[Path]:
    with memory_folder() as folder:
        yield folder


@pytest.fixture
def lab(tmp_path: Path, runtime: Path) -> Lab:
    return Lab(tmp_path, runtime)


# ---- two processes ------------------------------------------------------------------------------


@pytest.mark.parametrize("medium", ["socket", "pty"])
def test_test_runs_against_a_rig_in_another_process(lab: Lab, medium: str) -> None:
    def attempt(out: str) -> None:
        log = lab.folder / f"{out}.npy"
        wire = ("--socket", lab.folder / "s") if medium == "socket" else ("--pty",)
        drive = lab.drive(*wire, "--log", log, "--json")
        try:
            lab.rig_at(medium)
            status, _, err = lab.controller(out).end()
            drive.signal(signal.SIGINT)
            ended, _, _ = drive.end()
        finally:
            drive.kill()
        rec, seen = lab.recorded(out, err), np.load(log)
        assert_whole(rec)
        require_calm(rec)
        assert (status, ended) == (0, 0), err
        assert rec.meta["end_reason"] == "completed"
        # Ticks that the machine slept through at the very end are made up for as well.
        skipped = rec.meta["real_time"]["ticks"]["skipped"]
        assert ROWS <= np.count_nonzero(rec.samples["state"] == STATE["RUNNING"]) <= ROWS + skipped
        sent = rec.samples["flags"] & NOT_SENT == 0
        assert seen["refused"].max() == 0
        assert seen["frames"].sum() == np.count_nonzero(sent) + FAREWELL
        assert realtime.replay(rec).identical
        # What the drive decoded is what was recorded as sent, to the last nanometre.
        heard = seen[(seen["frames"] == 1) & (seen["state"] < len(STATE))]
        sent_m = rec.samples["x_cmd_m"][sent] + rec.replay.tares["displacement_m"]
        assert heard["x_m"][-1] == pytest.approx(sent_m[-1], abs=1e-9)

    repeated(attempt)


def test_without_a_link_a_virtual_rig_of_its_own_is_started_and_replay_agrees(
    lab: Lab, rthyb: Rthyb
) -> None:
    lab.rig()

    def attempt(out: str) -> None:
        status, printed, err = lab.controller(out).end()
        rec = lab.recorded(out, err)
        assert_whole(rec)
        require_calm(rec)
        assert status == 0, err
        assert "rthyb: no [link] in the rig file: running on a virtual rig in process " in err
        told = re.search(r"^rthyb: telemetry ring (\S+); .*: rthyb recover \1$", err, re.MULTILINE)
        assert told
        assert told[1].startswith((str(lab.runtime), "/run/rthyb"))
        assert rthyb("replay", lab.folder / out).out.startswith("bit-identical")
        for label in ("Punctuality", "Link", "Result"):
            assert label in printed
        assert list((lab.runtime / "rthyb").glob("*")) == []

    repeated(attempt)


def test_rig_outlives_its_controllers_whatever_becomes_of_them(
    lab: Lab, rthyb: Rthyb, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One is stopped by Ctrl-C, the next one killed; the drive stops itself within 20 ticks."""
    log = lab.folder / "drive.npy"
    lab.rig(f'kind = "socket"\nchannel = "{lab.folder / "s"}"')
    with_log = ("--socket", lab.folder / "s", "--log", log, "--json")
    drive = lab.drive(*with_log)

    def stopped(out: str) -> None:
        controller = lab.controller(out)
        try:
            lab.await_state(controller, "RUNNING")
            controller.signal(signal.SIGINT)
            status, _, err = controller.end()
        finally:
            controller.kill()
        rec = lab.recorded(out, err)
        assert_whole(rec)
        require_calm(rec)
        assert status == 0, err
        assert rec.meta["end_reason"] == "stopped by the operator"
        assert STATE["RAMP_OUT"] in rec.samples["state"]
        assert rec.samples["state"][-1] == STATE["IDLE"]

    left: list[Path] = []
    shown: list[Any] = []

    def rings_of(pid: int) -> list[dict[str, Any]]:
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(lab.runtime))
        answer = rthyb("recover", "--json")
        assert answer.code == 0
        assert answer.json["schema"] == "rthyb-rings/1"
        found: Any = answer.json["rings"]
        return [one for one in found if one["pid"] == pid]

    def killed(out: str) -> None:
        controller = lab.controller(f"killed-{out}")
        try:
            found = lab.await_state(controller, "RUNNING")
            shown[:] = rings_of(controller.process.pid)
        finally:
            controller.kill()
        if found is None:
            raise Stalled("over before it was killed")
        shown.extend(rings_of(controller.process.pid))
        left.append(found)

    try:
        repeated(stopped)
        repeated(killed)
        time.sleep(0.5)  # the drive's 20 ticks, and its way to rest
        drive.signal(signal.SIGTERM)
        status, out, _ = drive.end()
    finally:
        drive.kill()
    assert status == 0
    assert json.loads(out)["phase"] == "stopped"
    seen = np.load(log)
    following = np.flatnonzero(seen["phase"] == loop.PHASES.index("following"))
    begins = int(following[-1]) + 1
    assert seen["silent"][begins] == loop.WATCHDOG_TICKS
    assert (seen["phase"][begins:] != loop.PHASES.index("following")).all()
    assert seen["phase"][-1] == loop.PHASES.index("stopped")
    writing, gone = shown
    assert writing["path"] == gone["path"] == str(left[0])
    assert (writing["alive"], gone["alive"]) == (True, False)
    assert gone["test_name"] == "section5-t0.5"
    assert gone["ticks"] >= writing["ticks"] > 0
    assert gone["age_s"] > 0.0
    listed = rthyb("recover")
    assert "gone" in next(line for line in listed.out.splitlines() if str(left[0]) in line)
    answer = rthyb("recover", left[0], "--out", lab.folder / "recovered", "--json")
    assert answer.code == 0
    assert "its process ended early" in str(answer.json["end_reason"])
    assert answer.json["missing_rows"] == []
    rec = lab.recorded("recovered")
    assert rec.samples["state"][-1] == STATE["RUNNING"]
    assert rthyb("replay", lab.folder / "recovered").out.startswith("bit-identical")
    # Commands of the ring against those that the drive heard: the last tick may be missing.
    heard = int(seen["seq"][-1])
    sent = np.count_nonzero(rec.samples["flags"] & NOT_SENT == 0)
    assert heard - 1 <= sent <= heard


def test_second_ctrl_c_trips(lab: Lab) -> None:
    lab.rig()

    def attempt(out: str) -> None:
        controller = lab.controller(out)
        try:
            lab.await_state(controller, "RUNNING")
            controller.signal(signal.SIGTERM)
            lab.await_state(controller, "RAMP_OUT", 10)
            controller.signal(signal.SIGHUP)
            status, _, err = controller.end()
        finally:
            controller.kill()
        rec = lab.recorded(out, err)
        assert_whole(rec)
        if cause_of(rec) not in STALLED:
            assert status == 6, err
            assert rec.meta["end_reason"] == "tripped: the operator"
            assert rec.samples["state"][-1] == STATE["TRIPPED"]

    repeated(attempt)


@pytest.mark.parametrize("medium", ["socket", "pty"])
def test_power_cut_of_the_rig_trips_and_the_recording_opens(lab: Lab, medium: str) -> None:
    # Later after each attempt in which the controller was not under way yet.
    instants_s = itertools.count(3)

    def attempt(out: str) -> None:
        wire = ("--socket", lab.folder / "s") if medium == "socket" else ("--pty",)
        drive = lab.drive(*wire, "--fault", f"power-cut@{next(instants_s)}", "--json")
        try:
            lab.rig_at(medium)
            status, _, err = lab.controller(out, "--set", "test.duration_s=20").end()
            _, printed, _ = drive.end()
        finally:
            drive.kill()
        assert json.loads(printed)["power_cut"]
        # The rig may be gone before a slow machine has brought the controller to its wire.
        gone = (
            *("the socket does not exist", "no program is listening there", "no such device"),
            "the feedback stopped during zeroing",
        )
        if status == 3 and any(word in err for word in gone):
            raise TooEarly
        rec = lab.recorded(out, err)
        require_calm(rec, "link_lost")
        if STATE["RUNNING"] not in rec.samples["state"]:
            raise TooEarly
        assert status == 6, err
        cause = cause_of(rec)
        assert cause in ("link_down", "link_lost")
        assert rec.meta["end_reason"] == f"tripped: {cause.replace('_', ' ')}"
        assert rec.samples["state"][-1] == STATE["TRIPPED"]

    repeated(attempt)


# ---- bad use ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("link", "message"),
    [
        ('kind = "socket"\nchannel = "/nowhere/s"', "/nowhere/s: the socket does not exist"),
        ('kind = "serial"\nchannel = "/dev/ttyNONE"', "/dev/ttyNONE: no such device"),
    ],
)
def test_link_that_is_not_there_is_said_and_nothing_is_written(
    lab: Lab, rthyb: Rthyb, link: str, message: str
) -> None:
    rig = lab.rig(link)
    answer = rthyb("run", lab.folder / "test.toml", "--rig", rig, "--realtime", "--out", "out")
    assert answer.code == 3
    assert message in answer.err
    assert not (lab.folder / "out").exists()


def test_real_rig_that_nobody_has_commissioned_is_refused_before_its_link_is_touched(
    lab: Lab, rthyb: Rthyb
) -> None:
    with process(lab.folder, "rig", "--socket", lab.folder / "s", "--log", "log.npy") as drive:
        assert drive.line()
        rig = lab.rig(f'kind = "socket"\nchannel = "{lab.folder / "s"}"', virtual=False)
        answer = rthyb("run", lab.folder / "test.toml", "--rig", rig, "--realtime", "--out", "out")
        drive.signal(signal.SIGINT)
        assert drive.end()[0] == 0
    assert answer.code == 5
    assert "has not been commissioned" in answer.err
    assert not (lab.folder / "out").exists()
    assert np.load(lab.folder / "log.npy")["frames"].sum() == 0


def test_clock_without_real_time_is_a_mistake(rthyb: Rthyb) -> None:
    answer = rthyb("run", "--clock", "link")
    assert answer.code == 2
    assert "needs --realtime" in answer.err


def test_stepped_clock_runs_tick_by_tick_and_says_that_it_is_not_real_time(
    lab: Lab, rthyb: Rthyb
) -> None:
    rig = lab.rig()
    answer = rthyb(
        *("run", lab.folder / "test.toml", "--rig", rig, "--realtime", "--clock", "stepped"),
        *("--no-report", "--json"),
    )
    assert answer.code == 0
    assert "tick by tick" in answer.err
    assert "Note: The test did not run in real time." in answer.err
    live = answer.json["measures"]["live"]  # type: ignore[index]
    assert live["cause"] == "completed"
    assert live["skipped_ticks"] == live["lost_pairs"] == live["slips"] == 0


def test_stepped_clock_goes_with_the_pairs_of_a_rig_in_another_process(
    lab: Lab, rthyb: Rthyb
) -> None:
    drive = lab.drive("--pty")
    try:
        rig = lab.rig_at("pty")
        answer = rthyb(
            *("run", lab.folder / "test.toml", "--rig", rig, "--realtime", "--clock", "stepped"),
            *("--no-report", "--out", lab.folder / "out"),
        )
        drive.signal(signal.SIGINT)
        assert drive.end()[0] == 0
    finally:
        drive.kill()
    rec = lab.recorded("out")
    assert rec.replay.skips.size == 0
    # Nobody waits for it: the drive's own watchdog is what a stall of this process would end in.
    if cause_of(rec) not in STALLED:
        assert answer.code == 0
        # Ticks that the machine slept through at the very end are made up for as well.
        skipped = rec.meta["real_time"]["ticks"]["skipped"]
        assert ROWS <= np.count_nonzero(rec.samples["state"] == STATE["RUNNING"]) <= ROWS + skipped


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "the rig file has no [link]; choose --can"),
        (("--pty", "--can", "vcan0"), "--can and --pty cannot be combined"),
        (("--pty", "--fault", "burn@1"), "no such kind of fault; allowed are drop,"),
        (("--pty", "--drift-ppm", "200"), "found 200; must be from -199 to 199"),
        (("--pty", "--seconds", "0"), "must be above 0, up to 1e6 s"),
        (("--pty", "--log", "log.txt"), "a log must end with .npy or .h5"),
        (("--can", "no/interface"), "a CAN interface has a name such as"),
    ],
)
def test_rig_that_cannot_be_understood_is_a_mistake(
    arguments: tuple[str, ...], message: str, rthyb: Rthyb
) -> None:
    answer = rthyb("rig", *arguments)
    assert answer.code == 2
    assert message in answer.err


def test_two_rigs_at_one_socket_are_one_too_many(lab: Lab, rthyb: Rthyb) -> None:
    path = lab.folder / "s"
    with process(lab.folder, "rig", "--socket", path) as first:
        assert first.line()
        answer = rthyb("rig", "--socket", path)
        assert answer.code == 3
        assert "another" in answer.err
        first.signal(signal.SIGINT)
        assert first.end()[0] == 0
    assert not path.exists()


def test_signal_ends_the_rig_at_whatever_instant_it_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python runs its handler in the thread that waits for it, between any two of its steps."""

    def hangs(*_: object) -> None:
        raise AssertionError("the signal's handler waits for the thread that it interrupted")

    monkeypatch.setattr(serving, "_LOOK_S", 0.0)
    drives = SimpleNamespace(ticks=0, drives=[SimpleNamespace(phase="following", rate_hz=1024.0)])
    line = SimpleNamespace(tend=lambda _: True)
    watcher = SimpleNamespace(look=lambda: None)
    main = threading.get_ident()
    with handled(signal.SIGUSR1, hangs):
        for number in range(50):
            stop = virtual_rig.StopRequest()
            patience = threading.Timer(PATIENCE_S, signal.pthread_kill, (main, signal.SIGUSR1))
            with handled(signal.SIGALRM, lambda *_, stop=stop: stop.set()):
                patience.start()
                signal.setitimer(signal.ITIMER_REAL, 1e-3 + 1e-5 * number)
                try:
                    serving._look_after(
                        drives, [(line, None)], virtual_rig.RigPlan(), stop, watcher
                    )
                finally:
                    patience.cancel()


@contextmanager
def handled(signum: int, handler: Callable[..., None]) -> Iterator[None]:
    before = signal.signal(signum, handler)
    try:
        yield
    finally:
        signal.signal(signum, before)


def test_rig_ends_after_its_seconds_and_writes_its_log(lab: Lab, rthyb: Rthyb) -> None:
    answer = rthyb("rig", "--pty", "--seconds", "0.2", "--log", "log.h5")
    assert answer.code == 0
    assert "Phase     stopped" in answer.out
    import h5py

    with h5py.File(lab.folder / "log.h5") as file:
        log = file["drive_log"][()]
        assert json.loads(file["drive_log"].attrs["phases"]) == list(loop.PHASES)
    assert log.size >= 200
    assert (log["frames"] == 0).all()
