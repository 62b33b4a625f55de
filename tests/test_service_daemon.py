"""`rthyb serve` and its recorder as processes: signals, kill -9, systemd's words, units.

Every row that a killed test leaves is compared with the log of the drive at the other end.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import logging
import os
import re
import select
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import stalls
from command_line import Rthyb
from realtime_bench import ATTEMPTS, PROGRAM, STALLED, STATE, Process, require_calm, until
from recording_data import recording as made_up
from service_bench import ROOT, await_state, rig_file, served, short_test
from stalls import Stalled

from rthyb_rt import config
from rthyb_rt.core import FLAGS, loop, ticker
from rthyb_rt.lab import experiment, realtime
from rthyb_rt.record import recording
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.record.ring import Ring, session_path
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.commissioning import certificate
from rthyb_rt.rig.commissioning.guided_motion import command_numbers
from rthyb_rt.rig.links import opening
from rthyb_rt.service import daemon as daemons
from rthyb_rt.service import installing, systemd
from rthyb_rt.service.control import Client, Refusal
from rthyb_rt.service.daemon import Daemon, record_of
from rthyb_rt.service.rig_engine import Engine, StateError
from rthyb_rt.service.ring_recorder import read_index, read_status

pytestmark = pytest.mark.alone


class Lab:
    """A rig at a socket, and a service for it; all in folders of its own."""

    def __init__(self, folder: Path, memory: Path) -> None:
        self.folder, self.rings, self.runs = folder, memory / "rings", folder / "runs"
        self.rings.mkdir()
        self.log, self.socket = folder / "drive.npy", self.rings / "control.sock"
        link = f'\n[link]\nkind = "socket"\nchannel = "{memory / "wire"}"\nvirtual = true\n'
        (folder / "rig.toml").write_text(config.dump(rig_file()) + link, encoding="utf-8")
        self.processes: list[Process] = []
        self.drive = self._process("rig", "rig.toml", "--log", self.log)
        assert self.drive.line().strip().endswith("1024 Hz")

    def _process(self, *arguments: object, env: dict[str, str] | None = None) -> Process:
        made = Process(self.folder, *arguments, env=env)
        self.processes.append(made)
        return made

    def serve(self, recorder: str = "own", env: dict[str, str] | None = None) -> Process:
        """Start the daemon and wait until it answers."""
        made = self._process(
            "serve",
            "rig.toml",
            "--rings",
            self.rings,
            "--runs",
            self.runs,
            "--recorder",
            recorder,
            env=env,
        )
        said = made.remark()
        while said and "ready" not in said:
            said = made.remark()
        assert said, made.end()
        return made

    def status(self) -> dict[str, Any]:
        with Client(self.socket) as client:
            found: dict[str, Any] = client.call("GetStatus")["status"]
            return found

    def run_until(self, state: str, ticks: int = 300, changes: dict[str, str] | None = None) -> str:
        """Load, zero, arm and start a test; return its run once it is that far."""
        test = short_test({"test.duration_s": "6"} | (changes or {}))
        record = record_of(experiment.load_motion(test))
        until(lambda: bool(self.status()["follows"]), "a drive that follows")
        try:
            with Client(self.socket) as client:
                digest = client.call("Load", test_toml=config.dump(test), record=record)["digest"]
                client.call("Zero")
                self.await_state("ZEROED")
                until(self._recorder_is_there, "the recorder")
                token = client.call("Arm", digest=digest)["token"]
                client.call("Start", token=token)
        except Refusal as error:
            self.require_calm_at_rest(error)
            raise
        self.await_state(state)
        until(lambda: self.status()["progress"]["ticks"] >= ticks or self.over(), "the test")
        run_id = str(self.status()["run_id"])
        self.require_under_way(run_id)
        return run_id

    def require_under_way(self, run_id: str) -> None:
        """Fail where the test has ended; raise `Stalled` where a stall ended it."""
        found = self.status()
        if not run_id or found["run_id"] != run_id:
            require_calm(self.recorded(found["last"]["run_id"]))
            pytest.fail(found["last"]["end_reason"])

    def require_calm_at_rest(self, seen: object = "") -> None:
        """Raise `Stalled` where a stall has stopped the drive or tripped the service at rest."""
        found = self.status()
        if found["cause"] in STALLED or not found["follows"]:
            raise Stalled(f"{found['cause']} {seen}")

    def _recorder_is_there(self) -> bool:
        found = self.status()
        return not found["recorder"]["wanted"] or found["recorder"]["run_id"] == found["run_id"]

    def over(self) -> bool:
        return self.status()["run_id"] == ""

    def await_state(self, state: str) -> None:
        until(lambda: self.status()["state"] == state or self.over(), state)

    def recorded(self, run_id: str) -> RecordedTest:
        """Wait for the recording of a run."""

        def entry() -> dict[str, Any] | None:
            return next((e for e in read_index(self.runs) if e["run_id"] == run_id), None)

        until(lambda: entry() is not None, "a line of the index")
        found = entry()
        assert found is not None
        return recording.open_run(self.runs / found["folder"])

    def end_drive(self) -> np.ndarray:
        """Stop the rig; return what it saw and did."""
        self.drive.signal(signal.SIGTERM)
        self.drive.end()
        log: np.ndarray = np.load(self.log)
        return log

    def close(self) -> None:
        for made in self.processes:
            made.kill()


@contextmanager
def lab() -> Iterator[Lab]:
    memory = Path("/dev/shm")
    with (
        TemporaryDirectory() as folder,
        TemporaryDirectory(dir=memory if memory.is_dir() else None) as rings,
    ):
        made = Lab(Path(folder), Path(rings))
        try:
            yield made
        finally:
            made.close()


def repeated(attempt: Callable[[Lab], None]) -> None:
    """Try again where the machine stalled, which ends a test in its own way."""

    def with_lab(_: int) -> None:
        with lab() as made:
            attempt(made)

    stalls.repeated(with_lab, ATTEMPTS)


def assert_drive_heard(rec: RecordedTest, log: np.ndarray) -> int:
    """Hold every command of RUNNING against what the drive decoded under its number; how many.

    Numbers begin at another one on each side. Of two commands in one of its ticks the drive's log
    has the newer one alone.
    """
    rows = rec.samples
    running = rows["state"] == STATE["RUNNING"]
    tare_m = rec.replay.tares["command_m"]
    counts = np.round((rows["x_cmd_m"][running] + tare_m) * 1e9).astype(np.int64).tolist()
    sent = dict(zip(command_numbers(rows)[running].tolist(), counts, strict=True))
    told = (log["state"] == STATE["RUNNING"]) & (log["frames"] > 0)
    decoded = np.round(log["x_m"][told] * 1e9).astype(np.int64).tolist()
    heard = dict(zip(log["seq"][told].tolist(), decoded, strict=True))
    middle = sorted(heard)[len(heard) // 2]
    shifts = [middle - number for number, x in sent.items() if x == heard[middle]]

    def common(shift: int) -> list[tuple[int, int]]:
        return [(x, heard[n + shift]) for n, x in sent.items() if n + shift in heard]

    assert shifts, "the drive heard a command that nobody recorded"
    best = max((common(shift) for shift in shifts), key=lambda c: sum(a == b for a, b in c))
    assert all(a == b for a, b in best)
    return len(best)


# ---- a day in the lab ---------------------------------------------------------------------------


def test_killed_daemon_comes_back_in_idle_and_its_test_is_recorded_to_the_last_tick() -> None:
    def attempt(made: Lab) -> None:
        daemon = made.serve()
        run_id = made.run_until("RUNNING", 700)
        daemon.process.kill()
        rec = made.recorded(run_id)
        made.serve()
        after = made.status()
        assert after["state"] == "IDLE"
        assert after["test"] is None
        time.sleep(0.2)
        assert made.status()["state"] == "IDLE"
        log = made.end_drive()
        if rec.samples["state"][-1] != STATE["RUNNING"]:
            raise Stalled("before it was killed")
        assert rec.meta["end_reason"] == "its process ended early"
        assert rec.meta["missing_rows"] == []
        running = np.count_nonzero(rec.samples["state"] == STATE["RUNNING"])
        assert running >= 700
        ticks = rec.samples["tick"].astype(np.int64)
        np.testing.assert_array_equal(ticks, np.arange(ticks.size))
        assert realtime.replay(rec).identical
        told = (log["state"] == STATE["RUNNING"]) & (log["frames"] > 0)
        last = int(np.flatnonzero(told)[-1])
        stops = np.flatnonzero(log["phase"][last:] != loop.PHASES.index("following"))
        assert stops[0] <= loop.WATCHDOG_TICKS
        assert (log["state"][last + 1 :] != STATE["RUNNING"])[log["frames"][last + 1 :] > 0].all()
        heard = np.count_nonzero((log["state"] == STATE["RUNNING"]) & (log["frames"] == 1))
        compared = assert_drive_heard(rec, log)
        assert heard - 2 <= compared <= running
        print(f"{rec.samples.size} rows, {compared} commands as the drive decoded them")

    repeated(attempt)


def test_killed_recorder_costs_no_row_and_sigterm_ends_at_rest() -> None:
    """The daemon has it started again; the drive's log has every command of the recording."""

    def attempt(made: Lab) -> None:
        daemon = made.serve()
        # Longer than a slow machine takes to start two recorders: SIGTERM ends it.
        run_id = made.run_until("RUNNING", 300, {"test.duration_s": "120"})
        for _ in range(2):
            status = read_status(made.rings)
            assert status is not None
            os.kill(status.pid, signal.SIGKILL)
            old = status.pid

            def again(old: int = old) -> bool:
                found = read_status(made.rings)
                return found is not None and found.pid != old and found.run_id == run_id

            until(lambda: again() or made.over(), "another recorder")
            made.require_under_way(run_id)
        daemon.signal(signal.SIGTERM)
        status_code, _, err = daemon.end()
        rec = made.recorded(run_id)
        require_calm(rec)
        log = made.end_drive()
        assert status_code == 0, err
        assert rec.meta["end_reason"] == "stopped by the operator"
        assert rec.meta["missing_rows"] == []
        assert rec.samples["state"][-1] == STATE["IDLE"]
        assert rec.samples["x_num_m"][-1] == 0.0
        assert rec.meta["real_time"]["ticks"]["skipped"] == np.count_nonzero(
            rec.samples["flags"] & FLAGS["blind"]
        )
        assert realtime.replay(rec).identical
        assert assert_drive_heard(rec, log) > 300
        assert STATE["TRIPPED"] not in log["state"][log["frames"] > 0]
        assert len(re.findall("the recorder ended with status -9; it has been restarted", err)) == 2

    repeated(attempt)


