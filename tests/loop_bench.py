"""Controller and virtual drive in lockstep over real frames, for tests of the tick."""

from __future__ import annotations

import array
import fcntl
import os
import socket
import struct
import subprocess
import termios
import time
import tty
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from typing import Any, Final

import numpy as np

from rthyb_rt import core
from rthyb_rt.core import loop, wire
from rthyb_rt.record.ring import Ring

H = core.PERIOD_S
K_N_PER_M, MASS_KG, DELAY = 666400.0, 4220.0, 6
ORIGIN_M, FORCE_BIAS_N = 0.0123, 45.0
FLAGS = core.FLAGS
STATE = {name: number for number, name in enumerate(core.STATES)}
CAN_FRAME: Final = struct.Struct("=IB3x8s")
BUS_OFF: Final = 0x2000_0040
CAN_RAW_ERR_FILTER: Final = 2  # linux/can/raw.h; Python's socket module lacks it
CAN_ERR_MASK: Final = 0x1FFF_FFFF
FULL_MASK: Final = 0xDFFF_FFFF  # identifier and its kind


def shaking(seconds: float, rate_hz: float = core.FS_HZ) -> np.ndarray:
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    return np.asarray(0.3 * np.sin(2 * np.pi * 1.7 * t) * np.sin(np.pi * t / seconds) ** 2)


def config(rate_hz: float = core.FS_HZ, **changes: Any) -> core.StationConfig:
    """Return the station of the bench, with the same durations at every rate."""
    law = changes.pop("law", core.LawConfig("paper", {"alpha0": 6.0}))
    pace = rate_hz / core.FS_HZ
    controller = core.ControllerConfig(
        law=law,
        rfc=core.RfcConfig(k_e_n_per_m=K_N_PER_M, window=round(51 * pace), period_s=1.0 / rate_hz),
        motion=core.MotionConfig(
            "central-difference",
            mass_kg=MASS_KG,
            damping_n_s_per_m=2121.0,
            k_e_n_per_m=K_N_PER_M,
            period_s=1.0 / rate_hz,
        ),
        velocity_limit_m_per_s=0.5,
        period_s=1.0 / rate_hz,
    )
    ticks = {"tare_ticks": 64, "ramp_in_ticks": 256, "armed_ticks": 500}
    base: dict[str, Any] = {name: round(count * pace) for name, count in ticks.items()}
    return core.StationConfig(controller=controller, **(base | changes))


def watched(name: str, value: float, reaction: core.Reaction) -> dict[str, Any]:
    return {"watches": {name: core.Watch(value, reaction)}}


def rig(
    bias_n: float = FORCE_BIAS_N, rate_hz: float = core.FS_HZ, delay_samples: int = DELAY
) -> core.VirtualRig:
    servo = core.ServoConfig("pure-delay", delay_samples=delay_samples, period_s=1.0 / rate_hz)
    return core.VirtualRig(
        core.RigConfig(
            servo,
            (core.element("stiffness", k_n_per_m=K_N_PER_M),),
            force=core.SensorConfig(bias=bias_n),
        )
    )


Ends = tuple[loop.Kind, wire.Codec, int, int]
"""Kind of link, its frames, the controller's descriptor, the drive's."""


def socket_pair(bench: Bench) -> Ends:
    pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    if bench.send_buffer:
        pair[0].setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, bench.send_buffer)
    bench.ends = [end.detach() for end in pair]
    return "can", wire.can(), bench.ends[0], bench.ends[1]


def pseudo_terminal(bench: Bench) -> Ends:
    master, slave = os.openpty()
    for fd in (master, slave):
        tty.setraw(fd)
        os.set_blocking(fd, False)
    bench.ends = [slave, master]
    return "stream", wire.serial(), slave, master


def can_socket(interface: str, ids: Sequence[int], fd: bool = False) -> socket.socket:
    """A raw non-blocking socket that receives only these identifiers and every error frame."""
    made = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    filters = b"".join(struct.pack("=II", can_id, FULL_MASK) for can_id in ids)
    made.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)
    made.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, CAN_ERR_MASK)
    made.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, int(fd))
    made.setblocking(False)
    made.bind((interface,))
    return made


def set_interface(name: str, *changes: str) -> None:
    """Change an interface of the kernel like ``ip link set``: "down", "up"."""
    subprocess.run(["ip", "link", "set", name, *changes], check=True)


_TAKEN: Final[set[str]] = set()


def _spare_interfaces(bench: Bench) -> tuple[str, str]:
    """Unused interfaces: one shared by both ends, or the two ends of a cable."""
    cable = os.environ.get("RTHYB_VXCAN", "").split(",")
    for names in ([os.environ["RTHYB_VCAN"]] * 2, cable):
        if len(names) == 2 and not _TAKEN & set(names):
            _TAKEN.update(names)
            bench.owned.callback(_TAKEN.difference_update, names)
            return names[0], names[1]
    raise AssertionError("no interface is left: set RTHYB_VXCAN to the two ends of a vxcan")


