"""kill -9 at random moments of real tests, and at each write of the recorder's file.

Rig, daemon and recorder are processes of their own, as in a lab. The rig's log has each reading as
it left and each command as it came; no line of it passes through the tested parts, and every row
is compared with it.

    RTHYB_KILLS=500 python -m pytest tests/test_service_kills.py -s
"""

from __future__ import annotations

import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np
import pytest
from realtime_bench import STATE, until
from test_service_daemon import Lab, assert_drive_heard, lab

from rthyb_rt.core import FLAGS
from rthyb_rt.record import recording
from rthyb_rt.record.recording import FILE_NAME, RecordedTest
from rthyb_rt.service.control import Client, Refusal, UnreachableError
from rthyb_rt.service.growing import PART_NAME
from rthyb_rt.service.ring_recorder import read_status

pytestmark = pytest.mark.alone

KILLS = int(os.environ.get("RTHYB_KILLS", "4"))
"""How many; the long proof asks for 500."""
KILLS_A_RIG = 25
"""Then another rig with a new log, which has room for ten minutes."""
WHOM = (("recorder", 14), ("daemon", 1), ("both", 1))
"""Who is killed, and how often among all."""
TEST = {"test.duration_s": "12", "ground_motion.start_s": "0"}
MOVING = ("RAMP_IN", "RUNNING", "RAMP_OUT")
BEGINNINGS = 200
"""On a machine that is busy with something else most tests are over before they move."""
LAST_HEARD = 2
"""Commands on their way at a kill: they belong to rows of ticks that never came."""
WIRE_X_M, WIRE_F_N = 1e-9, 1e-3


@dataclass
class Tally:
    """What the kills came to.

    Attributes:
        killed: how often each of `WHOM`, while the specimen moved.
        readable: how often the file of the test opened with plain h5py after that.
        ended: how the recorded tests ended.
        rows, from_ring: of the recordings; of these, how many were in no file at the last kill.
        readings, commands: how many were held against the rig's log.
    """

    killed: Counter[str] = field(default_factory=Counter)
    readable: int = 0
    ended: Counter[str] = field(default_factory=Counter)
    rows: int = 0
    from_ring: int = 0
    readings: int = 0
    commands: int = 0

    def __str__(self) -> str:
        killed = ", ".join(f"{whom} {count}" for whom, count in sorted(self.killed.items()))
        ended = ", ".join(f"{how} {count}" for how, count in sorted(self.ended.items()))
        return (
            f"{self.killed.total()} kills ({killed}): {self.readable} readable files, 0 rows lost; "
            f"{self.ended.total()} tests ({ended}), {self.rows} rows, {self.from_ring} of them in "
            f"the ring alone at the last kill; {self.readings} readings and {self.commands} "
            "commands as the rig's log has them"
        )


# ---- what the rig says --------------------------------------------------------------------------


