"""Channels with the wrong sign are refused, and no others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import diagnose_cases as cases
import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rthyb_rt import core
from rthyb_rt.diagnose import channel_signs, channel_sizes, mapping, reading
from rthyb_rt.diagnose.case import Model
from rthyb_rt.errors import InputError

FS = 500.0
T = np.arange(int(8 * FS)) / FS
SPEED = 2.0 * np.pi * 1.5
X = 0.01 * np.sin(SPEED * T) * np.minimum(T, 1.0)
V = np.gradient(X, T)
DRIVE = Model(family="drive", fs_hz=FS, k=2e5, c=0.0)


def element(kind: str, **values: float) -> np.ndarray:
    return core.CoreElement(core.element(kind, **values)).run(X)


def yielding() -> np.ndarray:
    return element("hysteresis", k_n_per_m=2e5, post_yield_ratio=0.1, a=1.0, b=2e5, c=2e5, eta=2.0)


SPECIMENS: dict[str, np.ndarray] = {
    "oil damper": 8e3 * V,
    "damper with an exponent of 0.3": 900.0 * np.sign(V) * np.abs(V) ** 0.3,
    "damper beside a spring": 2e4 * X + 6e3 * V,
    "dry friction": 400.0 * np.tanh(V / 1e-3),
    "dry friction behind play": 400.0 * np.tanh(V / 1e-3) * (np.abs(X) > 2e-3) + 2e4 * X,
    "yielding steel": yielding(),
    "reinforced concrete": element(
        "rc_column", k_n_per_m=2e5, post_yield_ratio=0.02, xy_m=2e-3, eta=2.0, pivot=3.0,
        ultimate_m=0.02, strength_lost_at_ultimate=0.1, energy_j=1e3, strength_lost_with_energy=0.1,
        stiffness_lost_with_energy=0.0, slip=0.2, slip_level=0.2, slip_width=0.2,
    ),
}  # fmt: skip


@pytest.mark.parametrize("lead_deg", [-170.0, -60.0, -10.0, 0.0, 45.0, 90.0, 180.0])
def test_correlations_of_a_sine_are_those_of_its_angle(lead_deg: float) -> None:
    angle = np.radians(lead_deg)
    whole = slice(None, round(2.0 * np.pi / SPEED * 9 * FS))
    x, f = np.sin(SPEED * T)[whole], 30.0 * np.sin(SPEED * T + angle)[whole] + 700.0
    along_v, along_x = channel_signs.correlations(x, f)
    assert along_v == pytest.approx(np.sin(angle), abs=0.01)
    assert along_x == pytest.approx(np.cos(angle), abs=0.01)


@pytest.mark.parametrize("name", sorted(SPECIMENS))
def test_force_of_a_specimen_resists_and_of_a_reversed_load_cell_drives(name: str) -> None:
    noise = np.random.default_rng(1).normal(0.0, 5.0, X.size)
    force = SPECIMENS[name] + noise + 150.0
    assert not channel_signs.drives(X, force, DRIVE)
    assert channel_signs.drives(X, -force, DRIVE)
    found = channel_signs.fault({"x_meas": X, "f_meas": -force}, DRIVE)
    assert found is not None
    assert found.channel == "f_meas"
    assert channel_signs.fault({"x_meas": X, "f_meas": force}, DRIVE) is None


@pytest.mark.parametrize(
    ("lead_deg", "model"),
    [
        (-45.0, DRIVE),  # a spring behind a load cell an eighth of a period late
        (176.0, DRIVE),  # a mass that the model does not state
        (182.0, DRIVE),  # the same, displacement 4 ms late
        (200.0, Model(family="drive", fs_hz=FS, k=2e5, c=0.0, moving_mass=5e3)),
    ],
)
def test_late_channels_and_masses_have_no_wrong_sign(lead_deg: float, model: Model) -> None:
    force = 1e3 * np.sin(SPEED * T + np.radians(lead_deg))
    assert not channel_signs.drives(X, force, model)


def test_of_fast_motion_more_is_allowed_for_channels_that_are_apart() -> None:
    """A mass at 12 Hz, and its displacement 4 ms late: 17 degrees."""
    x = 1e-3 * np.sin(2.0 * np.pi * 12.0 * T)
    force = -1e3 * np.sin(2.0 * np.pi * 12.0 * (T + 0.004))
    assert not channel_signs.drives(x, force, DRIVE)
    slow = np.interp(T / 12.0, T, x), np.interp(T / 12.0, T, force)
    assert channel_signs.drives(*slow, DRIVE)


def test_specimen_pushed_past_its_peak_at_a_growing_rate_resists() -> None:
    x = 0.05 * T / T[-1] + 0.05 * np.maximum(T - 4.0, 0.0)
    force = 1e5 * np.where(x < 0.01, x / 0.01, np.exp(-(x - 0.01) / 0.08))
    along_v, along_x = channel_signs.correlations(x, force)
    assert max(along_v, along_x) < 0.0
    assert not channel_signs.drives(x, force, DRIVE)


def test_specimen_with_an_element_of_its_own_may_be_driven_by_it() -> None:
    own = core.element("viscous", c_n_s_per_m=-9e3)
    assert not channel_signs.drives(X, -9e3 * V, replace(DRIVE, extra=(own,)))


@hypothesis.given(
    k=st.floats(0.0, 5e5), c=st.floats(0.0, 2e4), friction=st.floats(0.0, 2e3),
    mass=st.floats(0.0, 2e3), late_s=st.floats(-0.005, 0.02), offset=st.floats(-5e3, 5e3),
    seed=st.integers(0, 50),
)  # fmt: skip
@hypothesis.settings(max_examples=150, deadline=None)
def test_no_passive_specimen_has_a_wrong_sign(
    k: float, c: float, friction: float, mass: float, late_s: float, offset: float, seed: int
) -> None:
    """Along random motion of up to 3 Hz, whatever the model states.

    The load cell is at most 22 degrees late, or 5 ms early.
    """
    rng = np.random.default_rng(seed)
    x = sum(
        float(rng.uniform(0.1, 1.0)) * np.sin(2 * np.pi * f * T + float(rng.uniform(0, 6.28)))
        for f in (0.4, 1.1, 1.9, 3.0)
    )
    x = 0.005 * np.asarray(x)
    v = np.gradient(x, T)
    f = k * x + c * v + friction * np.tanh(v / 1e-3) + mass * np.gradient(v, T) + offset
    late = np.interp(T - late_s, T, f)
    assert not channel_signs.drives(x, late, DRIVE)


def test_specimen_that_is_driven_is_stated_by_its_negative_damping() -> None:
    model = Model(family="drive", fs_hz=FS, k=2e5, c=-9e3)
    assert not channel_signs.drives(X, -9e3 * V, model)
    found = channel_signs.fault({"x_meas": X, "f_meas": -9e3 * V}, DRIVE)
    assert found is not None
    assert "state a negative damping (c)" in found.otherwise


def test_force_that_is_given_for_the_beginning_only_is_not_judged() -> None:
    force = np.where(T < 3.0, -8e3 * V, np.nan)
    assert channel_signs.fault({"x_meas": X, "f_meas": force}, DRIVE) is None


# ---- a body that a force or the ground moves -----------------------------------------------------

BODY_KG, F_HZ = 40.0, 2.0
STIFF = BODY_KG * (2.0 * np.pi * F_HZ) ** 2
PUSH = 60.0 * np.sin(2.0 * np.pi * 1.7 * T) + 30.0 * np.sin(2.0 * np.pi * 4.3 * T)


def swung(push: np.ndarray, x0: float = 0.0) -> np.ndarray:
    def rate(now: float, y: np.ndarray) -> list[float]:
        force = np.interp(now, T, push)
        return [y[1], (force - STIFF * y[0] - 20.0 * y[1] - 4.0 * np.tanh(y[1] / 1e-3)) / BODY_KG]

    done = solve_ivp(rate, (0.0, T[-1]), [x0, 0.0], t_eval=T, rtol=1e-6, max_step=0.01)
    return np.asarray(done.y[0])


FORCED = Model(family="forced", fs_hz=FS, k=STIFF, c=20.0, moving_mass=BODY_KG)
GROUND = Model(family="ground", fs_hz=FS, k=STIFF, c=20.0, mass=BODY_KG)


@pytest.mark.parametrize(
    ("model", "name", "per_n"), [(FORCED, "f_in", 1.0), (GROUND, "ag", -1.0 / BODY_KG)]
)
def test_a_body_gains_energy_from_what_moves_it(model: Model, name: str, per_n: float) -> None:
    right = {"x_meas": swung(PUSH), name: per_n * PUSH}
    assert channel_signs.fault(right, model) is None
    for channel in right:
        found = channel_signs.fault({**right, channel: -right[channel]}, model)
        assert found is not None
        assert found.channel == name
        assert "takes energy from the body" in found.seen


@pytest.mark.parametrize("late_s", [-0.005, -0.002, 0.002, 0.005])
@pytest.mark.parametrize("f_hz", [0.7, 1.7, 4.3])
def test_a_force_that_is_a_few_milliseconds_off_takes_no_energy(late_s: float, f_hz: float) -> None:
    push = 60.0 * np.sin(2.0 * np.pi * f_hz * T) * np.minimum(T / 6.0, 1.0)
    x = swung(push)
    shifted = np.interp(T - late_s, T, push)
    assert channel_signs.fault({"x_meas": x, "f_in": shifted}, FORCED) is None


def test_a_body_that_is_released_and_braked_shows_no_sign() -> None:
    """Seen from a wrong zero of the sensor it gains energy, and the brake takes some."""
    slow = replace(FORCED, k=BODY_KG * np.pi**2)  # 0.5 Hz
    x = 0.02 * np.exp(-0.05 * T) * np.cos(np.pi * T) - 0.01
    braked = -0.1 * BODY_KG * np.gradient(x, T)
    gain, rows, v = channel_signs.energy_gained(x, slow, BODY_KG)
    assert gain > 0.0 > float(braked[rows] @ v)
    assert channel_signs.fault({"x_meas": x, "f_in": braked}, slow) is None


# ---- in a file -----------------------------------------------------------------------------------


def damper(t: np.ndarray, x: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    return 3e4 * v


@pytest.mark.parametrize("law", [None, damper])
@pytest.mark.parametrize("head", ["f_meas", "Load cell [N]"])
def test_advice_of_the_message_corrects_the_file(
    law: Callable | None, head: str, tmp_path: Path
) -> None:
    columns = cases.channels(law)
    columns["f_meas"] = -columns["f_meas"]
    recording, toml = cases.write(tmp_path, columns)
    recording.write_text(recording.read_text().replace("f_meas", head, 1))
    model, named = reading.read_model(toml), mapping.read_wishes([f"f_meas={head}"])
    with pytest.raises(InputError, match="wrong sign") as caught:
        reading.read_case(recording, model, wishes=named)
    advice = f'--map f_meas="-{head}"'
    assert advice in str(caught.value)
    turned = mapping.read_wishes([f"f_meas=-{head}"])
    case = reading.read_case(recording, model, wishes=turned)
    assert np.allclose(case.channels["f_meas"], -columns["f_meas"], rtol=1e-6)


def test_who_inverts_a_right_channel_is_told_to_take_it_as_it_is(tmp_path: Path) -> None:
    recording, toml = cases.write(tmp_path, cases.channels(damper))
    model = reading.read_model(toml)
    with pytest.raises(InputError, match=r'give --map f_meas="f_meas"'):
        reading.read_case(recording, model, wishes=mapping.read_wishes(["f_meas=-f_meas"]))


def test_second_recording_with_another_sign_is_to_be_converted_itself(tmp_path: Path) -> None:
    columns = cases.channels(damper)
    recording, toml = cases.write(tmp_path, columns)
    first = reading.read_case(recording, reading.read_model(toml))
    (tmp_path / "second").mkdir()
    columns["f_meas"] = -columns["f_meas"]
    second, _ = cases.write(tmp_path / "second", columns)
    with pytest.raises(InputError, match="invert the column in this file"):
        reading.read_case(second, first.model, judged=False, beside=first)


def test_ground_that_shakes_the_other_way_is_found_by_the_balance_of_a_closed_loop() -> None:
    x_num = swung(PUSH)
    force = 3e3 * x_num
    loop = Model(family="loop", fs_hz=FS, k=3e3, c=0.0, mass=BODY_KG, c_num=20.0)
    inner = BODY_KG * np.gradient(np.gradient(x_num, T), T) + 20.0 * np.gradient(x_num, T)
    right = {"x_num": x_num, "x_meas": x_num, "f_meas": force, "ag": -(inner + force) / BODY_KG}
    channel_sizes.check(right, loop, "loop.csv", {})
    with pytest.raises(InputError, match="opposite sign to what x_num and f_meas leave for it"):
        channel_sizes.check({**right, "ag": -right["ag"]}, loop, "loop.csv", {})