class Arrivals:
    """Counts the frames that arrive at one end of a CAN bus, independently of the link."""

    def __init__(self, witness: socket.socket) -> None:
        self.witness, self.seen = witness, 0

    def count(self) -> int:
        with suppress(OSError):
            while self.witness.recv(72):
                self.seen += 1
        return self.seen


def socket_can(bench: Bench) -> Ends:
    codec = bench.codec or wire.can()
    interfaces = bench.interfaces or _spare_interfaces(bench)
    bench.interface = interfaces[0]
    for name, ids in zip(interfaces, (codec.feedback_ids, (codec.command_id,)), strict=True):
        bench.ends.append(can_socket(name, ids, codec.is_fd).detach())
        witness = bench.owned.enter_context(can_socket(name, ids, codec.is_fd))
        bench.arrivals.append(Arrivals(witness))
    return "can", codec, bench.ends[0], bench.ends[1]


MEDIA: Final[dict[str, Callable[[Bench], Ends]]] = {
    "socketpair": socket_pair,
    "pty": pseudo_terminal,
    "vcan": socket_can,
}
CAN_MEDIA: Final = ("socketpair", "vcan") if "RTHYB_VCAN" in os.environ else ("socketpair",)
"""Available media for CAN frames; kernel interfaces only if the environment names one."""


class Bench:
    """Controller and drive in lockstep, with the logs of both.

    ``medium`` names one of `MEDIA`, which opens both ends and stores in ``ends`` what `unplug` must
    close; ``codec`` replaces its frames, ``interfaces`` those that "vcan" would find. Both tick at
    ``rate_hz``, and the rig has a delay of ``delay_samples`` at that rate.
    """

    def __init__(
        self,
        medium: str = "socketpair",
        *,
        seconds: float = 2.0,
        send_buffer: int = 0,
        ring: Ring | None = None,
        clock: loop.Clock = "stepped",
        codec: wire.Codec | None = None,
        interfaces: tuple[str, str] | None = None,
        calibration: core.WireCalibration = core.IDENTITY,
        paced: bool = True,
        rate_hz: float = core.FS_HZ,
        delay_samples: int = DELAY,
        **changes: Any,
    ) -> None:
        self.owned = ExitStack()
        self.send_buffer = send_buffer
        self.ends: list[int] = []
        self.is_pty = medium == "pty"
        self.codec, self.interfaces, self.interface = codec, interfaces, ""
        self.arrivals: list[Arrivals] = []
        self.owned.callback(self.close_ends)
        kind, frames, ours, theirs = MEDIA[medium](self)
        self.codec = codec or frames
        self.link, self.far = loop.Link(kind, ours), loop.Link(kind, theirs)
        self.owned.callback(self.link.close)
        self.owned.callback(self.far.close)
        self.calibration = calibration
        at: dict[str, Any] = {} if rate_hz == core.FS_HZ else {"rate_hz": rate_hz}
        late: dict[str, Any] = {} if delay_samples == DELAY else {"delay_samples": delay_samples}
        self.config, self.ag = config(**at, **changes), shaking(seconds, **at)
        self.station = core.Station(self.config, self.ag)
        self.wire = wire.Wire(self.codec)
        self.loop = loop.Loop(
            self.station, self.wire, self.link, ring, clock, calibration, paced=paced
        )
        self.drive = loop.Drive(
            rig(**at, **late),
            self.codec,
            self.far,
            origin_m=ORIGIN_M,
            log_ticks=60000,
            seed=1,
            calibration=calibration,
        )
        self.records: list[np.ndarray] = []

    def unplug(self) -> None:
        """Close the channels of the links; a kernel interface goes down."""
        self.close_ends()
        if self.interface:
            set_interface(self.interface, "down")
            self.owned.callback(set_interface, self.interface, "up")

    def close_ends(self) -> None:
        while self.ends:
            os.close(self.ends.pop())

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        self.owned.close()

    def arrived(self, at: loop.Link, from_: loop.Link) -> None:
        """Wait until everything that was sent has arrived, however late."""
        if at.fd < 0 or from_.fd < 0:
            return
        if self.arrivals:
            self._frames_arrived(at is self.far, from_.counters()["pieces_out"])
        elif self.is_pty:
            self._bytes_arrived(at, from_)

    def _frames_arrived(self, side: int, wanted: int) -> None:
        end = time.monotonic() + 10.0
        while (seen := [arrivals.count() for arrivals in self.arrivals])[side] < wanted:
            assert time.monotonic() < end, f"{seen[side]} of {wanted} frames came"

    def _bytes_arrived(self, at: loop.Link, from_: loop.Link) -> None:
        waiting, end = array.array("i", [0]), time.monotonic() + 10.0
        wanted = from_.counters()["bytes_out"] - at.counters()["bytes_in"]
        while waiting[0] < wanted:
            fcntl.ioctl(at.fd, termios.FIONREAD, waiting)
            assert time.monotonic() < end, f"{waiting[0]} of {wanted} bytes came"

    def drive_ticks(self, n: int = 1) -> None:
        for _ in range(n):
            self.arrived(self.far, self.link)
            self.drive.tick()

    def step(self, command: core.Command = "none", *, skipped: int = 0, beat: bool = True) -> None:
        """One executed tick; the drive also executes the skipped ones."""
        self.drive_ticks(skipped + 1)
        self.tick(command, skipped=skipped, beat=beat)

    def tick(self, command: core.Command = "none", *, skipped: int = 0, beat: bool = True) -> None:
        """One tick of the controller alone."""
        if beat:
            self.loop.beat()
        generation = None if command == "none" else self.loop.command(command)
        self.arrived(self.link, self.far)
        self.loop.step(skipped)
        self.records.append(self.loop.records)
        self.refused = False
        if generation is not None:
            answer = self.loop.answer(generation)
            assert answer is not None
            assert answer[1] == self.loop.counts.elapsed - 1
            self.refused = not answer[0]

    def steps(self, n: int) -> None:
        for _ in range(n):
            self.step()

    def until(self, state: str, most: int = 20000) -> None:
        for _ in range(most):
            if self.loop.state == state:
                return
            self.step()
        raise AssertionError(f"never reached {state}, stayed in {self.loop.state}")

    def running(self, ticks: int = 300) -> Bench:
        self.steps(8)  # until the drive follows and its reply has arrived
        self.step("zero")
        self.until("ZEROED")
        self.step("arm")
        self.step("start")
        self.until("RUNNING")
        self.steps(ticks)
        assert self.loop.state == "RUNNING"
        return self

    def fault(self, kind: loop.FaultKind, ticks: int = 1, value: float = 1.0) -> None:
        """Schedule a fault from the drive's next tick on."""
        self.drive.schedule([loop.Fault(kind, self.drive.ticks, ticks, value)])

    def rows(self) -> np.ndarray:
        return np.concatenate(self.records)

    def last_flags(self) -> int:
        return int(self.records[-1]["flags"][-1])


