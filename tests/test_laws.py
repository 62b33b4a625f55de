"""Control laws as parts: what holds of every one of them, whatever it computes."""

from __future__ import annotations

import ast
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Rthyb
from kernels import FS_HZ, Floats, H, smooth_motion, time_s
from rthyb_rt._core import ffi, lib

import rthyb_rt
from rthyb_rt import config, core, units
from rthyb_rt.config import lawtables
from rthyb_rt.core.laws import LAWS, PASSING, LawDescription, Parameter, parameters
from rthyb_rt.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
STATUS = core.STATUS

each_law = pytest.mark.parametrize("name", LAWS)


def settings_of(law: LawDescription, **changes: float) -> dict[str, float]:
    """A law's defaults; a delay that only a rig knows is eight samples."""
    found = {p.key: 8.0 if p.default is None else p.default for p in law.parameters}
    return found | owed(law) | changes


def owed(law: LawDescription) -> dict[str, float]:
    """What only a test file can give: the middle of its range."""
    return {
        p.key: 0.5 * (p.low + p.high)
        for p in law.parameters
        if p.default is None and p.rig_key is None
    }


def config_of(name: str, **more: Any) -> core.LawConfig:
    return core.LawConfig(name, settings_of(LAWS[name]), rest_noise_m=1e-6, **more)


def lagging(x: Floats, samples: int = 8) -> Floats:
    return np.concatenate([np.full(samples, x[0]), x[:-samples]])


def run(law: core.Law, x_c: Floats, x_m: Floats, allowed_m: float = math.inf) -> Floats:
    """Commands that a law gives for x_c while x_m comes back."""
    sent, out = x_c[0], np.empty_like(x_c)
    for n, (c, m) in enumerate(zip(x_c, x_m, strict=True)):
        law.observe(sent, m)
        sent, _ = law.lead(c, allowed_m)
        out[n] = sent
    return out


# ---- what there is ------------------------------------------------------------------------------


def test_every_file_of_a_law_is_one_that_the_program_has() -> None:
    files = {path.stem.removeprefix("law_") for path in (ROOT / "csrc").glob("law_*.c")}
    assert files == {name.replace("-", "_") for name in LAWS}
    assert {"none", "paper", "robust", "alpha-beta"} <= set(LAWS)


@pytest.mark.long
def test_no_module_asks_for_a_law_by_its_name() -> None:
    """What a law needs is in its own table. Old recordings and the paper's studies name some.

    In the diagnosis the same words may mean something else: a slope is one of a force there.
    """
    package = Path(rthyb_rt.__file__).parent
    named = {package / "core" / "station.py", *package.glob("studies/*.py")}
    named |= set(package.glob("diagnose/**/*.py"))
    asked = [
        f"{path.relative_to(package)}:{node.lineno}: {constant.value}"
        for path in sorted(package.rglob("*.py"))
        if path not in named
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Compare)
        for side in (node.left, *node.comparators)
        for constant in ast.walk(side)
        if isinstance(constant, ast.Constant) and constant.value in set(LAWS) - {"none"}
    ]
    assert asked == []


def test_one_law_alone_compensates_nothing() -> None:
    assert [law.name for law in LAWS.values() if law.passes] == [PASSING.name]
    assert PASSING.parameters == ()


def test_laws_are_found_by_name_and_by_no_other() -> None:
    for name, law in LAWS.items():
        assert lib.rthyb_law_find(name.encode()) == law.kind
    assert lib.rthyb_law_find(b"papr") == -1
    for kind in (-1, len(LAWS), 2**31 - 1):
        assert lib.rthyb_law_describe(kind) == ffi.NULL
        assert lib.rthyb_law_state_size(kind) == 0
        made = ffi.new("rthyb_law_config *", {"kind": kind, "adapts": 1})
        assert lib.rthyb_law_init(ffi.new("rthyb_law *"), made, H, 0.0) == lib.RTHYB_E_LAW


@each_law
def test_a_laws_table_is_one_that_files_figures_and_summaries_can_be_made_of(name: str) -> None:
    law = LAWS[name]
    assert law.meaning
    assert law.state_bytes <= lib.RTHYB_LAW_STATE_BYTES
    assert len(law.parameters) <= lib.RTHYB_LAW_PARAMETERS_MAX
    assert len(law.values) <= lib.RTHYB_LAW_VALUES_MAX
    assert len({p.key for p in law.parameters}) == len(law.parameters)
    assert len({v.name for v in law.values}) == len(law.values)
    for p in law.parameters:
        assert re.fullmatch(r"([a-z][a-z0-9_]*\.)?[a-z][a-z0-9_]*", p.key)
        assert math.isfinite(p.low)
        assert math.isfinite(p.high)
        assert p.low < p.high
        if p.default is not None:
            assert lawtables.range_of(p).read(p.default) == p.default
        if p.words is not None:
            assert "{}" in p.words
        units.unit(p.unit)
    for value in law.values:
        assert value.label