def test_second_sigterm_trips_and_systemd_hears_it_all() -> None:
    def attempt(made: Lab) -> None:
        words: list[str] = []
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journal:
            path = made.folder / "notify"
            journal.bind(str(path))
            done = threading.Event()

            def listen() -> None:
                while not done.is_set() or select.select([journal], [], [], 0.0)[0]:
                    if select.select([journal], [], [], 0.05)[0]:
                        words.extend(journal.recv(4096).decode().splitlines())

            listener = threading.Thread(target=listen)
            listener.start()
            env = {"NOTIFY_SOCKET": str(path), "WATCHDOG_USEC": "400000", "JOURNAL_STREAM": "1:2"}
            try:
                daemon = made.serve("none", env)
                run_id = made.run_until("RUNNING", 1300)
                daemon.signal(signal.SIGTERM)
                until(lambda: "STOPPING=1" in words, "the first signal's effect")
                daemon.signal(signal.SIGTERM)
                status, _, err = daemon.end()
            finally:
                done.set()
                listener.join()
        assert status == 6, err
        assert words[0] == "READY=1"
        assert words.count("WATCHDOG=1") >= 2
        assert "STOPPING=1" in words
        assert any(re.match(r"STATUS=RUNNING, section5-t0.5 \d+ of 6 s", word) for word in words)
        assert re.search(r"^<2>.* -> TRIPPED at tick \d+ \(section5-t0.5\), cause:", err, re.M)
        assert re.search(r"^<6>IDLE -> ZEROED at tick \d+", err, re.M)
        assert run_id

    repeated(attempt)