def assert_adds_up(bench: Bench) -> None:
    """Check that every tick has a record, every record a tick, and every command a sender."""
    counts, counters, rows = bench.loop.counts, bench.loop.counters(), bench.rows()
    assert counts.executed + counts.skipped == counts.elapsed
    assert counters["records"] == rows.size
    assert counters["sent"] == bench.link.counters()["pieces_out"]
    not_sent = np.count_nonzero(rows["flags"] & FLAGS["not_sent"])
    assert counters["sent"] == rows.size - not_sent


def assert_drive_was_treated_well(bench: Bench) -> None:
    """Check for no bursts, only finite numbers, and three identical positions after a trip."""
    log = bench.drive.log
    heard = log[log["frames"] > 0]
    assert heard["frames"].max() == 1
    assert log["refused"].max() == 0
    assert np.isfinite(log["target_m"]).all()
    assert np.isfinite(heard["x_m"]).all()
    tripped = np.flatnonzero(heard["state"] == STATE["TRIPPED"])
    if tripped.size:
        first = tripped[0]
        assert tripped.size == 3
        assert heard.size == first + 3
        assert np.ptp(heard["x_m"][first - 1 :]) == 0.0


def stop_begins(bench: Bench) -> int:
    """The drive's tick in which its stop began."""
    log = bench.drive.log
    following = np.flatnonzero(log["phase"] == loop.PHASES.index("following"))
    return int(following[-1]) + 1


def assert_tripped(bench: Bench, cause: str, drive_listens: bool = True) -> None:
    """Check for a latched first cause, three frames followed by silence, and a drive at rest."""
    assert bench.loop.state == "TRIPPED"
    assert bench.loop.cause == cause
    bench.steps(60)
    for command in ("start", "stop", "arm", "zero"):
        bench.step(command)  # type: ignore[arg-type]
        assert bench.refused
    assert (bench.loop.state, bench.loop.cause) == ("TRIPPED", cause)
    assert_adds_up(bench)
    assert_drive_was_treated_well(bench)
    assert bench.drive.phase == "stopped"
    log = bench.drive.log
    told = np.flatnonzero((log["state"] == STATE["TRIPPED"]) & (log["frames"] > 0))
    assert told.size == (3 if drive_listens else 0)
    if drive_listens:
        assert stop_begins(bench) <= told[0] + 1
    assert log["silent"][stop_begins(bench)] <= loop.WATCHDOG_TICKS
