"""Actuator controller and load cell at the end of a line, with their own clock and watchdog."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, overload

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.config import STANDARD, AxesRig, Rate, RigFile
from rthyb_rt.core import loop, ticker, wire
from rthyb_rt.core.coupled_rig import CoupledRig
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axes_rig, axis_wires, experiment, extra_frames, sensor_wires
from rthyb_rt.record.recording import replacing
from rthyb_rt.rig.links.opened import Opened
from rthyb_rt.rig.virtual_rig.rig_plan import NO_PLAN, RigPlan
from rthyb_rt.rig.virtual_rig.wire_ends import WireEnd

LOG_SECONDS: Final = 600.0
"""Length of the drive log if the duration of the run is not known."""
_SERIAL_COMMAND: Final = 12
"""Bytes of a command on the serial line."""
_LOOK_S: Final = 0.005

Drives = loop.Drive | loop.Drives
"""The drive of a rig, or those of all its axes."""


class StopRequest:
    """A request to end a rig; it may be set from a signal handler at any instant.

    It takes no lock: `threading.Event.set` would wait forever for the lock that the interrupted
    thread holds while it inspects the event.
    """

    def __init__(self) -> None:
        self._wanted = False

    def set(self) -> None:
        """Request the end."""
        self._wanted = True

    def is_set(self) -> bool:
        """Whether the end was requested."""
        return self._wanted


@dataclass(frozen=True)
class RigResult:
    """Summary of the run of a virtual rig.

    Attributes:
        ticks: samples executed.
        skipped: samples skipped because its own clock stalled.
        commands: command frames received.
        watchdog_stops: how often it stopped because no new command arrived.
        told_stops: how often it was stopped by a controller that tripped.
        phase: one of `rthyb_rt.core.loop.PHASES`, at the end; by name if the drives differ.
        power_cut: whether its power failed.
        privileges: obtained by its thread, names of `rthyb_rt.core.ticker.PRIVILEGES`.
        log: samples and commands, `rthyb_rt.core.loop.LOG_DTYPE`, (n,); of several axes (n, axes).
    """

    ticks: int
    skipped: int
    commands: int
    watchdog_stops: int
    told_stops: int
    phase: str
    power_cut: bool
    privileges: tuple[str, ...]
    log: NDArray[np.void] = field(repr=False)

    def as_json(self) -> dict[str, Any]:
        """Return everything except the log."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        del values["log"]
        return values | {"privileges": list(self.privileges)}


class _Watcher:
    """Counts how often the drive stops, and why, by polling."""

    def __init__(self, drives: Sequence[loop.Drive]) -> None:
        self._drives = drives
        self._followed = [False] * len(drives)
        self.watchdog_stops = self.told_stops = 0

    def look(self) -> None:
        for k, drive in enumerate(self._drives):
            follows = drive.phase == "following"
            if self._followed[k] and not follows:
                commanded = drive.received_state == "TRIPPED"
                self.told_stops += commanded
                self.watchdog_stops += not commanded
            self._followed[k] = follows


def rate_of(rig: RigFile | AxesRig, plan: RigPlan) -> Rate:
    """Return the sample rate of a virtual rig."""
    return rig.rate if plan.rate is None else plan.rate


def drives_of(
    rig: AxesRig, codecs: Sequence[wire.Codec], links: Sequence[loop.Link], plan: RigPlan
) -> loop.Drives:
    """Return the drive of each axis of a rig file, each at its end of its link.

    Raises:
        CoreError: the rig, the drift or a fault is invalid.
        InputError: values that pass the checks of the files but not those of the core.
    """
    rig.refuse_silent_sensors("a rig on a link")
    sensor_wires.check(rig)
    axis_wires.check(rig)
    seed = rig.rig.seed if plan.seed is None else plan.seed
    given = rig.model_copy(update={"rig": rig.rig.model_copy(update={"seed": seed})})
    plant: CoupledRig = axes_rig.virtual_rig(given, rate_of(rig, plan).hz)
    drives = []
    for k, (name, codec, link) in enumerate(zip(rig.names, codecs, links, strict=True)):
        own = rig.of_axis(name)
        drives.append(
            loop.Drive(
                plant,
                extra_frames.codec_of(own, codec),
                link,
                stop_decel_m_per_s2=experiment.stop_decel_m_per_s2(own),
                log_ticks=plan.log_ticks,
                # Random faults of two drives must not coincide.
                seed=seed + k,
                drift_ppm=plan.drift_ppm,
                calibration=axis_wires.calibration(own),
            )
        )
    found = loop.Drives(drives)
    found.schedule(plan.faults)
    return found


