"""Rig files of several axes: one parser with that of one axis, and every fault with its axis, line,
value and what is allowed."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

from rthyb_rt import config
from rthyb_rt.config import AxesRig, RigFile, plantpoles
from rthyb_rt.config.linkframes import shared_links
from rthyb_rt.config.loading import load_any_rig, parse_any_rig, parse_rig
from rthyb_rt.errors import InputError

SHIPPED = config.shipped_rig("two-axis-frame")
TEXT = SHIPPED.read_text(encoding="utf-8")


def rig(text: str = TEXT, **overrides: str) -> AxesRig:
    given = {key.replace("__", "."): value for key, value in overrides.items()}
    found = parse_any_rig(text, "rig.toml", given)
    assert isinstance(found, AxesRig)
    return found


def changed(*pairs: tuple[str, str]) -> str:
    text = TEXT
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new, 1)
    return text


def faults(text: str) -> list[str]:
    with pytest.raises(InputError) as caught:
        parse_any_rig(text, "rig.toml")
    return [str(problem) for problem in caught.value.problems]


def test_a_file_with_axes_is_a_rig_of_several_and_one_without_is_as_before() -> None:
    two = load_any_rig(SHIPPED)
    assert isinstance(two, AxesRig)
    assert two.names == ("upper", "lower")
    assert two.directions == ("x", "theta")
    one = load_any_rig(config.shipped_rig("shaking-table-portal-frame"))
    assert isinstance(one, RigFile)
    assert one == config.load_rig(config.shipped_rig("shaking-table-portal-frame"))


def test_what_takes_one_axis_says_that_the_rig_has_two() -> None:
    with pytest.raises(
        InputError,
        match=r"rig has several axes \(upper, lower\), but a rig with one axis is needed here",
    ):
        config.load_rig(SHIPPED)


def test_what_was_written_out_reads_back_equal() -> None:
    two = load_any_rig(SHIPPED)
    assert parse_any_rig(config.dump(two)) == two


def test_one_axis_is_a_rig_of_its_own_with_what_it_feels_of_the_specimen() -> None:
    two = rig()
    upper = two.of_axis("upper")
    assert upper.limits.command_position_m is not None
    assert upper.limits.command_position_m.value == 0.03
    assert upper.limits.path_velocity_m_per_s == 0.01
    back = np.linalg.inv(two.core_kinematics().jacobian())
    k = back.T @ np.array(two.specimen.stiffness) @ back
    assert upper.rig.elastic_stiffness_n_per_m == pytest.approx(k[0, 0], rel=1e-12)
    assert upper.rig.name == "two-axis-frame.upper"
    # The view is a file that reads back.
    assert parse_rig(config.dump(upper)).actuator == two.axis[0].actuator
    with pytest.raises(InputError, match=r'"uper".*did you mean "upper".*upper, lower'):
        two.of_axis("uper")


def test_an_axis_is_named_in_overrides() -> None:
    two = parse_any_rig(TEXT, "rig.toml", {"rig.axis.lower.actuator.kp_per_s": "51"})
    assert isinstance(two, AxesRig)
    assert two.axis[1].actuator is not None
    assert two.axis[1].actuator.kp_per_s == 51.0  # type: ignore[union-attr]
    with pytest.raises(InputError, match=r"--set rig\.axis\.lower\.actuator\.kp_per_s: found -1"):
        parse_any_rig(TEXT, "rig.toml", {"rig.axis.lower.actuator.kp_per_s": "-1"})
    second = parse_any_rig(
        TEXT, "rig.toml",
        {"rig.axis.upper.actuator": '{kind = "second-order", natural_frequency_hz = 20, '
                                    "damping_ratio = 0.7}"},
    )  # fmt: skip
    assert isinstance(second, AxesRig)
    assert second.axis[0].actuator is not None
    assert second.axis[0].actuator.kind == "second-order"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        # Keys of an axis, by the parsers of one axis.
        (
            "kp_per_s = 52.0",
            "kp_per_s = -4",
            r"rig.toml:\d+: axis.lower.actuator.kp_per_s: found -4; "
            "the proportional gain must be from 0.01 to 10000 1/s",
        ),
        ("kp_per_s = 52.0", "kp_per_s = nan", r"axis.lower.actuator.kp_per_s: found nan"),
        (
            "noise_std_m = 1.24e-5, lsb",
            "noise_std_m = '1 kg', lsb",
            'axis.upper.sensors.displacement.noise_std_m: found "1 kg"',
        ),
        ('force_n = "40 kN"', "force_mn = 3", r"axis.upper.limits.force_mn: unknown key"),
        (
            'kind = "servo-hydraulic"',
            'kind = "servo"',
            r"axis.upper.actuator.kind: found \"servo\"",
        ),
        # Axes.
        ('name = "lower"', 'name = "upper"', 'axes 1 and 2 are both called "upper"'),
        (
            'name = "lower"',
            'name = "Lower one"',
            'axis.Lower one.name: found "Lower one"; the name of an axis must be up to 24',
        ),
        (
            'kind = "servo-hydraulic"',
            'kind = "servo-valve"\nvalve_n_per_m_s3 = 1e12\n'
            "valve_b1_per_s = 400\nvalve_b2_per_s2 = 1e5\nvelocity_feedback_n_s_per_m2 = 1e6\n"
            "leakage_per_s = 5\n[axis.ignored]",
            "unknown key",
        ),
        (
            "[axis.limits]",
            "[axis.limits]\nramp_in_s = 3",
            "axis.upper.limits: found ramp_in_s, which applies to all axes together: move it to",
        ),
        # Kinematics.
        (
            "lower = [0.2667, -0.127]",
            "lower = [0.2667, 0.127]",
            "kinematics: the pins of upper and "
            r"lower coincide at \[0.2667, 0.127\] m",
        ),
        (
            "lower = [0.2667, -0.127]",
            "lower = [0.9, 0.127]",
            "kinematics: the axes upper, lower do not prevent every motion along x, theta",
        ),
        (
            "lower = [0.2667, -0.127]",
            "other = [0.2667, -0.127]",
            'pins_m: found "other".*; the axes are upper, lower',
        ),
        (", lower = [0.2667, -0.127]", "", "kinematics: pins_m: axis lower is missing"),
        (", lower = [1, 0] }", " }", "axis lower is listed in neither bases_m nor directions"),
        (
            "directions = { upper = [1, 0]",
            "directions = { upper = [0, 0]",
            r"directions: found \[0, 0\] for axis upper; it needs the direction from base to pin",
        ),
        (
            "directions = { upper = [1, 0], lower = [1, 0] }",
            "bases_m = { upper = [0.2667, 0.127], lower = [2, 0] }",
            "axis upper has its pin at its own base",
        ),
        ('interface = ["x", "theta"]', 'interface = ["x", "phi"]', r'kinematics.interface.*"phi"'),
        ('interface = ["x", "theta"]', 'interface = ["x", "x"]', '"x" twice'),
        ('interface = ["x", "theta"]', 'interface = ["x"]', r"found 1 directions \(x\) and 2 axes"),
        ('kind = "pins"', 'kind = "pin"', r'kinematics.kind: found "pin" \(did you mean "pins"'),
        # Specimen.
        (
            "[8.612325e5, 1.085954e6]]",
            "[8.6e5, 1.085954e6]]",
            "specimen.stiffness: found 860000 in "
            "row 2, column 1 and 861232 in row 1, column 2; the stiffness must be .*symmetric",
        ),
        (
            "[[2.324117e6, 8.612325e5]",
            "[[2.324117e5, 8.612325e5]",
            "specimen.stiffness: found a matrix with an eigenvalue of -.*positive definite",
        ),
        (
            "[[8.454, 0.0]",
            "[[-8.454, 0.0]",
            r"specimen.mass: found a matrix with an eigenvalue of "
            "-8.45; a mass must not be negative",
        ),
        ("[[8.454, 0.0]", "[[nan, 0.0]", "specimen.mass: found nan in row 1, column 1"),
        ("[[8.454, 0.0]", "[[1e300, 0.0]", r"specimen.mass: found 1e\+300 in row 1, column 1"),
        ("mass = [[8.454, 0.0], [0.0, 0.8904]]", "mass = [[8.454]]", "specimen.mass: found 1 rows"),
        (
            "mass = [[8.454, 0.0], [0.0, 0.8904]]",
            "mass = [[8.454, 0.0], [0.0]]",
            "found rows of 2, 1",
        ),
        (
            "[specimen]",
            '[[specimen.element]]\nalong = "y"\nlaw = { element = "cubic", k3_n_per_m3 = 1'
            " }\n[specimen]",
            'specimen: element 1: found along = "y"; the directions of the interface',
        ),
        (
            "[specimen]",
            '[[specimen.element]]\nalong = "x"\nlaw = { element = "inertia", m_kg = 1 }\n'
            "[specimen]",
            r'specimen.element.0.law: found "inertia"; enter a mass',
        ),
        # A plant beside actuators.
        (
            "[specimen]",
            "[plant]\na = [[0]]\nb = [[1, 1]]\nc = [[1], [1]]\n[specimen]",
            "axis upper has an actuator, but the file also has a ",
        ),
        ("[specimen]", "[plant]\na = [[0]]\n[specimen]", "found a without b or c"),
    ],
)
def test_a_fault_is_told_with_its_axis_line_value_and_what_is_allowed(
    old: str, new: str, said: str
) -> None:
    found = faults(changed((old, new)))
    assert any(re.search(said, one) for one in found), found
    assert all(re.match(r"rig\.toml:\d+", one) for one in found)


def test_a_fault_points_at_its_line() -> None:
    lines = TEXT.splitlines()
    wanted = 1 + max(i for i, line in enumerate(lines) if line.startswith("kp_per_s"))
    (found,) = faults(changed(("kp_per_s = 52.0", "kp_per_s = -4")))
    assert found.startswith(f"rig.toml:{wanted}: axis.lower.actuator.kp_per_s")


@pytest.mark.parametrize("count", [1, 5])
def test_axes_are_two_to_four(count: int) -> None:
    head, _, rest = TEXT.partition("[[axis]]")
    first, _, rest = rest.partition("[[axis]]")
    tail = rest[rest.index("[kinematics]") :]
    axes = "".join("[[axis]]" + first.replace('"upper"', f'"a{i}"') for i in range(count))
    found = faults(head + axes + tail)
    assert any("axis" in one for one in found)


def test_a_rig_of_a_matrix_and_one_that_is_singular() -> None:
    start, end = TEXT.index("[kinematics]"), TEXT.index("# Force and moment")
    table = (
        '[kinematics]\nkind = "matrix"\ninterface = ["x", "turn"]\nrotations = ["turn"]\n'
        "matrix = [[1, -0.127], [1, 0.127]]\n\n"
    )
    two = rig(TEXT[:start] + table + TEXT[end:])
    assert np.array_equal(two.core_kinematics().jacobian(), [[1, -0.127], [1, 0.127]])
    assert two.kinematics.turns() == [False, True]
    singular = table.replace("[1, 0.127]", "[1, -0.127]")
    (found,) = faults(TEXT[:start] + singular + TEXT[end:])
    assert "one of which is a combination of the others" in found
    (found,) = faults(TEXT[:start] + table.replace('["turn"]\nm', '["twist"]\nm') + TEXT[end:])
    assert 'found the rotation "twist"' in found


# ---- links ---------------------------------------------------------------------------------------


def with_links(upper: str, lower: str) -> str:
    parts = TEXT.split("[axis.limits]")
    return f"{parts[0]}[axis.link]\n{upper}\n[axis.limits]{parts[1]}[axis.link]\n{lower}\n" + (
        f"[axis.limits]{parts[2]}"
    )


def test_two_axes_have_a_bus_each(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(
        with_links('kind = "can"\nchannel = "can0"', 'kind = "can"\nchannel = "can1"'),
        encoding="utf-8",
    )
    two = load_any_rig(path)
    assert isinstance(two, AxesRig)
    assert not shared_links(two)


@pytest.mark.parametrize(
    ("upper", "lower", "said"),
    [
        ('kind = "can"\nchannel = "can0"', 'kind = "can"\nchannel = "can0"',
         "axes upper and lower both use frames with the identifier"),
        ('kind = "serial"\nchannel = "/dev/ttyUSB0"', 'kind = "serial"\nchannel = "/dev/ttyUSB0"',
         'axes upper and lower are both at "/dev/ttyUSB0"'),
    ],
)  # fmt: skip
def test_two_axes_on_one_line_are_refused(
    upper: str, lower: str, said: str, tmp_path: Path
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(with_links(upper, lower), encoding="utf-8")
    with pytest.raises(InputError, match=said) as caught:
        load_any_rig(path)
    assert "axis.lower.link" in str(caught.value)


OWN = """VERSION ""
BU_: pc drive
BO_ {command} Command: 8 pc
 SG_ x_cmd : 0|32@1- (1e-7,0) [-100|100] "m" drive
 SG_ seq : 32|8@1+ (1,0) [0|255] "" drive
 SG_ state : 40|8@1+ (1,0) [0|255] "" drive