def test_nothing_begins_to_move_once_the_service_is_told_to_end(tmp_path: Path) -> None:
    """A start that comes between the signal and the next turn would let the whole test run."""
    test = short_test({"test.duration_s": "120"})
    record = record_of(experiment.load_motion(test))

    async def end_then_start(made: Daemon, token: str) -> list[str]:
        made.stop()
        refused = []
        for name, given in (("Start", {"token": token}), ("Resume", {}), ("Zero", {})):
            try:
                await made.dispatcher.methods[name].handle(ROOT, given)
            except StateError as error:
                refused.append(str(error))
        return refused

    with served(tmp_path) as made:
        with Client(made.options.socket) as client:
            digest = client.call("Load", test_toml=config.dump(test), record=record)["digest"]
            client.call("Zero")
            await_state(tmp_path, "ZEROED")
            token = client.call("Arm", digest=digest)["token"]
        assert made._server is not None
        assert made._server._accepting is not None
        loop = made._server._accepting.get_loop()
        refused = asyncio.run_coroutine_threadsafe(end_then_start(made, token), loop).result(20.0)
        assert len(refused) == 3
        assert all("the service is shutting down" in words for words in refused)
        until(lambda: not made.options.socket.exists(), "its end")
        assert made.engine.state == "ARMED"