def test_a_key_that_several_laws_read_means_the_same_to_each() -> None:
    for users in parameters().values():
        assert len({parameter for _, parameter in users}) == 1


# ---- from the table to the file -----------------------------------------------------------------

TEST = """schema = "rthyb-test/1"
[test]
name = "plate"
[numerical]
mass_kg = 4220
damping_n_s_per_m = 2121
[controller]
"""


@each_law
def test_every_setting_of_a_law_has_its_key_its_range_and_its_place_in_the_schema(
    name: str,
) -> None:
    schema = config.json_schema("test")
    for p in LAWS[name].parameters:
        # Far out, with a message that says what is allowed.
        value = p.high * 2.0 + 1.0
        with pytest.raises(InputError) as caught:
            config.parse_test(TEST + f'type = "{name}"\n{p.key} = {value!r}\n', "test.toml")
        (message,) = [str(e) for e in caught.value.problems if f"controller.{p.key}" in e.where]
        assert "test.toml:9" in message
        assert f"{p.meaning} must be" in message
        place = schema["$defs"]["Controller"]
        for part in p.key.split(".")[:-1]:
            options = place["properties"][part]
            reference = options.get("$ref") or options["anyOf"][0]["$ref"]
            place = schema["$defs"][reference.rsplit("/", 1)[1]]
        assert p.key.rsplit(".", 1)[-1] in place["properties"]


@each_law
def test_a_resolved_file_states_all_that_its_law_reads(name: str) -> None:
    rig = config.load_rig(config.shipped_rig("shaking-table-portal-frame"))
    given = "".join(f"{key} = {value!r}\n" for key, value in owed(LAWS[name]).items())
    test = config.parse_test(TEST + f'type = "{name}"\n{given}')
    derived = config.derive(test, rig)
    text = config.dump(config.resolve(test, derived))
    again = config.parse_test(text)
    assert {p.key: again.controller.setting(p.key) for p in LAWS[name].parameters} == dict(
        derived.law_settings
    )
    assert config.derive(again, rig).law_settings == derived.law_settings


@pytest.mark.parametrize(
    ("rig_key", "unit", "said"),
    [
        (
            None,
            "s",
            "missing, and it has no default; give controller.ours.depth in the test file: "
            "the depth must be from 1 to 4 s",
        ),
        (
            "identified.depth_m",
            "",
            'missing, and rig "shaking-table-portal-frame" has no identified.depth_m to use '
            "instead; give controller.ours.depth, or run `rthyb identify RIG`",
        ),
    ],
)
def test_a_setting_without_a_default_is_asked_for_where_it_can_be_given(
    monkeypatch: pytest.MonkeyPatch, rig_key: str | None, unit: str, said: str
) -> None:
    """A law of a laboratory's own whose table has NaN for a default, with and without a rig key."""
    depth = Parameter(
        "ours.depth", unit, 1.0, 4.0, None, "the depth", False, False, rig_key, words=None
    )
    ours = replace(LAWS["ats"], name="ours", parameters=(*LAWS["ats"].parameters, depth))
    monkeypatch.setitem(LAWS, "ours", ours)
    test = config.parse_test(TEST + 'type = "ats"\n')
    test = test.model_copy(
        update={"controller": test.controller.model_copy(update={"type": "ours"})}
    )
    with pytest.raises(InputError) as caught:
        config.derive(test, config.load_rig(config.shipped_rig("shaking-table-portal-frame")))
    assert [str(each) for each in caught.value.problems] == [f"controller.ours.depth: {said}"]
    # The benchmark leaves out a law that has to be told something by a test file.
    assert ours.runs_unset == (rig_key is not None)
    assert LAWS["ats"].runs_unset


def test_settings_of_a_law_that_is_not_chosen_are_left_as_they_are() -> None:
    text = config.dump(config.parse_test(TEST + "alpha0 = 3\n"))
    own = {p.key.split(".")[0] for law in LAWS.values() for p in law.parameters if "." in p.key}
    for table in own - {"delay_estimator"}:
        assert f"[controller.{table}]" not in text


