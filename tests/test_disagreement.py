"""Sensors that disagree with the others: reversed, scaled or slipped during a test."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from axes_bench import NAMES, OFFSET_M, OFFSET_N, config, rig, shaking
from kernels import Floats
from test_axes_redundant import RIG as REDUNDANT
from test_axes_redundant import TEST as THREE
from test_sensors_commissioning import low_pass
from test_sensors_in_real_time import (
    DEFAULTS,
    EACH,
    SHORT,
    assert_replays,
    sensor_of,
    setup,
    through,
)
from test_sensors_without_actuator import BOTH, OFFSETS, Beside, read

from rthyb_rt import config as files
from rthyb_rt import core
from rthyb_rt.core import AxisReading, CoreError
from rthyb_rt.core.group import Allowance, AxisConfig, SensorWatches
from rthyb_rt.core.kinematics import Kinematics
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axes_experiment, virtual_time

Place = tuple[str, int]
"""Kind of a reading, "x_m" or "f_n" of an axis or "sensor", and its number."""
Change = Callable[[float, int], float]
"""From a reading after the tare, and the ticks since it goes wrong, the wrong one."""

# ---- what the others imply ----------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("n", "m", "p", "q"),
    [(2, 2, 1, 1), (2, 2, 2, 0), (3, 2, 2, 1), (4, 2, 0, 0), (2, 1, 4, 4), (4, 4, 4, 4)],
)
def test_a_reading_is_compared_with_the_least_squares_fit_to_all_others(
    n: int, m: int, p: int, q: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.uniform(-1, 1, (n, m)) + np.eye(n, m)
    reads, carries = rng.uniform(-1, 1, (p, m)), rng.uniform(0.1, 0.6, (q, m))
    weight = rng.uniform(-0.5, 1.0, (m, q))
    forces = np.hstack([(np.eye(m) - weight @ carries) @ matrix.T, weight])
    tie = Kinematics(
        matrix,
        reads=reads if p else None,
        carries=carries if q else None,
        forces=forces if q else None,
    )
    for found, rows in zip(
        tie.differences(),
        (np.vstack([matrix, reads]), np.vstack([np.eye(n), carries @ matrix.T])),
        strict=True,
    ):
        reading = rng.normal(size=len(rows))
        for k, row in enumerate(rows):
            others = np.delete(np.arange(len(rows)), k)
            fit, _, rank, _ = np.linalg.lstsq(rows[others], reading[others], rcond=None)
            wanted = reading[k] - row @ fit if rank == rows.shape[1] else 0.0
            assert found[k] @ reading == pytest.approx(wanted, rel=1e-9, abs=1e-9)


def test_a_reading_on_which_no_other_depends_cannot_disagree() -> None:
    """The second axis alone measures the rotation; a single pin has no other."""
    found, of_forces = Kinematics([[1.0, 0.0], [0.0, 1.0]], reads=[[1.0, 0.0]]).differences()
    np.testing.assert_allclose(found, [[1, 0, -1], [0, 0, 0], [-1, 0, 1]], atol=1e-12)
    assert not of_forces.any()
    pin = core.kinematics.Pin((0.0, 0.0), (-1.0, 0.0))
    assert not Kinematics(pins=[pin], coordinates=["x"]).differences()[0].any()


# ---- the station --------------------------------------------------------------------------------


@dataclass
class Altered(Beside):
    """The two axes with three sensors beside them, of which some go wrong, with noise."""

    wrong: dict[Place, Change] = field(default_factory=dict)
    noise_m: float = 0.0
    noise_n: float = 0.0
    seed: int = 1
    since: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.rng, self.inputs = np.random.default_rng(self.seed), list[list[float]]()

    def altered(self, place: Place, value: float, offset: float, noise: float) -> float:
        own = value - offset + noise * float(self.rng.normal())
        if self.since is not None and place in self.wrong:
            own = self.wrong[place](own, len(self.records) - self.since)
        return own + offset

    def step(
        self, command: core.Command = "none", faults: Any = None, **common: Any
    ) -> core.StationTick:
        axes = [
            AxisReading(
                self.altered(("x_m", k), one.x_m, OFFSET_M[k], self.noise_m),
                self.altered(("f_n", k), one.f_n, OFFSET_N[k], self.noise_n),
            )
            for k, one in enumerate(self.read())
        ]
        sensors = [
            self.altered(("sensor", k), a + b, b, self.noise_n if k == 2 else self.noise_m)
            for k, (a, b) in enumerate(zip(self.plant.sensors, OFFSETS, strict=True))
        ]
        tick = self.station.tick(command=command, axes=axes, sensors=sensors, **common)
        self.records.append(tick.records.copy())
        self.inputs.append(sensors)
        if tick.sent:
            self.sent.append(tick.commands_m)
            self.at_drive = tick.commands_m
        return tick

    def goes_wrong(self, ticks: int = 1500) -> int:
        """Ticks from the fault to the end of the test, or all of them."""
        self.since = len(self.records)
        for n in range(ticks):
            if self.station.state in ("TRIPPED", "IDLE"):
                return n
            self.step()
        return ticks

    def differences(self) -> tuple[Floats, Floats]:
        c = self.station._c.disagreement
        return np.array(list(c.x[0:4])), np.array(list(c.f[0:3]))


def limited(
    most_m: float = 1e-3,
    most_n: float = 3e3,
    reaction: core.Reaction = "trip",
    allowances: dict[Place, Allowance] | None = None,
    **more: Any,
) -> Altered:
    """A bench with these limits on all readings."""
    given = allowances or {}

    def of(place: Place) -> Allowance:
        return given.get(place, Allowance())

    own = {"sensor_disagrees": core.Watch(most_m, reaction),
           "force_disagrees": core.Watch(most_n, reaction)}  # fmt: skip
    axes = tuple(
        AxisConfig(name, watches=own, x_allowance=of(("x_m", k)), f_allowance=of(("f_n", k)))
        for k, name in enumerate(NAMES)
    )
    sensors = tuple(
        SensorWatches(
            name,
            disagreement=core.Watch(most_n if k == 2 else most_m, reaction),
            allowance=of(("sensor", k)),
        )
        for k, name in enumerate(("wire", "string", "column"))
    )
    tie = Kinematics.of(BOTH.plain())
    settings = config(
        {"kinematics": tie, "axes": axes}, sensors=sensors, lone_channel=0, lone_channel_count=6
    )
    return Altered(settings, 4.0, plant=rig(tie), **more)


WRONG: dict[str, Change] = {
    "reversed": lambda value, _: -value,
    "of twice the scale": lambda value, _: 2.0 * value,
    "slipped": lambda value, n: value + 2e-5 * n,
    "no longer connected": lambda value, _: 0.0 * value,
}
PLACES: list[Place] = [
    ("sensor", 0),
    ("sensor", 1),
    ("sensor", 2),
    ("x_m", 0),
    ("x_m", 1),
    ("f_n", 0),
    ("f_n", 1),
]


LEAST_N = 200.0


def named(one: Altered) -> Place:
    kind = "f_n" if one.station.cause == "force_disagrees" else "x_m"
    if one.station.cause_sensor is not None:
        return "sensor", one.station.cause_sensor
    assert one.station.cause_axis is not None
    return kind, one.station.cause_axis


def replayed(one: Altered, excitation: Floats) -> core.Station:
    """Return a station that has replayed the run, with the same rows to the last bit."""
    again = core.Station(one.settings, excitation)
    made = again.replay(one.rows(), sensors=np.array(one.inputs))
    assert made.tobytes() == np.ascontiguousarray(core.rows.as_records(one.rows())).tobytes()
    return again


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("fault", WRONG)
def test_a_sensor_that_goes_wrong_in_a_running_test_trips_by_its_name(
    fault: str, place: Place
) -> None:
    """Four displacements give two directions, so that the wrong one is known.

    Three forces give two: then only that one of them is wrong.
    """
    is_force = place in (("sensor", 2), ("f_n", 0), ("f_n", 1))
    change = WRONG[fault]
    scale = 3e6 if is_force and fault == "slipped" else 1.0
    one = limited(most_m=2e-4, most_n=LEAST_N).running(300)
    one.wrong = {place: lambda value, n: value + scale * (change(value, n) - value)}
    one.goes_wrong()
    station = one.station
    assert station.state == "TRIPPED"
    assert station.cause == ("force_disagrees" if is_force else "sensor_disagrees")
    if not is_force:
        assert named(one) == place
    limit = LEAST_N if is_force else 2e-4
    assert limit < abs(station.cause_value) < 2 * limit
    assert station.cause_limit == limit
    placed = core.placed_cause(int(one.rows()["cause"][-1]))
    assert placed == (
        core.CAUSES.index(station.cause),
        station.cause_axis,
        None,
        station.cause_sensor,
    )
    again = replayed(one, shaking(4.0))
    assert (again.cause_value, again.cause_limit) == (station.cause_value, station.cause_limit)


@pytest.mark.parametrize("state", ["ZEROED", "ARMED", "RAMP_IN", "HOLD", "RAMP_OUT"])
def test_a_sensor_that_slips_trips_in_every_state_in_which_a_drive_may_move(state: str) -> None:
    one = limited()
    one.step()
    one.step("zero")
    one.until("ZEROED")
    for command in ("arm", "start") if state != "ZEROED" else ():
        if command == "start" and state == "ARMED":
            break
        assert not one.step(command).refused  # type: ignore[arg-type]
    if state in ("HOLD", "RAMP_OUT"):
        one.until("RUNNING")
        for _ in range(300):
            one.step()
        one.step("hold" if state == "HOLD" else "stop")
    assert one.station.state == state
    one.wrong = {("sensor", 0): lambda value, _: value + 2e-3}
    assert one.goes_wrong(100) < 20
    assert (one.station.state, one.station.cause) == ("TRIPPED", "sensor_disagrees")
    assert one.station.cause_sensor == 0


def test_a_ramp_out_that_another_fault_has_caused_goes_on() -> None:
    one = limited().running(300)
    one.step(heartbeat_late=True)
    assert (one.station.state, one.station.cause) == ("RAMP_OUT", "heartbeat")
    one.wrong = {("sensor", 0): lambda value, _: value + 2e-3}
    one.goes_wrong(5000)
    assert (one.station.state, one.station.cause) == ("IDLE", "heartbeat")
    assert not one.step("zero").refused


@pytest.mark.parametrize("reaction", ["none", "indicate", "hold", "ramp-out"])
def test_the_action_of_the_limit_is_carried_out_and_refuses_a_start(reaction: Any) -> None:
    one = limited(reaction=reaction).running(300)
    one.wrong = {("sensor", 0): lambda value, _: value + 2e-3}
    one.since = len(one.records)
    for _ in range(60):
        one.step()
    left = {"hold": ("HOLD",), "ramp-out": ("RAMP_OUT", "IDLE")}
    assert one.station.state in left.get(reaction, ("RUNNING",))
    if reaction in left:
        assert (one.station.cause, one.station.cause_sensor) == ("sensor_disagrees", 0)
    assert ("sensor_disagrees" in one.station.indicated) == (reaction in ("indicate", "hold"))
    other = limited(reaction=reaction)
    other.step()
    other.step("zero")
    other.until("ZEROED")
    other.wrong, other.since = one.wrong, len(other.records)
    for _ in range(60):
        other.step()
    refused = other.step("arm").refused
    assert refused == (reaction in ("hold", "ramp-out"))
    if refused:
        assert other.station.refusal[0] == "sensor_disagrees"
        assert other.station.refusal_sensor == 0


def test_noise_and_single_readings_are_smoothed() -> None:
    """The noise of a difference is near its limit, and a single reading thrice beyond it."""
    one = limited(most_m=2e-5, noise_m=5e-6, noise_n=10.0).running(3000)
    assert one.station.state == "RUNNING"
    rows, _ = BOTH.differences()
    assert 5e-6 * np.sqrt((rows**2).sum(axis=1)).max() > 2e-5 / 2
    spike = limited(most_m=1e-3).running(300)
    spike.wrong = {("sensor", 0): lambda value, n: value + (3e-3 if n % 50 == 0 else 0.0)}
    assert spike.goes_wrong(500) == 500
    # What remains is seen soon: 1 - (8/9)^n of it after n readings.
    step = limited(most_m=1e-3).running(300)
    step.wrong = {("sensor", 0): lambda value, _: value + 1.25e-3}
    assert step.goes_wrong(100) == math.ceil(math.log(1 - 1 / 1.25) / math.log(8 / 9))


def test_a_limit_grows_with_the_motion_that_the_others_imply() -> None:
    """A scale that is off by 15 % is within 20 % of whatever amplitude, one by 25 % is not."""
    sensor = ("sensor", 0)
    own = {sensor: Allowance(0.2, 1e-5, grows=True)}
    for scale, holds in ((1.15, True), (0.85, True), (1.25, False), (0.75, False), (-1.0, False)):
        one = limited(most_m=2e-5, most_n=1e9, allowances=own)
        for k in range(2):
            one.station._c.cfg.axis[k].watch[core.CAUSES.index("sensor_disagrees")].value = 0.0
        one.station._c.cfg.lone[1].disagreement.value = 0.0
        one.running(300)
        one.wrong = {sensor: lambda value, _, by=scale: by * value}  # type: ignore[misc]
        one.goes_wrong(2500)
        assert (one.station.state != "TRIPPED") is holds, scale
        if not holds:
            peak = float(one.station._c.disagreement.peak_x[2])
            row = BOTH.differences()[0][2]
            assert row[2] == 1.0
            assert one.station.cause_limit == pytest.approx(2e-5 + max(0.2 * peak, 1e-5))


@pytest.mark.parametrize("absurd", [math.nan, math.inf, -math.inf, 1e300, 1e13])
def test_absurd_readings_leave_every_difference_finite(absurd: float) -> None:
    one = limited(most_m=1e9, most_n=1e12).running(300)
    one.wrong = {place: lambda _v, n: absurd if n % 3 == 0 else 1e-3 for place in PLACES[:3]}
    one.goes_wrong(50)
    ends = "none" if math.isfinite(absurd) else "not_finite"
    assert one.station.cause == ends
    assert all(np.isfinite(values).all() for values in one.differences())


def test_the_largest_readings_that_are_taken_leave_every_difference_finite() -> None:
    one = limited(most_m=1e9, most_n=1e12).running(300)
    one.wrong = {("sensor", 0): lambda *_: 900.0, ("sensor", 2): lambda *_: -1e11}
    one.goes_wrong(100)
    assert one.station.state == "RUNNING"
    assert all(np.isfinite(values).all() for values in one.differences())


def test_settings_are_restored_and_senseless_ones_are_refused() -> None:
    one = limited(allowances={("x_m", 1): Allowance(0.1, 1e-4, grows=True)})
    again = core.StationConfig.of(one.settings.plain())
    assert again.plain() == one.settings.plain()
    assert again.controller.axes[1].x_allowance == Allowance(0.1, 1e-4, grows=True)
    for wrong in (Allowance(-0.1), Allowance(math.nan), Allowance(0.1, math.inf), Allowance(2e6)):
        sensors = (replace(one.settings.sensors[0], allowance=wrong), *one.settings.sensors[1:])
        with pytest.raises(CoreError):
            core.Station(replace(one.settings, sensors=sensors), shaking(1.0))


def test_healthy_sensors_with_noise_never_disagree_in_random_tests() -> None:
    """Scales within 10 % of what they should be, noise, and default limits for both."""
    rng = np.random.default_rng(5)
    for seed in range(6):
        allowances: dict[Place, Allowance] = {
            ("sensor", k): Allowance(0.2, 1e-4 if k < 2 else 500.0, grows=True) for k in range(3)
        }
        allowances |= {
            (kind, k): Allowance(grows=True) for kind in ("x_m", "f_n") for k in range(2)
        }
        one = limited(1e-4, 500.0, allowances=allowances, noise_m=1e-5, noise_n=50.0, seed=seed)
        scales = rng.uniform(0.9, 1.1, 3)
        one.wrong = {("sensor", k): lambda value, _, by=scales[k]: by * value for k in range(3)}  # type: ignore[misc]
        one.since = 0
        one.running()
        one.until("IDLE", most=8000)
        assert one.station.cause == "completed", seed


# ---- over links, with the limits that follow from the files --------------------------------------


@EACH
@pytest.mark.parametrize(
    ("fault", "change"),
    [
        ("reversed", lambda now, raw: -raw if now >= 300 else raw),
        ("twice", lambda now, raw: 2 * raw if now >= 0 else raw),
        ("half", lambda now, raw: raw // 2 if now >= 0 else raw),
        ("slipped", lambda now, raw: raw + 20_000 * max(0, now - 300)),
    ],
)
def test_default_limits_end_a_test_before_the_sensor_does_harm(
    name: str, fault: str, change: Any
) -> None:
    rec, _ = through(name, change)
    assert sensor_of(rec) == ({"wire": "sensor_disagrees", "column": "force_disagrees"}[name], name)
    assert rec.meta["end_reason"] == f"tripped: disagreement of sensor {name}"
    facts, whole = rec.meta["station"], healthy()
    assert abs(facts["cause_value"]) > facts["cause_limit"]
    # Wrong position or force: less than a third of the peak of the test.
    peak = np.abs(whole.samples[whole.running()][name]).max()
    assert facts["cause_limit"] < peak / 2
    weight = 2 / 3 if name == "wire" else 1.0
    assert weight * abs(facts["cause_value"]) < 0.45 * peak
    assert_replays(rec)


def healthy() -> Any:
    if not _HEALTHY:
        _HEALTHY.append(through("wire", test=LONG)[0])
    return _HEALTHY[0]


_HEALTHY: list[Any] = []
LONG = SHORT.replace("duration_s = 3", "duration_s = 8")


def test_healthy_sensors_stay_far_below_the_default_limits_in_a_long_test() -> None:
    rec = healthy()
    assert rec.meta["end_reason"] == "completed"
    one = setup(test=LONG)
    assert one.group is not None
    found = axes_experiment.station_config(one, one.group, real=True)
    rows = rec.samples
    read_m = np.column_stack([rec.axis(k)["x_meas_m"] for k in NAMES] + [rows["wire"]])
    read_n = np.column_stack([rec.axis(k)["f_meas_n"] for k in NAMES] + [rows["column"]])
    for read_, rows_, limit in zip(
        (read_m, read_n),
        one.group.rig.core_kinematics().differences(),
        found.sensors,
        strict=True,
    ):
        assert limit.disagreement is not None
        least = limit.disagreement.value + limit.allowance.least
        assert np.abs(read_ @ rows_[-1]).max() < 0.1 * least


def test_a_lag_that_commissioning_accepts_does_not_disagree() -> None:
    for name, noise in (("wire", 2000), ("column", 10_000)):
        rec, _ = through(name, low_pass(0.0045, noise))
        assert rec.meta["end_reason"] == "completed", name


def test_default_limits_are_what_commissioning_accepts() -> None:
    one = setup()
    assert one.group is not None
    found = axes_experiment.station_config(one, one.group, real=True)
    wire, column = found.sensors
    reference = one.group.reference
    # wire = x1 / 2 + x2 / 2; a cell with 0.4 of the force along the first direction.
    reading = reference.axis_m.mean(axis=1)
    delay_s = max(
        axis.identified.delay_s if axis.identified else 0.02 for axis in one.group.rig.axis
    )
    lag_m = (delay_s / 4 + 2 / 1024) * 1024 * np.abs(np.diff(reading)).max()
    own = one.group.derived.axis
    noise_m = np.sqrt(2e-6**2 + 0.25 * sum(axis.rest_noise_displacement_m**2 for axis in own))
    smooth = np.sqrt((1 / 9) / (2 - 1 / 9))
    assert wire.disagreement is not None
    assert wire.disagreement.reaction == "trip"
    assert wire.disagreement.value == pytest.approx(lag_m + 8 * smooth * noise_m, rel=1e-3)
    assert (wire.allowance.share, wire.allowance.grows) == (0.2, True)
    sizes = np.abs(reference.axis_m)
    share = np.sin(np.radians(3))
    terms = one.group.rig.core_kinematics().back()
    along = np.array([0.0, 0.0])
    for lone in one.group.rig.lone_sensors:
        if lone.name == "wire":
            along = np.array([lone.along.get(k, 0.0) for k in one.group.rig.directions])
    by_axis = np.abs(along) @ np.abs(terms)
    askew = share * max((sizes @ by_axis).max(), by_axis.max() * sizes.max())
    assert wire.allowance.least == pytest.approx(2 * askew)
    assert column.allowance.share == pytest.approx(np.sqrt(2) - 1)
    bare = axes_experiment.station_config(one, one.group, real=False)
    assert [each.disagreement for each in bare.sensors] == [None, None]


def test_a_stated_limit_replaces_the_default_in_virtual_time_too() -> None:
    text = DEFAULTS.replace('name = "wire"\n', 'name = "wire"\ndisagreement_m = "0.3 mm"\n')
    text = text.replace(
        'name = "column"\n',
        'name = "column"\ndisagreement_n = { value = "2 kN", action = "ramp-out" }\n',
    )
    one = setup(text)
    assert one.group is not None
    for real in (True, False):
        wire, column = axes_experiment.station_config(one, one.group, real=real).sensors
        assert wire.disagreement == core.Watch(3e-4, "trip")
        assert column.disagreement == core.Watch(2e3, "ramp-out")
        assert not wire.allowance.grows
    rec, _ = through("wire", lambda now, raw: raw + 1000 * max(0, now - 300), text=text)
    assert rec.meta["end_reason"] == "tripped: disagreement of sensor wire"
    assert rec.meta["station"]["cause_limit"] == 3e-4
    off = DEFAULTS.replace(
        'name = "wire"\n', 'name = "wire"\ndisagreement_m = { value = 1, enable = false }\n'
    )
    two = setup(off)
    assert two.group is not None
    assert axes_experiment.station_config(two, two.group, real=True).sensors[0].disagreement is None


@pytest.mark.parametrize("kind", ["displacement", "force"])
def test_a_stated_limit_of_an_axis_acts(kind: str) -> None:
    unit, value = ("m", 4e-4) if kind == "displacement" else ("n", 500.0)
    key = f"sensors.{kind}.disagreement_{unit}"
    rig_file = read(DEFAULTS)
    table = getattr(rig_file.axis[0].sensors, kind)
    limit = type(table).model_validate({f"disagreement_{unit}": value})
    assert getattr(limit, f"disagreement_{unit}").value == value
    changed = DEFAULTS.replace(
        f"{kind} = {{ noise_std_", f"{kind} = {{ disagreement_{unit} = {value}, noise_std_", 1
    )
    assert changed != DEFAULTS, key
    one = setup(changed)
    assert one.group is not None
    axes = axes_experiment.station_config(one, one.group, real=True).controller.axes
    assert axes[0].watches is not None
    cause = "sensor_disagrees" if kind == "displacement" else "force_disagrees"
    assert axes[0].watches[cause] == core.Watch(value, "trip")
    name = "wire" if kind == "displacement" else "column"
    rec, _ = through(name, lambda now, raw: raw + 1000 * max(0, now - 300), text=changed)
    assert rec.meta["end_reason"].endswith("of axis left")


def test_a_limit_on_what_cannot_disagree_is_refused_with_the_reason() -> None:
    alone = DEFAULTS[: DEFAULTS.index("[[sensor]]")] + DEFAULTS[DEFAULTS.index("[kinematics]") :]
    alone = re.sub(r"forces = .*\n", "", alone)
    alone = re.sub(r"displacements = .*\n", "", alone)
    read(alone)
    wrong = alone.replace(
        "displacement = { noise", "displacement = { disagreement_m = 1e-3, noise", 1
    )
    with pytest.raises(InputError) as error:
        read(wrong)
    said = str(error.value)
    assert "axis left: sensors.displacement has disagreement_m" in said
    assert "does not follow from those of the other displacement sensors" in said
    assert "remove disagreement_m" in said


def test_redundant_actuators_are_compared_in_virtual_time_if_the_file_says_so() -> None:
    """Two of them follow one storey with different delays; the third has the other to itself."""

    def limited_at(axis: str, most: str) -> str:
        at = REDUNDANT.index("noise_std_m", REDUNDANT.index(f'name = "{axis}"'))
        return f"{REDUNDANT[:at]}disagreement_m = {most}, {REDUNDANT[at:]}"

    def ended(text: str) -> Any:
        test = files.parse_test(THREE.replace('"6 s"', '"3 s"'), "test.toml")
        return virtual_time.run(axes_experiment.prepare(test, read(text))).meta

    names = [axis.name for axis in read(REDUNDANT).axis]
    assert ended(limited_at(names[1], '"2 mm"'))["end_reason"] == "completed"
    found = ended(limited_at(names[1], '"40 um"'))
    assert (
        found["end_reason"]
        == f"tripped: disagreement of the displacement sensor of axis {names[1]}"
    )
    assert found["station"]["cause_limit"] == 4e-5
    with pytest.raises(
        InputError, match=f"axis {names[0]}: sensors.displacement has disagreement_m"
    ):
        read(limited_at(names[0], '"2 mm"'))