def test_service_that_is_told_to_end_stops_what_moves_all_the_same(tmp_path: Path) -> None:
    """Whatever began to move after the signal is ramped out as well."""
    test = short_test({"test.duration_s": "120"})
    record = record_of(experiment.load_motion(test))
    with served(tmp_path) as made:
        with Client(made.options.socket) as client:
            digest = client.call("Load", test_toml=config.dump(test), record=record)["digest"]
            client.call("Zero")
            await_state(tmp_path, "ZEROED")
            client.call("Start", token=client.call("Arm", digest=digest)["token"])
        await_state(tmp_path, "RUNNING")
        made._stops = 1
        until(lambda: not made.options.socket.exists(), "its end")
        assert made.engine.last is not None
        assert made.engine.last["end_reason"] == "stopped by the operator"


def test_rings_at_rest_of_killed_daemons_are_cleared_and_no_others(tmp_path: Path) -> None:
    """Each has 10 MB of memory; that of a test is the recorder's, and one in use is somebody's."""
    made = {}
    named = (("dead", "rest"), ("bare", "test"), ("test", "test"), ("alive", "rest"))
    for name, purpose in named:
        session = made_up()
        session.meta["service"] = {"run_id": name, "purpose": purpose, "digest": ""}
        made[name] = Ring.create(tmp_path, session, 64)
    for name in ("dead", "bare", "test"):
        # As a kill leaves it.
        made[name]._owned.close()
    session_path(made["bare"].path).unlink()
    torn = tmp_path / "ring.0.9"
    torn.write_bytes(b"torn")
    daemons._clear_rests(tmp_path)
    assert not made["dead"].path.exists()
    assert not made["bare"].path.exists()
    assert not session_path(made["dead"].path).exists()
    for name in ("test", "alive"):
        assert made[name].path.exists()
        assert session_path(made[name].path).exists()
    assert torn.exists()
    made["alive"].remove()


def test_second_daemon_at_one_socket_is_refused(tmp_path: Path) -> None:
    def attempt(made: Lab) -> None:
        made.serve("none")
        second = made._process("serve", "rig.toml", "--rings", made.rings, "--recorder", "none")
        status, _, err = second.end()
        assert status == 3, err
        assert "has it open as controller" in err
        made.require_calm_at_rest()
        assert made.status()["state"] == "IDLE"

    repeated(attempt)


def test_rig_that_was_never_commissioned_is_not_served(rthyb: Rthyb, tmp_path: Path) -> None:
    link = '\n[link]\nkind = "socket"\nchannel = "wire"\n'
    (tmp_path / "rig.toml").write_text(config.dump(rig_file()) + link, encoding="utf-8")
    answer = rthyb("serve", "rig.toml", "--rings", tmp_path / "rings")
    assert answer.code == 5
    assert "has not been commissioned" in answer.err