def test_settings_on_the_command_line_for_a_law_that_is_not_chosen_are_named(
    rthyb: Rthyb, tmp_path: Path
) -> None:
    other, shared = "controller.amb.cutoff_hz", "controller.delay_estimator.memory_s"
    given = ("--set", f"{other}=10", "--set", f"{shared}=3")

    def notes(kind: str) -> list[str]:
        answer = rthyb("check", "section4.2", "--set", f"controller.type={kind}", *given)
        assert answer.code == 0, answer.err
        return [line for line in answer.err.splitlines() if "is not used" in line]

    assert notes("ats") == [
        f"rthyb: note: --set {other} is not used: it belongs to the control law amb, and "
        "controller.type is ats",
        f"rthyb: note: --set {shared} is not used: it belongs to the control law alpha-beta, and "
        "controller.type is ats",
    ]
    assert [line.split()[3] for line in notes("amb")] == [shared]
    assert [line.split()[3] for line in notes("alpha-beta")] == [other]
    # In a file, the table of another law may stand ready.
    test = tmp_path / "test.toml"
    test.write_text(TEST + 'type = "ats"\namb.cutoff_hz = 10\n', encoding="utf-8")
    answer = rthyb("check", test, "--rig", "shaking-table-portal-frame")
    assert (answer.code, answer.err) == (0, "")
    # A sweep over laws sets what only some of them use.
    assert lawtables.unused(["ats", "amb"], [f"{other}=10"]) == []


def test_a_setting_that_the_law_has_not_is_refused() -> None:
    with pytest.raises(core.CoreError, match=r"found delay_estimator\.memory_s; it accepts w1, w2"):
        core.Law(core.LawConfig("paper", {"alpha0": 8.0, "delay_estimator.memory_s": 2.0}))
    with pytest.raises(core.CoreError, match="alpha0 missing"):
        core.Law(core.LawConfig("paper"))
    with pytest.raises(core.CoreError, match="is unknown; the control laws are"):
        core.Law(core.LawConfig("papr"))


@each_law
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_setting_that_is_no_number_is_refused_by_the_core(name: str, value: float) -> None:
    for key in settings_of(LAWS[name]):
        with pytest.raises(core.CoreError):
            core.Law(core.LawConfig(name, settings_of(LAWS[name]) | {key: value}))


@each_law
def test_settings_beyond_any_sense_are_refused_or_keep_the_command_finite(name: str) -> None:
    """Test files have ranges; who asks the core itself may go beyond them."""
    x = smooth_motion(2.0, 3)
    for key in settings_of(LAWS[name]):
        for value in (-1e300, -1.0, 0.0, 1e-300, 1e6, 1e300):
            try:
                law = core.Law(core.LawConfig(name, settings_of(LAWS[name]) | {key: value}))
            except core.CoreError:
                continue
            led = run(law, x, lagging(x))
            assert np.isfinite(led).all() or abs(value) >= 1e6, (key, value)


# ---- at work ------------------------------------------------------------------------------------


@each_law
def test_a_law_goes_on_from_its_saved_bytes_as_if_nothing_had_been(name: str) -> None:
    x = smooth_motion(6.0, 1)
    m = lagging(x)
    whole = run(core.Law(config_of(name)), x, m)
    first, second = core.Law(config_of(name)), core.Law(config_of(name))
    half = x.size // 2
    before = run(first, x[:half], m[:half])
    run(second, 0.3 * x[:half], m[:half])
    second.restore(first.save())
    sent, after = before[-1], np.empty(x.size - half)
    for n in range(half, x.size):
        second.observe(sent, m[n])
        sent, _ = second.lead(x[n])
        after[n - half] = sent
    np.testing.assert_array_equal(np.concatenate([before, after]), whole)
    np.testing.assert_array_equal(before, run(core.Law(config_of(name)), x[:half], m[:half]))


@each_law
def test_the_controller_is_that_of_plain_bytes_as_well(name: str) -> None:
    """All of it copied in mid-test, the law's state with it."""

    def made() -> core.Controller:
        rfc = core.RfcConfig(k_e_n_per_m=1e6)
        motion = core.MotionConfig("central-difference", mass_kg=4000.0, k_e_n_per_m=1e6)
        return core.Controller(core.ControllerConfig(config_of(name), rfc, motion))

    def steps(c: core.Controller, n: int) -> list[dict[str, float | int]]:
        return [
            c.step(c.x_cmd_m, 1e6 * c.x_cmd_m, 0.3 * math.sin(i / 30.0)).record for i in range(n)
        ]

    one, other = made(), made()
    steps(one, 700)
    ffi.memmove(other._c, one._c, ffi.sizeof("rthyb_controller"))
    np.testing.assert_equal(steps(other, 300), steps(one, 300))