def answered_ticks(rec: RecordedTest, log: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows with a fresh reading, and the tick of the rig that each is of.

    The count in a frame is the low byte of the rig's tick; where it began, the readings say.
    """
    rows = np.flatnonzero(rec.samples["flags"] & FLAGS["fresh"])
    counts = rec.samples["count"][rows].astype(np.int64)
    # No more than 20 lost ticks in a row pass before the test is over.
    since = np.concatenate([[0], np.cumsum(np.diff(counts) % 256)])
    first = rec.samples[rows[0]]
    near = (np.abs(log["read_x_m"] - first["x_read_m"]) <= WIRE_X_M) & (
        np.abs(log["read_f_n"] - first["f_read_n"]) <= WIRE_F_N
    )
    begins = np.flatnonzero(near & (np.arange(log.size) % 256 == counts[0]))
    begins = begins[begins + since[-1] < log.size]
    assert begins.size, "the rig never gave the first reading of this recording"
    alike = [
        np.count_nonzero(same_readings(rec.samples[rows], log[begin + since])) for begin in begins
    ]
    return rows, begins[int(np.argmax(alike))] + since


def same_readings(rows: np.ndarray, entries: np.ndarray) -> np.ndarray:
    """Whether each row has the reading of the rig, as the wire rounds it."""
    x = np.abs(entries["read_x_m"] - rows["x_read_m"]) <= (0.5 + 1e-6) * WIRE_X_M
    f = np.abs(entries["read_f_n"] - rows["f_read_n"]) <= (0.5 + 1e-6) * WIRE_F_N
    return np.asarray(x & f)


def compare(rec: RecordedTest, log: np.ndarray, tally: Tally) -> None:
    """Hold every reading and every command of a recording against the rig's log."""
    rows, ticks = answered_ticks(rec, log)
    same = same_readings(rec.samples[rows], log[ticks])
    assert same.all(), f"{np.count_nonzero(~same)} readings are not the rig's"
    tally.readings += rows.size
    around = log[max(int(ticks[0]) - 10, 0) : int(ticks[-1]) + 30]
    if not (rec.samples["state"] == STATE["RUNNING"]).any():
        return
    compared = assert_drive_heard(rec, around)
    heard = np.count_nonzero((around["state"] == STATE["RUNNING"]) & (around["frames"] == 1))
    assert heard - LAST_HEARD <= compared
    tally.commands += compared


# ---- the kills ----------------------------------------------------------------------------------


_NURSERY = """
import json, os, signal, sys
import h5py, numpy
import rthyb_rt.service.ring_recorder, rthyb_rt.service.growing, rthyb_rt.service.daemon
import rthyb_rt.cli.recorder, rthyb_rt.cli.serve, rthyb_rt.rig.links.opening, rthyb_rt.report
from rthyb_rt.cli import main
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
print("there", flush=True)
for line in sys.stdin:
    pid = os.fork()
    if pid == 0:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.setsid()
        sys.stdout = open(os.devnull, "w")
        sys.argv = ["rthyb", *json.loads(line)]
        os._exit(main())
    print(pid, flush=True)
"""


class Nursery:
    """Starts commands of the program whose modules are loaded already: most of a start is that.

    Args:
        folder: where they run, and where what they say goes.
    """

    def __init__(self, folder: Path) -> None:
        self._log = (folder / "victims.log").open("wb")
        self._made = subprocess.Popen(
            [sys.executable, "-c", _NURSERY],
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            text=True,
        )
        self._line()

    def _line(self) -> str:
        assert self._made.stdout is not None
        said = self._made.stdout.readline().strip()
        assert said, "nobody is there to start anything"
        return said

    def start(self, *arguments: object) -> int:
        """Start a command; return its process."""
        assert self._made.stdin is not None
        self._made.stdin.write(json.dumps([*map(str, arguments)]) + "\n")
        self._made.stdin.flush()
        return int(self._line())

    def close(self) -> None:
        """End it, and nobody else."""
        self._made.communicate()
        self._log.close()


def lives(pid: int) -> bool:
    """Whether a process is there."""
    return Path(f"/proc/{pid}").exists()


class Victims:
    """Daemon and recorder of a lab, started again after each kill."""

    def __init__(self, made: Lab) -> None:
        self.lab, self.nursery = made, Nursery(made.folder)
        self._places = ("--rings", made.rings, "--runs", made.runs)
        self.pids: dict[str, int] = {}
        self.revive()

    def kill(self, whom: str) -> None:
        """Kill one or both at once, and see them gone."""
        dying = ["daemon", "recorder"] if whom == "both" else [whom]
        for name in dying:
            os.kill(self.pids[name], signal.SIGKILL)
        gone = [self.pids.pop(name) for name in dying]
        until(lambda: not any(map(lives, gone)), "their end")

    def revive(self) -> None:
        """Start again what was killed."""
        if "recorder" not in self.pids:
            self.pids["recorder"] = self.nursery.start("recorder", *self._places)
        if "daemon" not in self.pids:
            order = ("serve", "rig.toml", *self._places, "--recorder", "service")
            self.pids["daemon"] = self.nursery.start(*order)
            until(self._answers, "the daemon")

    def _answers(self) -> bool:
        with suppress(UnreachableError):
            return bool(self.lab.status())
        return False

    def close(self) -> None:
        """Kill who is left."""
        for pid in self.pids.values():
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.nursery.close()

    def at_work(self) -> bool:
        """Whether the recorder has said something since it was started."""
        found = read_status(self.lab.rings)
        return found is not None and found.pid == self.pids["recorder"]

    def begin_test(self) -> str:
        """Have a test run, whatever ended the one before; return its run."""
        until(self.at_work, "the recorder")
        for _ in range(BEGINNINGS):
            until(self._ready, "a rig at rest whose drive follows")
            try:
                return self.lab.run_until("RAMP_IN", 0, TEST)
            # A machine that stalls ends a test in its own way; then the next one.
            except (Exception, AssertionError) as error:
                print(f"no test: {error}")
                with Client(self.lab.socket) as client, suppress(Refusal):
                    client.call("Stop")
        pytest.fail("no test could be begun")

    def _ready(self) -> bool:
        """Whether a test may begin; what a stall has tripped, or a kill has stopped, is reset."""
        found = self.lab.status()
        if (found["state"] == "TRIPPED" or found["drive_stopped"]) and not found["run_id"]:
            with Client(self.lab.socket) as client, suppress(Refusal):
                client.call("Reset")
        return found["state"] == "IDLE" and not found["run_id"] and found["follows"]

    def moves(self, run_id: str) -> bool:
        """Whether a test is in motion."""
        try:
            found = self.lab.status()
        except UnreachableError:
            return False
        return found["run_id"] == run_id and found["state"] in MOVING


def rows_of(runs: Path, run_id: str) -> np.ndarray | None:
    """Return what the file of a test holds, as any program would read it; None: it does not open.

    Of one that is finished just now both names may be there.
    """
    for name in (PART_NAME, FILE_NAME):
        for path in runs.glob(f"*/{name}"):
            with suppress(OSError, KeyError, RuntimeError), h5py.File(path, "r") as file:
                if recording.plain(file.attrs["service"])["run_id"] == run_id:
                    found: np.ndarray = file["samples"][()]
                    return found
    return None


def assert_whole(rec: RecordedTest, files: list[np.ndarray]) -> None:
    """No row is missing, and what a killed recorder had written stands as it was.

    Ticks that are slept through once TRIPPED are nothing to make up for: they have no row.
    """
    assert rec.meta["missing_rows"] == []
    ticks, tripped = rec.samples["tick"].astype(np.int64), rec.samples["state"] == STATE["TRIPPED"]
    before = np.count_nonzero(~tripped)
    assert not tripped[:before].any()
    np.testing.assert_array_equal(ticks[:before], np.arange(before))
    assert (np.diff(ticks) > 0).all()
    for before in files:
        for name in before.dtype.names or ():
            np.testing.assert_array_equal(rec.samples[name][: before.size], before[name])


def kill_in_one_test(victims: Victims, wanted: int, chance: random.Random, tally: Tally) -> str:
    """Kill at random moments until a test is over; return its run."""
    run_id = victims.begin_test()
    files: list[np.ndarray] = []
    alive, killed = True, 0
    while alive and killed < wanted:
        # Now and then a recorder that is still about to take the file up again.
        if chance.random() < 0.75:
            until(lambda: victims.at_work() or not victims.moves(run_id), "the recorder")
        time.sleep(chance.uniform(0.0, 0.5))
        (whom,) = chance.choices(*zip(*WHOM, strict=True))
        if not victims.moves(run_id):
            break
        victims.kill(whom)
        killed += 1
        tally.killed[whom] += 1
        rows = rows_of(victims.lab.runs, run_id)
        if rows is None and whom == "daemon":
            # The recorder lives and finishes the file at this very moment.
            until(lambda: rows_of(victims.lab.runs, run_id) is not None, "a file that opens")
            rows = rows_of(victims.lab.runs, run_id)
        assert rows is not None, f"after a kill of {whom}: {sorted(victims.lab.runs.rglob('*'))}"
        tally.readable += 1
        # A recorder that was left alone goes on with the file: these rows are not its last word.
        if whom != "daemon":
            files.append(rows)
        alive = whom == "recorder"
        victims.revive()
    if alive:
        with Client(victims.lab.socket) as client, suppress(Refusal):
            client.call("Stop")
    rec = victims.lab.recorded(run_id)
    assert_whole(rec, files)
    tally.ended[str(rec.meta["end_reason"])] += 1
    tally.rows += rec.samples.size
    tally.from_ring += rec.samples.size - (files[-1].size if files else 0)
    return run_id


@pytest.mark.parametrize(
    ("blocks", "first_block", "pages"),
    [
        pytest.param(3, 0, 0, id="from its beginning"),
        pytest.param(3, 0, 1, id="torn", marks=pytest.mark.long),
        pytest.param(66, 63, 0, id="where the index branches", marks=pytest.mark.long),
        pytest.param(66, 63, 2, id="where it does, torn"),
    ],
)
def test_file_of_a_recorder_that_is_killed_at_any_of_its_writes_is_whole_and_gone_on_with(
    tmp_path: Path, blocks: int, first_block: int, pages: int
) -> None:
    """Chance finds the moment between two writes of one block once in thousands of kills."""
    killer = tmp_path / "write_killer.so"
    source = Path(__file__).with_name("write_killer.c")
    built = ["gcc", "-shared", "-fPIC", "-O1", source, "-ldl", "-o", killer]
    subprocess.run(built, check=True, capture_output=True)
    memory = Path("/dev/shm")
    with TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        program = Path(__file__).with_name("killed_writes.py")
        ran = subprocess.run(
            [sys.executable, program, folder, *map(str, (blocks, first_block, pages))],
            env={**os.environ, "LD_PRELOAD": str(killer)},
            capture_output=True,
            text=True,
            check=False,
        )
    print(ran.stdout)
    assert re.fullmatch(r"\d\d+ kills\n", ran.stdout), ran.stdout + ran.stderr


def test_whoever_is_killed_whenever_every_row_is_there_as_the_rig_logged_it() -> None:
    chance, tally = random.Random(11), Tally()
    while tally.killed.total() < KILLS:
        with lab() as made, ExitStack() as owned:
            victims, runs = Victims(made), []
            owned.callback(victims.close)
            wanted = min(tally.killed.total() + KILLS_A_RIG, KILLS)
            while tally.killed.total() < wanted:
                left = wanted - tally.killed.total()
                runs.append(kill_in_one_test(victims, left, chance, tally))
            recordings = [made.recorded(run_id) for run_id in runs]
            log = made.end_drive()
            for rec in recordings:
                compare(rec, log, tally)
        print(tally, flush=True)
    assert tally.readable == tally.killed.total() == KILLS