BO_ {reading} Reading: 8 drive
 SG_ x_meas : 0|32@1- (1e-7,0) [-100|100] "m" pc
 SG_ f_meas : 32|24@1- (0.1,0) [-800000|800000] "N" pc
 SG_ count : 56|8@1+ (1,0) [0|255] "" pc
"""


def _on_one_bus(folder: Path, second: int, bitrate: str) -> Path:
    pytest.importorskip("cantools")
    for name, first in (("upper", 0x100), ("lower", second)):
        text = OWN.format(command=first, reading=first + 1)
        (folder / f"{name}.dbc").write_text(text, encoding="utf-8")
    links = [
        f'kind = "can"\nchannel = "can0"\ndbc = "{name}.dbc"\n{bitrate}'
        for name in ("upper", "lower")
    ]
    path = folder / "rig.toml"
    path.write_text(with_links(*links), encoding="utf-8")
    return path


def test_identifiers_of_their_own_share_a_bus_that_has_room(tmp_path: Path) -> None:
    two = load_any_rig(_on_one_bus(tmp_path, 0x200, "bitrate = 1000000"))
    assert isinstance(two, AxesRig)
    assert [axis.link.channel for axis in two.axis if axis.link] == ["can0", "can0"]


@pytest.mark.parametrize(
    ("second", "bitrate", "said"),
    [
        (0x101, "bitrate = 1000000", "identifier 0x101"),
        (0x200, "bitrate = 500000", r"4 frames, .* load the bus to \d{3} %, and at most 80 %"),
        (0x200, "", "without a bitrate its load cannot be checked"),
    ],
)
def test_a_bus_that_cannot_be_shared_is_refused(
    second: int, bitrate: str, said: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=said):
        load_any_rig(_on_one_bus(tmp_path, second, bitrate))


def test_all_axes_have_a_link_or_none_and_go_by_one_clock() -> None:
    both = with_links('kind = "can"\nchannel = "can0"', 'kind = "can"\nchannel = "can1"')
    one = both.replace('[axis.link]\nkind = "can"\nchannel = "can1"\n', "")
    assert any("axis lower has no [axis.link]" in found for found in faults(one))
    other = both.replace('"can1"', '"can1"\nclock = "stepped"')
    assert any("found the clocks host, stepped" in found for found in faults(other))


# ---- a plant -------------------------------------------------------------------------------------


def with_plant(table: str) -> str:
    parts = TEXT.split("[axis.actuator]")
    text = parts[0] + "".join(part[part.index("[axis.sensors]") :] for part in parts[1:])
    return text.replace("[specimen]", f"[plant]\n{table}\n[specimen]", 1)


def test_a_plant_is_given_in_the_file_or_beside_it(tmp_path: Path) -> None:
    a, b, c = np.diag([-30.0, -40.0, -50.0]), np.ones((3, 2)), np.ones((2, 3))
    inline = rig(with_plant(f"a = {a.tolist()}\nb = {b.tolist()}\nc = {c.tolist()}"))
    np.savez(tmp_path / "plant.npz", a=a, b=b, c=c)
    (tmp_path / "rig.toml").write_text(with_plant('file = "plant.npz"'), encoding="utf-8")
    read = load_any_rig(tmp_path / "rig.toml")
    assert isinstance(read, AxesRig)
    assert read.plant == inline.plant


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"a": np.eye(2), "b": np.ones((2, 2))}, "has no c; found a, b"),
        ({"a": np.full((2, 2), np.nan), "b": np.ones((2, 2)), "c": np.ones((2, 2))},
         "a: found nan in row 1, column 1"),
        ({"a": np.eye(2) * 1j, "b": np.ones((2, 2)), "c": np.ones((2, 2))}, "a is complex"),
        ({"a": np.eye(40), "b": np.ones((40, 2)), "c": np.ones((2, 40))}, "1 to 32 rows"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_plants_file_is_told_with_file_and_line(
    values: dict[str, np.ndarray], said: str, tmp_path: Path
) -> None:
    np.savez(tmp_path / "plant.npz", **values)
    (tmp_path / "rig.toml").write_text(with_plant('file = "plant.npz"'), encoding="utf-8")
    with pytest.raises(InputError, match=said) as caught:
        load_any_rig(tmp_path / "rig.toml")
    assert "plant.npz" in str(caught.value)
    assert "plant.file" in str(caught.value)


def test_a_plant_of_other_axes_and_one_that_is_not_there(tmp_path: Path) -> None:
    (found,) = faults(with_plant("a = [[-1]]\nb = [[1, 1, 1]]\nc = [[1], [1]]"))
    assert "b of 1 x 3" in found
    (tmp_path / "rig.toml").write_text(with_plant('file = "none.npz"'), encoding="utf-8")
    with pytest.raises(InputError, match="no such file"):
        load_any_rig(tmp_path / "rig.toml")
    (found, *_) = faults(with_plant(""))
    assert "missing; give exactly one of file, a" in found


def _plant_of(a: list[list[float]]) -> str:
    n = len(a)
    return with_plant(f"a = {a}\nb = {np.ones((n, 2)).tolist()}\nc = {np.ones((2, n)).tolist()}")


def _oscillating(frequency_hz: float, damping_ratio: float) -> list[list[float]]:
    omega = 2.0 * np.pi * frequency_hz
    return [[0.0, 1.0], [-(omega**2), -2.0 * damping_ratio * omega]]


@pytest.mark.parametrize(
    ("a", "said"),
    [
        (_oscillating(3.5, -0.02), "a pole at 3.5 Hz with a damping ratio of -0.02, whose motion "
         "grows by a factor of e every 2.27 s"),
        ([[-30.0, 0.0], [0.0, 0.4]], "a pole at 0.4 per second, whose motion grows by a "
         "factor of e every 2.5 s"),
        # The same oscillator per sample of 1/1024 s, as identification programs often write it.
        (scipy.linalg.expm(np.array(_oscillating(3.5, 0.02)) / 1024.0).tolist(),
         "convert the matrices of a model in discrete time"),
    ],
)  # fmt: skip
def test_a_plant_that_runs_off_by_itself_is_refused_with_its_pole(
    a: list[list[float]], said: str, tmp_path: Path
) -> None:
    (found,) = faults(_plant_of(a))
    assert said in found
    np.savez(tmp_path / "plant.npz", a=np.array(a), b=np.ones((2, 2)), c=np.ones((2, 2)))
    (tmp_path / "rig.toml").write_text(with_plant('file = "plant.npz"'), encoding="utf-8")
    with pytest.raises(InputError, match=r"plant\.npz: a: found a pole at"):
        load_any_rig(tmp_path / "rig.toml")


def test_a_plant_that_integrates_is_accepted_with_a_note() -> None:
    # With the rounding of an eigenvalue beside a fast pole.
    accepted = rig(_plant_of([[-2e4, 0.0], [0.0, 1e-7]]))
    assert accepted.notes == [
        "[plant] has poles that neither decay nor grow (0 Hz): a constant command can move an axis "
        "without end"
    ]
    (ringing,) = rig(_plant_of(_oscillating(3.5, 0.0))).notes
    assert "motions at this frequency do not die out" in ringing
    assert "3.5 Hz" in ringing
    assert rig(_plant_of(_oscillating(3.5, 0.02))).notes == []


DOUBLE = [[0.0, 1.0], [0.0, 0.0]]
FAST = [_oscillating(20.0, 0.3), [[-1e4]]]
OF_STATES: dict[str, tuple[list[list[list[float]]], str]] = {
    "oil column moves a free mass": ([DOUBLE, *FAST], "0 Hz"),
    "two free masses": ([DOUBLE, DOUBLE, *FAST], "0 Hz"),
    "free mass behind an integrator": (
        [[[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]], *FAST], "0 Hz",
    ),
    "two actuators that integrate": ([[[0.0]], [[0.0]], *FAST], "0 Hz"),
    "an undamped motion": ([_oscillating(3.0, 0.0), *FAST], "3 Hz"),
    "decays in 10 s": ([[[-0.1]], *FAST], "decays"),
    "grows in 1000 s": ([[[1e-3]], *FAST], "grows"),
    "grows in 1000 s beside an integrator": ([[[1e-3]], [[0.0]], *FAST], "grows"),
    "vibrates and grows in 1000 s": (
        [_oscillating(3.0, -1e-3 / (6.0 * np.pi)), _oscillating(20.0, 0.3)], "grows",
    ),
    "tips over": ([[[0.0, 1.0], [1.0, 0.0]], *FAST], "grows"),
}  # fmt: skip


def _turned(rng: np.random.Generator, n: int, condition: float) -> np.ndarray:
    """A transformation of n states with a given condition."""
    one, other = (np.linalg.qr(rng.normal(size=(n, n)))[0] for _ in range(2))
    return one * np.geomspace(1.0, condition, n) @ other


def _verdict(a: list[list[float]]) -> str:
    """Whether a plant grows or decays, or the frequency that stays, Hz to two digits."""
    if plantpoles.fault(a) is not None:
        return "grows"
    found = re.search(r"\((\S+) Hz", plantpoles.note(a) or "")
    return f"{float(found.group(1)):.2g} Hz" if found else "decays"


@pytest.mark.parametrize("condition", [1.0, 1e2, 1e4])
@pytest.mark.parametrize(("blocks", "is_so"), OF_STATES.values(), ids=OF_STATES)
def test_the_verdict_on_a_plant_is_the_same_in_all_coordinates(
    blocks: list[list[list[float]]], is_so: str, condition: float
) -> None:
    rng = np.random.default_rng(39)
    a = scipy.linalg.block_diag(*blocks)
    for i in range(100):
        by = _turned(rng, len(a), condition)
        # Every other one also in units from micrometres to kilometres.
        units = 10.0 ** rng.integers(-6, 4, len(a)) if i % 2 else np.ones(len(a))
        turned = units[:, None] * (by @ a @ np.linalg.inv(by)) / units
        assert _verdict(turned.tolist()) == is_so


def _drifting(seconds: float, frequency_hz: float = 0.0) -> list[list[float]]:
    """A motion that grows by a factor of e in this time, with a frequency or without one."""
    if not frequency_hz:
        return [[1.0 / seconds]]
    return _oscillating(frequency_hz, -1.0 / (2.0 * np.pi * frequency_hz * seconds))


BESIDE: dict[str, list[list[list[float]]]] = {
    "nothing": [], "an integrator": [[[0.0]]], "two integrators in series": [DOUBLE],
    "an undamped motion": [_oscillating(3.0, 0.0)],
}  # fmt: skip


@pytest.mark.parametrize("frequency_hz", [0.0, 3.0])
@pytest.mark.parametrize("beside", BESIDE.values(), ids=BESIDE)
@pytest.mark.parametrize(
    ("seconds", "condition", "times"), [(100.0, 1e4, 5.0), (1000.0, 1e2, 3000.0)]
)
def test_slow_growth_is_told_from_rounding_with_the_margin_that_is_stated(
    seconds: float,
    condition: float,
    times: float,
    beside: list[list[list[float]]],
    frequency_hz: float,
) -> None:
    """By how much more than its rounding a must change, so that the growth might be none."""
    rng = np.random.default_rng(39)
    a = scipy.linalg.block_diag(_drifting(seconds, frequency_hz), *beside, *FAST)
    for _ in range(40):
        by = _turned(rng, len(a), condition)
        turned = (by @ a @ np.linalg.inv(by)).tolist()
        assert plantpoles.growing(turned, times * 2.0**-51)


def test_slower_growth_in_ill_conditioned_states_has_no_such_margin() -> None:
    """As the guide says of [plant]."""
    rng = np.random.default_rng(39)
    a = scipy.linalg.block_diag(_drifting(1000.0), DOUBLE, *FAST)
    found = set()
    for _ in range(100):
        by = _turned(rng, len(a), 1e4)
        turned = (by @ a @ np.linalg.inv(by)).tolist()
        found.add(bool(plantpoles.growing(turned, 3.0 * 2.0**-51)))
    assert found == {True, False}


def test_double_integrator_written_with_few_digits_is_refused_with_a_hint() -> None:
    rng = np.random.default_rng(2)
    plant, hinted = scipy.linalg.block_diag(DOUBLE, [[-40.0]], [[-60.0]]), 0
    for _ in range(20):
        by = _turned(rng, 4, 2.0)
        few = [[float(f"{v:.6g}") for v in row] for row in by @ plant @ np.linalg.inv(by)]
        refused = plantpoles.fault(few)
        assert refused is None or refused.endswith("write the numbers of a with all their digits")
        hinted += refused is not None
    assert hinted >= 5
    (other,) = faults(_plant_of([[-30.0, 0.0], [0.0, 0.4]]))
    assert "digits" not in other


@pytest.mark.parametrize("a", ["5", "[[1, 2]]", '[["one"]]'])
def test_matrix_that_a_message_on_a_plant_suggests_is_accepted(a: str) -> None:
    (found, *_) = faults(with_plant(f"a = {a}\nb = [[1, 0], [0, 1]]\nc = [[1, 0], [0, 1]]"))
    suggested = found[found.index(": [[") + 2 :]
    accepted = rig(with_plant(f"a = {suggested}\nb = [[1, 0], [0, 1]]\nc = [[1, 0], [0, 1]]"))
    assert accepted.plant is not None
    assert accepted.notes == []


def test_the_schema_knows_both_kinds_of_rigs() -> None:
    schema = config.json_schema("rig")
    assert "axis" in schema["then"]["properties"]
    assert "actuator" in schema["else"]["properties"]
    assert "Axis" in schema["$defs"]