@each_law
def test_a_frozen_law_learns_nothing(name: str) -> None:
    x = smooth_motion(4.0, 2)
    frozen, unasked = core.Law(config_of(name)), core.Law(config_of(name, adapts=False))
    begin = frozen.report()
    for c, m in zip(x, lagging(x, 15), strict=True):
        frozen.observe(c, m, frozen=True)
        unasked.observe(c, m)
        frozen.lead(c)
        unasked.lead(c)
    assert frozen.report() == begin
    assert unasked.report() == begin
    assert list(begin) == [value.name for value in LAWS[name].values]


@each_law
def test_what_is_learnt_moves_the_command_by_no_more_than_is_allowed(name: str) -> None:
    """Beside a law whose state is the same but for what it has learnt in this tick."""
    x = smooth_motion(8.0, 5)
    m = lagging(x, 25)
    allowed, sent, learnt = 2e-6, 0.0, 0.0
    law, still = core.Law(config_of(name)), core.Law(config_of(name))
    for c, measured in zip(x, m, strict=True):
        law.observe(sent, measured)
        still.restore(law.save())
        held, _ = still.lead(c, 0.0)
        sent, _ = law.lead(c, allowed)
        assert abs(sent - held) <= allowed * (1 + 1e-6) + 1e-15
        learnt = max(learnt, abs(sent - held))
    assert learnt > 0.5 * allowed or not LAWS[name].learns


@each_law
@pytest.mark.parametrize("x_m", [0.0, 0.011, -0.4])
def test_who_stands_is_led_nowhere(name: str, x_m: float) -> None:
    x = smooth_motion(5.0, 4)
    law = core.Law(config_of(name))
    run(law, x, 0.97 * lagging(x, 12))
    law.rest(x_m)
    for _ in range(100):
        led, code = law.lead(x_m, 0.0)
        assert code == 0
        assert led == pytest.approx(x_m, rel=1e-12, abs=1e-15)


@each_law
def test_the_way_from_a_rest_to_zero_ends_there(name: str) -> None:
    x = smooth_motion(5.0, 4)
    law = core.Law(config_of(name))
    run(law, x, 0.97 * lagging(x, 12))
    law.rest(0.02)
    t = np.linspace(0.0, 1.0, 2048)
    for c in (*(0.01 * (1.0 + np.cos(np.pi * t))), *np.zeros(1024)):
        led, _ = law.lead(float(c), 0.0)
    assert abs(led) < 1e-9


BAD = [math.nan, math.inf, -math.inf, 1e300, -1e300]


@each_law
@pytest.mark.parametrize("bad", BAD)
def test_a_bad_value_is_told_and_leaves_the_law_where_the_last_good_one_did(
    name: str, bad: float
) -> None:
    x = smooth_motion(4.0, 6)
    m = lagging(x)
    dirty, held = core.Law(config_of(name)), core.Law(config_of(name))
    expected = STATUS["not_finite"] if not math.isfinite(bad) else STATUS["out_of_range"]
    last_c, last_p, last_m, sent = 0.0, 0.0, 0.0, 0.0
    for n, (c, measured) in enumerate(zip(x, m, strict=True)):
        which = n % 211 if n > 500 else -1
        p = bad if which == 0 else sent
        measured = bad if which == 1 else measured
        c = bad if which == 2 else c
        code = dirty.observe(p, measured)
        assert code == (expected if which in (0, 1) else 0)
        good = which not in (0, 1)
        last_p, last_m = (
            (p if p != bad and p == p else last_p),
            (measured if measured != bad and measured == measured else last_m),
        )
        held.observe(last_p, last_m, frozen=not good)
        led, code = dirty.lead(c)
        assert code == (expected if which == 2 else 0)
        last_c = last_c if which == 2 else c
        other, _ = held.lead(last_c)
        assert led == other
        assert math.isfinite(led)
        sent = led
    values = list(dirty.report().values())
    assert np.isfinite(values).all()