def _drives_at(
    rig: RigFile | AxesRig, ends: Sequence[tuple[wire.Codec, loop.Link]], plan: RigPlan
) -> Drives:
    if isinstance(rig, AxesRig):
        return drives_of(rig, [codec for codec, _ in ends], [link for _, link in ends], plan)
    ((codec, link),) = ends
    return drive_of(rig, codec, link, plan)


def drive_of(rig: RigFile, codec: wire.Codec, link: loop.Link, plan: RigPlan) -> loop.Drive:
    """Return the drive of a rig file at its end of a link.

    Raises:
        CoreError: the rig, the drift or a fault is invalid.
        InputError: the link does not carry the range of a sensor.
    """
    axis_wires.check(rig)
    seed = rig.rig.seed if plan.seed is None else plan.seed
    drive = loop.Drive(
        core.VirtualRig(
            dataclasses.replace(experiment.rig_config(rig, rate_of(rig, plan).hz), seed=seed)
        ),
        extra_frames.codec_of(rig, codec),
        link,
        stop_decel_m_per_s2=experiment.stop_decel_m_per_s2(rig),
        log_ticks=plan.log_ticks,
        seed=seed,
        drift_ppm=plan.drift_ppm,
        calibration=axis_wires.calibration(rig),
    )
    drive.schedule(plan.faults)
    return drive


@overload
def in_step(
    rig: RigFile, opened: Opened, plan: RigPlan = NO_PLAN
) -> contextlib.AbstractContextManager[loop.Drive]: ...


@overload
def in_step(
    rig: RigFile | AxesRig, opened: Opened, plan: RigPlan = NO_PLAN
) -> contextlib.AbstractContextManager[Drives]: ...


@contextlib.contextmanager
def in_step(rig: RigFile | AxesRig, opened: Opened, plan: RigPlan = NO_PLAN) -> Iterator[Any]:
    """Yield a drive that ticks when the caller asks: for the stepped clock, not in real time.

    For a rig of several axes, yield the drives of all.

    Args:
        rig: the rig to simulate.
        opened: its end of the link; it remains the caller's.
        plan: faults; its power cut and duration are ignored.
    """
    with contextlib.ExitStack() as owned:
        links = [loop.Link(one.kind, one.fd) for one in opened.all]
        for link in links:
            owned.callback(link.close)
        codecs = [one.codec for one in opened.all]
        yield _drives_at(rig, list(zip(codecs, links, strict=True)), plan)


def serve(
    rig: RigFile | AxesRig,
    line: WireEnd | Sequence[WireEnd],
    plan: RigPlan = NO_PLAN,
    stop: StopRequest | None = None,
    ready: Callable[[], None] = lambda: None,
) -> RigResult:
    """Run a virtual rig until it is stopped, its time is over, or the other end is gone.

    Args:
        rig: the rig to simulate.
        line: its end of the wire, one for each axis; they remain the caller's.
        plan: faults.
        stop: ends it; may be set from any thread or signal handler.
        ready: called once it ticks.

    Raises:
        CoreError: the rig, the drift or a fault is invalid.
    """
    stop = stop or StopRequest()
    lines = (line,) if isinstance(line, WireEnd) else tuple(line)
    names = rig.names if isinstance(rig, AxesRig) else ("",)
    with contextlib.ExitStack() as owned:
        ends = []
        for one in lines:
            link = loop.Link(one.kind, one.fd)
            owned.callback(link.close)
            ends.append((one, link))
        drive = _drives_at(rig, [(one.codec, link) for one, link in ends], plan)
        return _run(drive, names, ends, plan, stop, ready)