def test_real_rig_asks_for_real_time_and_a_virtual_one_does_not() -> None:
    from rthyb_rt.cli.serve import _requires_realtime
    from rthyb_rt.config.rigfile import LinkTable

    def asks(**link: Any) -> bool:
        given = LinkTable(kind="socket", channel="wire", **link)
        return _requires_realtime(rig_file().model_copy(update={"link": given}))

    assert asks()
    assert not asks(virtual=True)
    assert not asks(require_realtime=False)
    assert asks(virtual=True, require_realtime=True)
    assert not _requires_realtime(rig_file())


# ---- systemd ------------------------------------------------------------------------------------


def test_words_go_nowhere_without_systemd(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    assert not systemd.notify("READY=1")
    monkeypatch.setenv("NOTIFY_SOCKET", "/nowhere/at/all")
    assert not systemd.notify("READY=1")
    monkeypatch.setenv("WATCHDOG_USEC", "2000000")
    monkeypatch.delenv("WATCHDOG_PID", raising=False)
    assert systemd.watchdog_s() == 2.0
    monkeypatch.setenv("WATCHDOG_PID", "1")
    assert systemd.watchdog_s() is None


def test_log_that_nobody_takes_holds_up_nobody_and_says_what_was_lost() -> None:
    """A terminal after Ctrl-S, or a journal whose disk is stuck: stop and hold must be heard."""
    read, write = os.pipe()
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, 4096)
    with os.fdopen(write, "w") as stream:
        handler = systemd.Behind(stream)
        line = "x" * 99
        begin = time.monotonic()
        for number in range(2000):
            args = (number,)
            handler.emit(logging.LogRecord("", logging.INFO, "", 0, f"%d {line}", args, None))
        handler.close()
        took_s = time.monotonic() - begin
        # A second is what the end waits for; a line takes no time.
        assert took_s < systemd._LAST_LINES_S + 2.0
        heard = b""
        end = time.monotonic() + 20.0
        while b"lines were lost" not in heard and time.monotonic() < end:
            if select.select([read], [], [], 0.1)[0]:
                heard += os.read(read, 1 << 16)
    os.close(read)
    lines = heard.decode().splitlines()
    kept = [int(text.split()[0]) for text in lines[:-1]]
    assert kept == sorted(kept)
    assert lines[-1].endswith("lines were lost because nothing read them")
    assert int(lines[-1].split()[0]) + len(kept) == 2000


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    program = tmp_path / "opt" / "bin" / "rthyb"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    installing.install(tmp_path, program, config.dump(rig_file()))
    return tmp_path


def test_every_file_is_installed_and_taken_away_but_the_rig(installed: Path) -> None:
    for place in installing.PLACES.values():
        text = (installed / place).read_text(encoding="utf-8")
        assert "@RTHYB@" not in text
    assert {path.name for path in installing.sources().iterdir()} == set(installing.PLACES)
    rig = installed / installing.RIG
    rig.write_text("mine")
    installing.install(installed, Path("/opt/rthyb/bin/rthyb"), "other")
    assert rig.read_text() == "mine"
    removed = installing.remove(installed)
    assert len(removed) == len(installing.PLACES)
    assert rig.exists()
    assert installing.remove(installed) == []


def test_install_service_says_what_it_wrote_and_what_comes_next(
    rthyb: Rthyb, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installing, "HIDDEN", ())
    root = tmp_path / "system"
    answer = rthyb("install-service", "--root", root, "--rig", "delay-10-elastic", "--json")
    assert answer.code == 0, answer.err
    assert "systemctl enable --now rthyb-recorder rthyb" in answer.err
    files = answer.json["files"]
    assert isinstance(files, list)
    assert len(files) == len(installing.PLACES) + 1
    assert config.load_rig(root / installing.RIG).rig.name == "delay-10-elastic"
    assert f"ExecStart={installing.program()} serve" in (
        root / installing.PLACES["rthyb.service"]
    ).read_text(encoding="utf-8")
    assert rthyb("install-service", "--root", root, "--uninstall").out.count("Removed") == 11