@each_law
@pytest.mark.parametrize("x0_m", BAD)
def test_a_start_where_nothing_can_be_is_refused(name: str, x0_m: float) -> None:
    with pytest.raises(core.CoreError):
        core.Law(config_of(name), x0_m)
    law = core.Law(config_of(name), 0.003)
    before = law.save()
    law.rest(x0_m)
    assert law.save() == before


@pytest.mark.parametrize("fs_hz", [256.0, 512.0, 2048.0, 4096.0])
@each_law
def test_a_law_begins_with_the_same_lead_in_time_at_every_rate(name: str, fs_hz: float) -> None:
    """On a slow straight motion, long after its beginning: the way ahead in seconds. The rig's
    delay is one of whole samples at every rate."""
    delays = [p.key for p in LAWS[name].parameters if p.rig_key == "identified.delay_s"]
    settings = settings_of(LAWS[name], **dict.fromkeys(delays, 16 / 1024))

    def ahead_s(rate: float) -> float:
        law = core.Law(core.LawConfig(name, settings), period_s=1.0 / rate)
        t = np.arange(round(2.0 * rate)) / rate
        x = 0.001 * t
        return float((law.run(x)[-1] - x[-1]) / 0.001)

    assert ahead_s(fs_hz) == pytest.approx(ahead_s(FS_HZ), rel=1e-6, abs=1e-9)


# ---- the four that have always been there -------------------------------------------------------


@pytest.mark.parametrize("velocity_limit", [0.0, 0.1])
@pytest.mark.parametrize("name", ["paper", "robust", "alpha-beta"])
def test_controller_leads_as_phase_lead_and_estimator_do_side_by_side(
    name: str, velocity_limit: float
) -> None:
    """Kernel by kernel, to the last bit: the estimate follows the pair, alpha and beta follow the
    estimate by an increment limit a tick, and the compensator leads by them."""
    kernel = {"paper": "gradient", "robust": "robust", "alpha-beta": "rls"}[name]
    gain = {"paper": 0.3, "robust": 0.01, "alpha-beta": 0.0}[name]
    w1, w2, noise = 2.5, -1.2, 2e-6
    keys = {"paper": "gain_per_mm2_per_sample", "robust": "rate_per_sample"}
    own = {f"delay_estimator.{keys[name]}": gain} if name in keys else {}
    law = core.LawConfig(name, {"w1": w1, "w2": w2, "alpha0": 5.0} | own, rest_noise_m=noise)
    controller = core.Controller(
        core.ControllerConfig(
            law,
            core.RfcConfig(k_e_n_per_m=1e6, enabled=False),
            core.MotionConfig("prescribed"),
            velocity_limit_m_per_s=velocity_limit,
        )
    )
    rig = core.VirtualRig(
        core.RigConfig(
            core.ServoConfig("pure-delay", delay_samples=14),
            displacement=core.SensorConfig(noise_std=noise),
        )
    )
    t = time_s(6.0)
    command = smooth_motion(6.0, 6) + 1e-4 * np.sin(2 * np.pi * 20.0 * t)
    records = np.zeros(command.size - 1, core.RECORD_DTYPE)
    controller.run_virtual(rig, command, records)
    estimator = core.Estimator(
        core.EstimatorConfig(
            law=kernel,  # type: ignore[arg-type]
            estimate_beta=name == "alpha-beta",
            alpha0=5.0,
            gain=gain,
            rest_noise_m=noise,
        ),
        w1=w1,
        w2=w2,
    )
    plc = core.Plc(w1, w2)
    alpha, beta, x1, x2 = 5.0, 0.0, 0.0, 0.0
    allowed = velocity_limit * H
    for n, row in enumerate(records):
        estimator.step(row["x_cmd_m"], row["x_meas_m"])
        x = command[n + 1]
        wanted = min(max(estimator.alpha, 0.0), 60.0)
        if allowed > 0.0:
            s = (w1 + w2 + 1.0) / w1
            d_alpha, d_beta = wanted - alpha, estimator.beta - beta
            effect = abs(s) * (abs(d_alpha * (x - x1)) + abs(d_beta * (x - 2.0 * x1 + x2)))
            share = allowed / effect if effect > allowed else 1.0
            alpha, beta = alpha + share * d_alpha, beta + share * d_beta
        else:
            alpha, beta = wanted, estimator.beta
        led, _ = plc.step(alpha, beta, x)
        x1, x2 = x, x1
        assert (row["alpha"], row["beta"]) == (alpha, beta)
        if n + 1 < records.size:
            assert records["x_plc_m"][n + 1] == led
    assert np.ptp(records["alpha"]) > 1.0
