"""With kinematics of pins, wires and load cells are compared at the pose of every tick: exact
lengths agree far from rest too, and a sensor that goes wrong trips by its name."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from axes_bench import H, config, rig, structure
from kernels import Floats
from test_disagreement import PLACES, WRONG, Altered, Change, Place, named, replayed
from test_kinematics import COUPLER, TRIPOD, lengths
from test_sensors_in_real_time import DEFAULTS, assert_replays, sensor_of, setup, through
from test_sensors_with_pins import OWN_TEST, WIRES, exact, tripod, with_pins
from test_sensors_without_actuator import read

from rthyb_rt import core
from rthyb_rt.core.group import Allowance, AxisConfig, SensorWatches
from rthyb_rt.core.kinematics import Kinematics, Pin
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axes_experiment

LEAST_M, LEAST_N = 2e-4, 200.0
SECONDS = 6.0


def strong(peak_mps2: float) -> Floats:
    t = np.arange(round(SECONDS * core.FS_HZ)) * H
    swing = np.sin(2 * np.pi * 1.7 * t) * np.sin(np.pi * t / SECONDS) ** 2
    return np.asarray(peak_mps2 * swing)


def limited(
    most_m: float = LEAST_M,
    most_n: float = LEAST_N,
    wires: tuple[Pin, ...] = WIRES[:2],
    allowance: Allowance | None = None,
    peak_mps2: float = 2.8,
    **more: Any,
) -> Altered:
    """The coupler of the benchmark with two wires and a cell below it, shaken to 60 mm."""
    tie = Kinematics(
        pins=COUPLER,
        coordinates=["x", "theta"],
        sensor_pins=wires,
        carries=[[0.4, 0.0]],
        forces=[[1.25], [0.0]],
    )
    own = {"sensor_disagrees": core.Watch(most_m, "trip"),
           "force_disagrees": core.Watch(most_n, "trip")}  # fmt: skip
    axes = tuple(AxisConfig(name, watches=own) for name in ("left", "right"))
    sensors = tuple(
        SensorWatches(
            name,
            disagreement=core.Watch(most_n if k == 2 else most_m, "trip"),
            allowance=allowance or Allowance(),
        )
        for k, name in enumerate(("wire", "string", "column"))
    )
    part = structure(load_kg=np.array([4220.0, 600.0]))
    settings = config(
        {"kinematics": tie, "axes": axes, "numerical": part, "velocity_limit_m_per_s": 5.0},
        sensors=sensors,
        lone_channel=0,
        lone_channel_count=6,
    )
    one = Altered(settings, SECONDS, plant=rig(Kinematics.of(tie.plain())), **more)
    one.station = core.Station(settings, strong(peak_mps2))
    return one


def to_the_end(one: Altered) -> Floats:
    """Run the whole test; the largest x and theta that were measured, (2,)."""
    one.running(0)
    reach = np.zeros(2)
    while one.station.state not in ("IDLE", "TRIPPED"):
        one.step()
        here = [one.station._c.controller.interface[j].x_m for j in range(2)]
        reach = np.maximum(reach, np.abs(here))
    return reach


# ---- what the others imply ----------------------------------------------------------------------


def by_others(rows: Floats) -> Floats:
    """Weights of all readings in the difference of each from the fit to the others."""
    found = np.eye(len(rows))
    for k in range(len(rows)):
        others = np.delete(np.arange(len(rows)), k)
        found[k, others] = -rows[k] @ np.linalg.pinv(rows[others])
    return found


def test_at_rest_a_wire_is_compared_by_its_slope() -> None:
    tie = tripod(carries=[[0.1, 0.5, 0.2]], forces=[[0.2], [1.0], [0.3]])
    of_x, of_f = tie.differences()
    rows = np.vstack([tie.jacobian(), tie.reads()])
    np.testing.assert_allclose(of_x, by_others(rows), atol=1e-9)
    carried = np.array([[0.1, 0.5, 0.2]]) @ tie.jacobian().T
    np.testing.assert_allclose(of_f, by_others(np.vstack([np.eye(3), carried])), atol=1e-9)
    # Without anything redundant nothing is implied.
    assert not any(each.any() for each in Kinematics(pins=TRIPOD, coordinates=["x", "y", "theta"])
                   .differences())  # fmt: skip


def test_far_from_rest_the_weights_are_those_of_the_slopes_there() -> None:
    one = limited(most_m=1.0, most_n=1e9).running(2500)
    while abs(one.station._c.controller.interface[0].x_m) < 0.03:
        one.step()
    tie = one.settings.controller.kinematics
    assert tie is not None
    here = Kinematics.of(tie.plain())
    c = one.station._c.controller
    x, sensors = [c.axis[i].x_m1 for i in range(2)], [c.sensor[k] for k in range(3)]
    for _ in range(4):
        here.measured_pose([x], [sensors])
    d = one.station._c.disagreement
    found = np.array([list(row[0:4]) for row in d.by_x[0:4]])
    np.testing.assert_allclose(
        found, by_others(np.vstack([here.jacobian(), here.reads()])), atol=1e-6
    )
    assert np.abs(found - here.differences()[0]).max() > 0.005
    of_f = np.array([list(row[0:3]) for row in d.by_f[0:3]])
    carried = np.array([[0.4, 0.0]]) @ here.jacobian().T
    np.testing.assert_allclose(of_f, by_others(np.vstack([np.eye(2), carried])), atol=1e-6)


# ---- the station --------------------------------------------------------------------------------


def test_exact_lengths_agree_at_sixty_millimetres_and_eighty_milliradians() -> None:
    """A limit of a picometre; with the constant slopes at rest millimetres would remain."""
    one = limited(most_m=1e-12, most_n=1e-3)
    reach = to_the_end(one)
    assert one.station.cause == "completed"
    assert reach[0] > 0.06
    assert reach[1] > 0.08
    tie = one.settings.controller.kinematics
    assert tie is not None
    pose = np.array([[reach[0], 0.0, reach[1]]])
    read_ = np.concatenate([lengths(COUPLER, pose), exact(WIRES[:2], pose)], axis=1)[0]
    assert np.abs(Kinematics.of(tie.plain()).differences()[0] @ read_).max() > 1e-3


def test_healthy_wires_with_noise_never_disagree_over_the_whole_range() -> None:
    """Limits of eight standard deviations of the filtered difference, by the weights at rest."""
    for seed in range(4):
        one = limited(noise_m=1e-5, noise_n=20.0, seed=seed)
        tie = one.settings.controller.kinematics
        assert tie is not None
        smooth = math.sqrt((1 / 9) / (2 - 1 / 9))
        of_x, of_f = (8 * smooth * np.sqrt((row**2).sum(axis=1)) for row in tie.differences())
        c = one.station._c.cfg
        for k in range(2):
            c.axis[k].watch[core.CAUSES.index("sensor_disagrees")].value = 1e-5 * of_x[k]
            c.axis[k].watch[core.CAUSES.index("force_disagrees")].value = 20.0 * of_f[k]
            c.lone[k].disagreement.value = 1e-5 * of_x[2 + k]
        c.lone[2].disagreement.value = 20.0 * of_f[2]
        to_the_end(one)
        assert one.station.cause == "completed", (seed, one.station.cause_value)


FROZEN = "frozen"
FAULTS: dict[str, Change] = {
    **WRONG,
    "of half the scale": lambda value, _: 0.5 * value,
    FROZEN: lambda value, _: value,
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_sensor_with_pins_that_goes_wrong_trips_by_its_name(fault: str, place: Place) -> None:
    """Four lengths give two directions, so that the wrong one is known; three forces two."""
    is_force = place in (("sensor", 2), ("f_n", 0), ("f_n", 1))
    one = limited(peak_mps2=1.5).running(300)
    change, held = FAULTS[fault], list[float]()

    def wrong(value: float, n: int) -> float:
        held.append(value)
        if fault == FROZEN:
            return held[0]
        by = 3e6 if is_force and fault == "slipped" else 1.0
        return value + by * (change(value, n) - value)

    one.wrong = {place: wrong}
    one.goes_wrong()
    station = one.station
    assert station.state == "TRIPPED"
    assert station.cause == ("force_disagrees" if is_force else "sensor_disagrees")
    if not is_force:
        assert named(one) == place
    assert abs(station.cause_value) < 2 * (LEAST_N if is_force else LEAST_M)
    replayed(one, strong(1.5))


@pytest.mark.parametrize("absurd", [math.nan, math.inf, -math.inf, 1e300, 1e13])
@pytest.mark.parametrize("place", PLACES)
def test_absurd_readings_with_pins_leave_every_difference_finite(
    absurd: float, place: Place
) -> None:
    one = limited(most_m=1e9, most_n=1e12).running(300)
    one.wrong = {place: lambda v, n: absurd if n % 3 == 0 else v}
    one.goes_wrong(50)
    assert one.station.cause == ("none" if math.isfinite(absurd) else "not_finite")
    d = one.station._c.disagreement
    assert all(np.isfinite(values).all() for values in one.differences())
    assert np.isfinite([list(row) for row in d.by_x]).all()


@pytest.mark.parametrize("far", [900.0, -900.0, 0.6])
def test_a_wire_far_beyond_its_own_length_leaves_every_difference_finite(far: float) -> None:
    one = limited(most_m=1e9, most_n=1e12).running(300)
    one.wrong = {("sensor", 0): lambda *_: far, ("x_m", 1): lambda *_: -far}
    one.goes_wrong(100)
    d = one.station._c.disagreement
    assert all(np.isfinite(values).all() for values in one.differences())
    assert np.isfinite([list(row) for row in d.by_x]).all()
    assert (one.station.state, one.station.cause) == ("TRIPPED", "no_pose")


# ---- over links, with the limits that follow from the files --------------------------------------

PINS = with_pins(DEFAULTS).replace("ramp_in_s = 1.5", "ramp_in_s = 0.25\ntare_s = 0.125")
SHORT = OWN_TEST


@pytest.mark.parametrize(
    ("fault", "change"),
    [
        ("reversed", lambda now, raw: -raw if now >= 300 else raw),
        ("half", lambda now, raw: raw // 2 if now >= 0 else raw),
        ("slipped", lambda now, raw: raw + 20_000 * max(0, now - 300)),
    ],
)
@pytest.mark.parametrize("name", ["wire", "column"])
def test_default_limits_with_pins_end_a_test_by_the_name_of_the_sensor(
    name: str, fault: str, change: Any
) -> None:
    rec, _ = through(name, change, text=PINS, test=SHORT)
    assert sensor_of(rec) == ({"wire": "sensor_disagrees", "column": "force_disagrees"}[name], name)
    assert_replays(rec)


def test_healthy_sensors_with_pins_complete_a_test_with_default_limits() -> None:
    rec, _ = through("wire", text=PINS, test=SHORT)
    assert rec.meta["end_reason"] == "completed"
    one = setup(PINS, SHORT)
    assert one.group is not None
    wire, column = axes_experiment.station_config(one, one.group, real=True).sensors
    assert wire.disagreement is not None
    assert column.disagreement is not None
    assert (wire.allowance.share, wire.allowance.grows) == (0.2, True)


def test_a_stated_limit_with_pins_is_accepted() -> None:
    text = PINS.replace('name = "wire"\n', 'name = "wire"\ndisagreement_m = "0.3 mm"\n')
    one = setup(text, SHORT)
    assert one.group is not None
    wire, _ = axes_experiment.station_config(one, one.group, real=False).sensors
    assert wire.disagreement == core.Watch(3e-4, "trip")
    alone = text[: text.index("[[sensor]]")] + text[text.index("[kinematics]") :]
    alone = alone.replace("cell_forces = [[1.25], [0]]\n", "").replace(
        "displacement = { noise", "displacement = { disagreement_m = 1e-3, noise", 1
    )
    with pytest.raises(InputError, match="its reading does not follow from those of the other"):
        read(alone)