def test_rig_that_was_commissioned_is_so_for_the_service_too(
    rthyb: Rthyb, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The certificate lies beside the operator's file, which the service never sees."""
    monkeypatch.setattr(installing, "HIDDEN", ())
    link = '\n[link]\nkind = "socket"\nchannel = "wire"\n'
    own = tmp_path / "own" / "my-rig.toml"
    own.parent.mkdir()
    own.write_text(config.dump(rig_file()) + link, encoding="utf-8")
    rig = config.load_rig(own)
    made = certificate.Certificate(rig.rig.name, certificate.rig_hash(rig), False, "wire")
    steps = [certificate.CheckedStep(name, True, certificate.now()) for name in certificate.STEPS]
    for step in steps:
        made = made.with_step(step)
    certificate.write(certificate.place(own), made)
    root = tmp_path / "system"
    answer = rthyb("install-service", "--root", root, "--rig", own)
    assert answer.code == 0, answer.err
    installed = root / installing.RIG
    held, _ = certificate.find(config.load_rig(installed), installed)
    assert held == made
    kept = installed.with_name("rig.commissioned.json")
    assert f"Wrote {kept}" in answer.out
    assert kept.stat().st_mode & 0o777 == 0o644
    again = rthyb("install-service", "--root", root, "--rig", own)
    assert "already exists and was left unchanged" in again.err


def test_dbc_file_of_a_rig_goes_with_it(
    rthyb: Rthyb, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The service does not see the home in which rig and DBC file were written."""
    monkeypatch.setattr(installing, "HIDDEN", ())
    home = tmp_path / "home"
    home.mkdir()
    frames = Path(__file__).parents[1] / "hw" / "rthyb.dbc"
    shutil.copyfile(frames, home / "drive.dbc")
    link = '\n[link]\nkind = "can"\nchannel = "can0"\ndbc = "drive.dbc"\n'
    own = home / "my-rig.toml"
    own.write_text(config.dump(rig_file()) + link, encoding="utf-8")
    rig = config.load_rig(own)
    made = certificate.Certificate(rig.rig.name, certificate.rig_hash(rig), False, "can0")
    for name in certificate.STEPS:
        made = made.with_step(certificate.CheckedStep(name, True, certificate.now()))
    certificate.write(certificate.place(own), made)
    root = tmp_path / "system"
    answer = rthyb("install-service", "--root", root, "--rig", own)
    assert answer.code == 0, answer.err
    installed = root / installing.RIG
    assert 'dbc = "drive.dbc"' in installed.read_text(encoding="utf-8")
    assert str(home) not in installed.read_text(encoding="utf-8")
    beside = installed.with_name("drive.dbc")
    assert f"Wrote {beside}" in answer.out
    assert beside.read_bytes() == frames.read_bytes()
    assert beside.stat().st_mode & 0o777 == 0o644
    shutil.rmtree(home)
    found = config.load_rig(installed)
    assert found.link is not None
    assert found.link.dbc == str(beside)
    assert certificate.standing(found, installed).why_not == ""


def test_other_dbc_file_of_that_name_is_not_replaced(
    rthyb: Rthyb, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installing, "HIDDEN", ())
    frames = Path(__file__).parents[1] / "hw" / "rthyb.dbc"
    shutil.copyfile(frames, tmp_path / "drive.dbc")
    link = '\n[link]\nkind = "can"\nchannel = "can0"\ndbc = "drive.dbc"\n'
    (tmp_path / "my-rig.toml").write_text(config.dump(rig_file()) + link, encoding="utf-8")
    root = tmp_path / "system"
    beside = root / "etc" / "rthyb" / "drive.dbc"
    beside.parent.mkdir(parents=True)
    beside.write_text("mine")
    answer = rthyb("install-service", "--root", root, "--rig", "my-rig.toml")
    assert answer.code == 1
    assert f"{beside}: already exists and differs from" in answer.err
    assert beside.read_text() == "mine"
    assert not (root / installing.RIG).exists()


@pytest.fixture
def asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A log of what the programs of the system are asked for; none of them is the real one."""
    log, programs = tmp_path / "asked", tmp_path / "programs"
    programs.mkdir()
    for name in ("systemctl", "udevadm", "systemd-sysusers", "systemd-tmpfiles"):
        made = programs / name
        made.write_text(f'#!/bin/sh\necho {name} "$@" >>{log}\n')
        made.chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:/usr/bin:/bin")
    monkeypatch.setattr(installing, "HIDDEN", ())
    monkeypatch.setattr(installing, "needs_root", lambda _: False)
    log.touch()
    return log


def test_installed_files_are_made_known_before_devices_ask_for_them(
    rthyb: Rthyb, asked: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installing, "install", lambda *_: [])
    assert rthyb("install-service").code == 0
    said = asked.read_text().splitlines()
    can = "udevadm trigger --action=add --subsystem-match=net --sysname-match=can[0-9]*"
    assert said.index("systemctl daemon-reload") < said.index(can)
    assert said.index("udevadm control --reload") < said.index(can)


def test_units_are_ended_before_their_files_are_taken_away(
    rthyb: Rthyb, asked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def remove(_: Path) -> list[Path]:
        with asked.open("a") as log:
            log.write("remove\n")
        return [tmp_path / "rthyb.service"]

    monkeypatch.setattr(installing, "PLACES", {"there": str(asked)})
    monkeypatch.setattr(installing, "remove", remove)
    answer = rthyb("install-service", "--uninstall")
    assert answer.code == 0
    assert "warning" not in answer.err
    assert asked.read_text().splitlines() == [
        "systemctl disable --now rthyb-live rthyb rthyb-recorder",
        "systemctl stop rthyb-can@*.service",
        "remove",
        "systemctl daemon-reload",
        "udevadm control --reload",
    ]
    asked.unlink()
    assert rthyb("install-service", "--uninstall").code == 0
    # Nothing there: nothing to end.
    assert asked.read_text() == "remove\n"


def test_shell_is_told_what_may_come_next() -> None:
    env = {
        **os.environ,
        "_RTHYB_COMPLETE": "complete_bash",
        "COMP_WORDS": "rthyb ctl st",
        "COMP_CWORD": "2",
    }
    ran = subprocess.run(PROGRAM, env=env, capture_output=True, text=True, check=True)
    assert ran.stdout.split() == ["status", "start", "stop"]


def opened_here(device: Path) -> int:
    """Return how often this process has a file open."""
    found = 0
    for fd in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            found += os.readlink(f"/proc/self/fd/{fd}") == str(device)
    return found


def test_processors_are_kept_awake_from_the_start_of_a_service_to_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file plays the device: zero, four bytes, for as long as it is open."""
    device = tmp_path / "cpu_dma_latency"
    device.touch()
    monkeypatch.setattr(ticker, "LATENCY_DEVICE", str(device))
    rig = rig_file()
    ours, theirs = opening.socket_pair()
    with ours:
        companion = virtual_rig.Companion(rig, theirs.fd)
        theirs.close()
        made = Engine(rig, ours, clock="host", folder=tmp_path / "rings")
        try:
            assert opened_here(device) == 0
            made.start()
            until(lambda: made.loop.counts.elapsed > 10, "ticks")
            assert device.read_bytes() == bytes(4)
            assert opened_here(device) == 1
            assert "processors_awake" in made.loop.privileges
        finally:
            made.close()
            ours.close()
            companion.close()
    assert opened_here(device) == 0


def test_device_rules_are_what_udev_takes_without_a_word(installed: Path) -> None:
    if shutil.which("udevadm") is None:
        pytest.skip("udevadm is not on this machine")
    rules = installed / installing.PLACES["70-rthyb.rules"]
    ran = subprocess.run(["udevadm", "verify", rules], capture_output=True, text=True, check=False)
    if "verify" in ran.stderr and ran.returncode:
        pytest.skip("this udevadm cannot look at a file: systemd 254 can")
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "Fail: 0" in ran.stdout


def analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not on this machine")
    command = ["systemd-analyze", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def units(installed: Path) -> list[str]:
    folder = installed / "etc/systemd/system"
    template = folder / "rthyb-can@.service"
    template.rename(folder / "rthyb-can@can0.service")
    return sorted(str(path) for path in folder.iterdir())


def test_units_are_what_systemd_takes_without_a_word(installed: Path) -> None:
    ran = analyze("verify", "--man=no", *units(installed))
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "", "")


@pytest.mark.parametrize(
    ("unit", "most"), [("rthyb", 1.6), ("rthyb-recorder", 0.6), ("rthyb-live", 1.4)]
)
def test_units_are_exposed_as_little_as_is_promised(
    installed: Path, unit: str, most: float
) -> None:
    path = installed / "etc/systemd/system" / f"{unit}.service"
    ran = analyze("security", "--offline=true", "--no-pager", str(path))
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", ran.stdout)
    if found is None:
        pytest.skip(f"this systemd-analyze cannot look at a file: {ran.stderr}")
    print(f"{unit}: {found[1]}")
    assert float(found[1]) <= most


def test_groups_and_folders_are_what_the_units_mean(installed: Path) -> None:
    for program, arguments, place in (
        ("systemd-sysusers", ["--dry-run"], "rthyb.sysusers"),
        ("systemd-tmpfiles", ["--create", "--dry-run"], "rthyb.tmpfiles"),
    ):
        text = (installed / installing.PLACES[place]).read_text()
        assert "rthyb" in text
        help_text = ""
        if shutil.which(program) is not None:
            ran = subprocess.run([program, "--help"], capture_output=True, text=True, check=False)
            help_text = ran.stdout
        if "--dry-run" not in help_text:
            continue
        ran = subprocess.run(
            [program, *arguments, str(installed / installing.PLACES[place])],
            capture_output=True,
            text=True,
            check=False,
        )
        assert ran.returncode == 0, ran.stderr
    sysusers = (installed / installing.PLACES["rthyb.sysusers"]).read_text()
    assert re.search(r"^u rthyb ", sysusers, re.M)
    assert re.search(r"^g rthyb-operator ", sysusers, re.M)
    # The live view must not be the owner of the service, who may do everything.
    assert re.search(r"^u rthyb-live ", sysusers, re.M)
    unit = (installed / installing.PLACES["rthyb-live.service"]).read_text()
    assert re.findall(r"^(?:User|Group)=(.*)$", unit, re.M) == ["rthyb-live", "rthyb"]


def test_program_that_the_service_cannot_see_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    program = tmp_path / "bin" / "rthyb"
    program.parent.mkdir()
    program.write_text("")
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.setattr(sys, "executable", "/usr/bin/python3")
    monkeypatch.setattr(installing, "HIDDEN", (str(tmp_path),))
    with pytest.raises(Exception, match="which the service cannot see"):
        installing.program()
    monkeypatch.setattr(installing, "HIDDEN", ("/home",))
    assert installing.program() == program
    monkeypatch.setattr(sys, "executable", "/home/alice/.pyenv/bin/python3")
    with pytest.raises(Exception, match=r"alice/.pyenv/bin/python3 is in /home"):
        installing.program()
    # A name in /opt that leads to somebody's home, and sources that do.
    monkeypatch.setattr(sys, "executable", "/usr/bin/python3")
    hidden = tmp_path / "hidden" / "rthyb"
    hidden.parent.mkdir()
    program.rename(hidden)
    program.symlink_to(hidden)
    monkeypatch.setattr(installing, "HIDDEN", (str(hidden.parent),))
    with pytest.raises(Exception, match=f"{hidden} is in {hidden.parent}"):
        installing.program()
    monkeypatch.setattr(installing, "HIDDEN", (str(installing._PACKAGE.parent),))
    with pytest.raises(Exception, match=f"{installing._PACKAGE} is in"):
        installing.program()
    program.unlink()
    with pytest.raises(Exception, match="this installation has no program rthyb"):
        installing.program()
