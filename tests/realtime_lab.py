"""A laboratory's equipment: a test, rig files, `rthyb rig` and `rthyb run --realtime` processes.

A stall of the machine may end a test in real time, as intended: such a test is repeated, see
`stalls`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import stalls
from realtime_bench import ATTEMPTS, SHORT, STATE, Process, until

from rthyb_rt import config
from rthyb_rt.core import FLAGS
from rthyb_rt.errors import InputError
from rthyb_rt.record import recording, ring
from rthyb_rt.record.recording import RecordedTest

NOT_SENT = FLAGS["not_sent"]
CHUNK = 256


class TooEarly(Exception):
    """An event that should occur during motion came before it, because the controller was slow."""


@contextmanager
def memory_folder() -> Iterator[Path]:
    """A folder in memory, for the rings."""
    memory = Path("/dev/shm")
    with TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        yield Path(folder)


class Lab:
    """A folder with a short test, rigs, and processes that run them."""

    def __init__(self, folder: Path, runtime: Path) -> None:
        self.folder, self.runtime = folder, runtime
        test = config.load_test(config.builtin_test_path(), SHORT)
        (folder / "test.toml").write_text(config.dump(test), encoding="utf-8")
        self.plain = config.dump(config.load_rig(config.find_rig(test.rig)))

    def rig(self, link: str = "", *, virtual: bool = True) -> Path:
        """Write the rig file, which states that a virtual rig is at the other end of its link."""
        link += "\nvirtual = true" if link and virtual else ""
        path = self.folder / "rig.toml"
        path.write_text(self.plain + (f"\n[link]\n{link}\n" if link else ""), encoding="utf-8")
        return path

    def rig_at(self, medium: str) -> Path:
        """Write a rig file with a link to the virtual rig that was started last."""
        kind = "serial" if medium == "pty" else "socket"
        return self.rig(f'kind = "{kind}"\nchannel = "{self.channel}"')

    def drive(self, *arguments: object) -> Process:
        """Start a virtual rig and wait until it is ready."""
        made = Process(self.folder, "rig", *arguments)
        said = made.line() if "--json" not in arguments else made.remark()
        assert said.strip().endswith("1024 Hz"), (said, *made.end())
        self.channel = said.split(" at ")[1].split(",")[0]
        return made

    def controller(self, out: str, *arguments: object, rig: str = "rig.toml") -> Process:
        """Start a test in real time; its recording is stored in a folder of the lab."""
        return Process(
            self.folder,
            "run",
            "test.toml",
            "--rig",
            rig,
            "--realtime",
            "--no-report",
            "--out",
            out,
            *arguments,
            env={"XDG_RUNTIME_DIR": str(self.runtime)},
        )

    def ring_of(self, controller: Process) -> Path | None:
        """Return the ring that a controller's process writes."""
        found = self._reader_of(controller)
        if found is None:
            return None
        with found:
            return found.path

    def _reader_of(self, controller: Process) -> ring.RingReader | None:
        folders = (self.runtime / "rthyb", Path("/run/rthyb"))
        for path in (path for folder in folders if folder.is_dir() for path in ring.find(folder)):
            with suppress(InputError):
                reader = ring.RingReader(path)
                if reader.about["pid"] == controller.process.pid:
                    return reader
                reader.close()
        return None

    def await_state(self, controller: Process, state: str, ticks: int = 300) -> Path | None:
        """Wait until a controller has been in a state for a while; None: its test has ended."""
        seen = 0

        def is_over() -> bool:
            return controller.process.poll() is not None

        def there() -> bool:
            nonlocal seen
            while (rows := reader.read(CHUNK).samples).size:
                seen += np.count_nonzero(rows["state"] == STATE[state])
            return is_over() or seen >= ticks

        # A single mapping for all look-ups: repeated mapping stalls the ticks of a small machine.
        found = until(lambda: self._reader_of(controller) or is_over(), "the controller's ring")
        if found is True:
            return None
        with found as reader:
            until(there, f"{state} in the ring")
            return None if is_over() else reader.path

    def recorded(self, out: str, err: str = "") -> RecordedTest:
        assert (self.folder / out).is_dir(), err
        return recording.open_run(self.folder / out)


def repeated(attempt: Callable[[str], None]) -> None:
    """Call with a folder's name until neither a stall nor a slow start interferes."""

    def patient(number: int) -> None:
        for again in range(ATTEMPTS):
            try:
                attempt(f"attempt-{number + 1}-{again + 1}")
                return
            except TooEarly:
                print(f"attempt {number + 1}: too early")
        raise AssertionError(f"too early {ATTEMPTS} times")

    stalls.repeated(patient, ATTEMPTS)


def cause_of(rec: RecordedTest) -> str:
    return str(rec.meta["real_time"]["cause"])


def assert_whole(rec: RecordedTest) -> None:
    """Check that every tick has a row, regardless of stalls of the machine."""
    facts = rec.meta["real_time"]
    ticks = facts["ticks"]
    assert ticks["executed"] + ticks["skipped"] == ticks["elapsed"]
    assert facts["missed_rows"] == []
    tick = rec.samples["tick"].astype(np.int64)
    gaps = np.flatnonzero(np.diff(tick) != 1)
    # A stall of more than 20 ticks causes a trip, and further ticks are counted but not made up
    # for.
    assert (rec.samples["state"][gaps + 1] == STATE["TRIPPED"]).all()
    assert tick[0] == 0
    frozen = rec.samples["state"][-1] == STATE["TRIPPED"]
    assert frozen or tick[-1] + 1 == ticks["elapsed"]