def _run(
    drive: Drives,
    names: Sequence[str],
    ends: Sequence[tuple[WireEnd, loop.Link]],
    plan: RigPlan,
    stop: StopRequest,
    ready: Callable[[], None],
) -> RigResult:
    begun = threading.Event()
    clocks: list[ticker.Ticker] = []
    obtained: list[str] = []

    def tick() -> None:
        try:
            # The clock starts after the memory has been locked, which takes longer than a tick.
            obtained.extend(ticker.become_real_time())
            begins_ns = ticker.now_ns() + 20_000_000
            clocks.append(ticker.Ticker("host", begins_ns, drive.drives[0].rate_hz))
        finally:
            begun.set()
        drive.run(clocks[0])

    thread = threading.Thread(target=tick, name="drive", daemon=True)
    watcher = _Watcher(drive.drives)
    thread.start()
    try:
        begun.wait()
        (clock,) = clocks
        ready()
        cut = _look_after(drive, ends, plan, stop, watcher)
    finally:
        # An interrupt may arrive before there is a clock that could be stopped.
        begun.wait()
        for ticking in clocks:
            ticking.stop()
        thread.join()
        ticker.unlock_memory()
    watcher.look()
    return RigResult(
        ticks=drive.ticks,
        skipped=clock.counts.skipped,
        commands=sum(_commands(line, link) for line, link in ends),
        watchdog_stops=watcher.watchdog_stops,
        told_stops=watcher.told_stops,
        phase=_phase(drive.drives, names),
        power_cut=cut,
        privileges=tuple(obtained),
        log=drive.log,
    )


def _commands(line: WireEnd, link: loop.Link) -> int:
    """Return how many command frames have been received."""
    counters = link.counters()
    serial = line.kind == "stream"
    return counters["bytes_in"] // _SERIAL_COMMAND if serial else counters["pieces_in"]


def _phase(drives: Sequence[loop.Drive], names: Sequence[str]) -> str:
    found = [drive.phase for drive in drives]
    if len(set(found)) == 1:
        return found[0]
    return ", ".join(f"{name} {phase}" for name, phase in zip(names, found, strict=True))


def _look_after(
    drive: Drives,
    ends: Sequence[tuple[WireEnd, loop.Link]],
    plan: RigPlan,
    stop: StopRequest,
    watcher: _Watcher,
) -> bool:
    """Return whether the power was cut."""
    while not stop.is_set():
        time.sleep(_LOOK_S)
        watcher.look()
        now_s = drive.ticks / drive.drives[0].rate_hz
        if plan.power_cut_s is not None and now_s >= plan.power_cut_s:
            return True
        if plan.seconds is not None and now_s >= plan.seconds:
            return False
        # The other end is gone: whatever moves is stopped first, as on a real rig.
        left = [line.tend(link) for line, link in ends]
        if not any(left) and all(one.phase == "stopped" for one in drive.drives):
            return False
    return False


def write_log(path: Path, log: NDArray[np.void], rate: Rate = STANDARD) -> None:
    """Write a drive log as ``.npy``, or as ``.h5`` with the dataset ``drive_log`` and its rate.

    Raises:
        InputError: the file name has another suffix.
        RthybError: the file cannot be written.
    """
    if path.suffix not in LOG_SUFFIXES:
        raise InputError(f"a log must end with {' or '.join(LOG_SUFFIXES)}", str(path))
    with replacing(path) as temporary:
        if path.suffix == ".npy":
            with temporary.open("wb") as file:
                np.save(file, log)
            return
        import h5py

        with h5py.File(temporary, "w") as file:
            table = file.create_dataset("drive_log", data=log)
            table.attrs["phases"] = json.dumps(loop.PHASES)
            table.attrs["fs_hz"] = rate.hz


LOG_SUFFIXES: Final = (".npy", ".h5")
