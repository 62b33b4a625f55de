"""A rig with limits and a drive in lockstep with it, for the tests of commissioning."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rthyb_rt import config
from rthyb_rt.config import RigFile
from rthyb_rt.core import loop
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.commissioning.guided_motion import Connection
from rthyb_rt.rig.links import opening

STIFFNESS_N_PER_M = 5e5
DELAY_SAMPLES = 12

COLUMN = f"""schema = "rthyb-rig/1"
[rig]
name = "column"
load_cell = "specimen"
elastic_stiffness_n_per_m = 1

[actuator]
kind = "pure-delay"
delay_samples = {DELAY_SAMPLES}

[[specimen]]
element = "stiffness"
k_n_per_m = {STIFFNESS_N_PER_M}

[sensors]
displacement = {{ noise_std_m = "2 um", lsb_m = "0.5 um", range_m = "30 mm" }}
force = {{ noise_std_n = "5 N", range_n = "20 kN" }}

[link]
kind = "socket"
channel = "/nowhere"

[limits]
command_position_m = "10 mm"
force_n = "8 kN"
tare_s = 0.25
"""


def rig(changes: dict[str, str] | None = None) -> RigFile:
    """The column with changed values, by key."""
    return config.parse_rig(COLUMN, "column.toml", changes or {})


class Drive:
    """The virtual drive of a rig, ticking with the controller.

    Attributes:
        connection: the controller's side.
        drive: the drive itself.
        tell: called before each of its ticks.
        operator: last argument of `Connection.on_interrupt`: requests a stop.
    """

    def __init__(self, given: RigFile, drive: loop.Drive, opened: opening.Opened) -> None:
        self.drive = drive
        self.tell: Callable[[], None] = lambda: None
        self.operator: Callable[[], None] = lambda: None
        self.connection = Connection(
            given, opened, "stepped", self._tick, on_interrupt=self._interruptible
        )

    def _tick(self) -> None:
        self.tell()
        self.drive.tick()

    @contextmanager
    def _interruptible(self, stop: Callable[[], None]) -> Iterator[None]:
        self.operator = stop
        yield

    @property
    def position_m(self) -> float:
        """Target of the actuator, in the rig's own coordinates."""
        return float(self.drive._c.target_m)


@contextmanager
def at(
    given: RigFile, wired: RigFile | None = None, faults: tuple[loop.Fault, ...] = ()
) -> Iterator[Drive]:
    """Yield a connected rig.

    Args:
        given: the controller's rig file.
        wired: the actual rig, if it differs from the file.
        faults: faults of the drive.
    """
    ours, theirs = opening.socket_pair()
    plan = virtual_rig.RigPlan(log_ticks=200_000, faults=faults)
    with ours, theirs, virtual_rig.in_step(wired or given, theirs, plan) as drive:
        yield Drive(given, drive, ours)
