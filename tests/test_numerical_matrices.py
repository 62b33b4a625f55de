"""A numerical part by its matrices: the test file's table, modes and stability, the reference
simulation with the specimen joined, and whole tests in virtual time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from command_line import Rthyb
from kernels import Floats
from test_numerical_dense import C, K, M, frame

from rthyb_rt import config, core
from rthyb_rt.analysis import margins, numerical_margins, summary
from rthyb_rt.config.numerical_structure import Structure
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, virtual_time

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "frame-three-storeys.toml"
TEST = """schema = "rthyb-test/1"
[test]
name = "frame"
[ground_motion]
factor = 0.4
[numerical.matrices]
m_kg = [1000, "1 t", 1000]
k_n_per_m = [[4e6, -2e6, 0], [-2e6, 4e6, -2e6], [0, -2e6, 2e6]]
damping_ratios = ["5 %"]
labels = ["first", "second", "third"]
interface = "first"
"""
RIG = """schema = "rthyb-rig/1"
[rig]
name = "column"
elastic_stiffness_n_per_m = 1.19e6
load_cell = "specimen"
[actuator]
kind = "pure-delay"
delay_samples = 1
[[specimen]]
element = "stiffness"
k_n_per_m = 1.19e6
[identified]
alpha = 1
delay_s = 0.0009765625
"""


def refused(old: str = "", new: str = "", rig: str = RIG) -> str:
    assert old in TEST
    with pytest.raises(InputError) as caught:
        config.derive(config.parse_test(TEST.replace(old, new), "t.toml"), config.parse_rig(rig))
    return str(caught.value)


def derived(text: str = TEST, rig: str = RIG) -> config.Derived:
    return config.derive(config.parse_test(text), config.parse_rig(rig))


# --- the table -----------------------------------------------------------------------------------


def test_every_form_of_a_matrix_reads_back_equal() -> None:
    test = config.parse_test(TEST + 'specimen = { mass_kg = "30 kg" }\n')
    assert config.parse_test(config.dump(test)) == test
    matrices = test.numerical.matrices
    assert matrices is not None
    assert matrices.m_kg == (1000.0 * np.eye(3)).tolist()
    assert matrices.at == 0


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[-2e6, 4e6, -2e6]", "[-2e6, 4e6]", (":8", "row 2 has 2 numbers", "must have 3")),
        ("[-2e6, 4e6, -2e6]", "7", (":8", "row 2 is 7", "must have 3")),
        ("[0, -2e6, 2e6]", "[1, -2e6, 2e6]", (":8", "row 3, column 1", "must be symmetric")),
        ("-2e6, 2e6]", '-2e6, "2 kg"]', (":8", "row 3, column 3", "that is a mass", "N/m")),
        ("-2e6, 2e6]", "-2e6, nan]", (":8", "row 3, column 3", "found nan")),
        ("-2e6, 2e6]", "-2e6, inf]", (":8", "row 3, column 3", "found inf")),
        ('"1 t"', "0", (":7", "found 0 kg in row 2", "static condensation")),
        ('"1 t"', "-3", (":7", "found -3 kg in row 2", "above 0")),
        ('[1000, "1 t", 1000]', "[[1, 2, 0], [2, 1, 0], [0, 0, 1]]", ("positive definite",)),
        ('[1000, "1 t", 1000]', "[1000, 1000]", ("k_n_per_m: found 3 rows; must be 2",)),
        ('[1000, "1 t", 1000]', "[]", ("m_kg: found a list of 0", "1 to 8 rows")),
        ('[1000, "1 t", 1000]', "[1, 1, 1, 1, 1, 1, 1, 1, 1]", ("a list of 9", "1 to 8 rows")),
        ('[1000, "1 t", 1000]', '"1 t"', ('found "1 t"', "symmetric matrix [kg]")),
        ('"5 %"', '"5 %", 0.1', ("found 2 ratios; must be 3",)),
        ('"5 %"', "-0.1", ("number 1: found -0.1", "from 0 to 2")),
        ("damping_ratios", "damping_ratio", ("damping_ratios",)),
        ('damping_ratios = ["5 %"]', "", ("exactly one of c_n_s_per_m, damping_ratios",)),
        ('"first", "second"', '"first", "first"', ('found "first" twice',)),
        ('"first", "second"', '"first"', ("found 2 labels; must be 3",)),
        ('interface = "first"', 'interface = "roof"', ('found "roof"', '"second"', "1 to 3")),
        ('interface = "first"', "interface = 4", ("found 4", "a number from 1 to 3")),
        ('interface = "first"', "interface = 9", ("found 9",)),
        ("interface", "influence = [1, 1]\ninterface", ("found 2 numbers; must be 3",)),
        ("interface", "force_delay_samples = 2\ninterface", ("found 2", "from 0 to 1")),
        ("interface", 'integrator = "kr"\ninterface', ('"cr", "rk4"',)),
        (
            "interface",
            "specimen.mass_kg = 1000\ninterface",
            ("1000 kg", "that remains to be computed"),
        ),
        ("[numerical.mat", "[numerical]\nmass_kg = 3\n[numerical.mat", ("keep only one of",)),
        (
            "[numerical.mat",
            '[numerical]\nintegrator = "kr-alpha"\n[numerical.mat',
            ("numerical.matrices.integrator",),
        ),
        (
            "[numerical.mat",
            "[numerical]\nstiffness_n_per_m = 5\n[numerical.mat",
            ("give every stiffness in k_n_per_m",),
        ),
    ],
)
def test_a_fault_is_named_with_place_value_and_what_is_allowed(
    old: str, new: str, words: tuple[str, ...]
) -> None:
    message = refused(old, new)
    assert "numerical" in message
    for word in words:
        assert word in message


def test_a_structure_that_nothing_holds_is_refused() -> None:
    message = refused("[[4e6,", "[[-4e6,")
    assert "nothing restrains the structure against the motion [" in message
    assert "k_n_per_m" in message


def test_damping_that_feeds_a_mode_is_refused() -> None:
    message = refused('damping_ratios = ["5 %"]', "c_n_s_per_m = [-100, 0, 0]")
    assert "damping ratio of -" in message
    assert "must be at least 0" in message


def test_a_step_too_long_for_rk4_is_refused_and_taken_by_cr() -> None:
    stiff = TEST.replace("e6", "e10") + "[controller.rfc]\nwindow_samples = 5\n"
    with pytest.raises(InputError) as caught:
        derived(stiff.replace("interface", 'integrator = "rk4"\ninterface'))
    message = str(caught.value)
    assert "the step is unstable: with rk4 at 1024 Hz the largest root" in message
    assert 'integrator = "cr"' in message
    assert derived(stiff).structure is not None


# --- modes and stability -------------------------------------------------------------------------


def joined() -> Structure:
    found = derived().structure
    assert found is not None
    return found


def test_modes_are_those_of_the_structure_with_its_specimen() -> None:
    k = np.array([[4e6, -2e6, 0], [-2e6, 4e6, -2e6], [0, -2e6, 2e6]])
    k[0, 0] += 1.19e6
    w2, phi = scipy.linalg.eigh(k, M)
    modes = joined().modes()
    np.testing.assert_allclose([m.frequency_hz for m in modes], np.sqrt(w2) / (2 * np.pi))
    np.testing.assert_allclose([m.damping_ratio for m in modes], 0.05, rtol=1e-9)
    for mode, shape in zip(modes, phi.T, strict=True):
        scaled = shape / shape[np.argmax(np.abs(shape))]
        np.testing.assert_allclose(mode.shape, scaled, atol=1e-9)
    assert derived().period_s == pytest.approx(2 * np.pi / np.sqrt(w2[0]))


def test_what_is_taken_out_of_a_whole_structure_comes_back_with_the_specimen() -> None:
    text = TEST + "specimen = { mass_kg = 30, damping_n_s_per_m = 100 }\n"
    found = derived(text).structure
    assert found is not None
    m, _, k = found.joined()
    np.testing.assert_allclose(m, M)
    np.testing.assert_allclose(k, [[4e6, -2e6, 0], [-2e6, 4e6, -2e6], [0, -2e6, 2e6]])
    assert found.part.load_kg == (1000.0, 1000.0, 1000.0)
    assert found.part.mass_kg[0][0] == 970.0


def test_the_critical_delay_of_one_degree_of_freedom_is_the_known_one() -> None:
    m, c, k, k_e = 4220.0, 2121.0, 1e5, 666400.0
    old = margins.OneDegree(core.MotionConfig("cr", m, c, k, k_e))
    part = core.DenseConfig("cr", ((m,),), ((c,),), ((k,),), (m,), k_e_n_per_m=k_e)
    new = numerical_margins.ManyDegrees(Structure(("1",), part))
    for lead in (None, margins.Lead(10.0), margins.Lead(8.0, 32.0)):
        expected = margins.critical_delay(old, lead)
        assert margins.critical_delay(new, lead) == pytest.approx(expected, rel=1e-6)
    lead = margins.Lead(1.0)
    expected_most = margins.largest_followed_delay(old, lead, 60)
    assert margins.largest_followed_delay(new, lead, 60) == expected_most


@pytest.mark.long
@pytest.mark.parametrize("force_delay", [0, 1])
def test_a_delay_beyond_the_critical_one_grows_and_one_below_does_not(force_delay: int) -> None:
    part = frame("rk4", taken_out=True, force_delay=force_delay)
    structure = numerical_margins.ManyDegrees(Structure(("1", "2", "3"), part))
    critical = margins.critical_delay(structure)
    assert structure.is_stable(int(np.floor(critical)))
    assert not structure.is_stable(int(np.ceil(critical)))
    for delay, grows in ((int(critical * 0.8), False), (int(critical * 1.25), True)):
        one = core.Controller(
            core.ControllerConfig(
                law=core.LawConfig(),
                rfc=core.RfcConfig(k_e_n_per_m=part.k_e_n_per_m, enabled=False),
                motion=core.MotionConfig("cr", mass_kg=1.0, period_s=part.period_s),
                lead_enabled=False,
                period_s=part.period_s,
                numerical=part,
            )
        )
        x = np.zeros(6 * 4096)
        for n in range(x.size - 1):
            past = x[n - delay] if n >= delay else 0.0
            ag = 1.0 if n < 40 else 0.0
            x[n + 1] = one.step(x[n], part.k_e_n_per_m * past, ag).x_cmd_next_m
        early, late = np.abs(x[2000:6096]).max(), np.abs(x[-4096:]).max()
        assert (late > early) == grows


# --- the reference -------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", ["cr", "rk4"])
def test_reference_is_the_whole_structure_solved_by_scipy(integrator: str) -> None:
    found = Structure(("1", "2", "3"), frame(integrator, taken_out=True))
    t = np.arange(2 * 4096) / 4096.0

    def ground(at: Any) -> Any:
        return 2.0 * np.sin(2 * np.pi * 3.0 * at) * np.exp(-at)

    model = [
        core.element("stiffness", k_n_per_m=1.19e6),
        core.element("viscous", c_n_s_per_m=114.2),
        core.element("inertia", m_kg=29.13),
    ]
    # A held excitation is half a sample late: given that much earlier.
    ahead = 0.5 / 4096.0 if integrator == "rk4" else 0.0
    x, v, force = found.reference(model, ground(t + ahead))

    def slope(at: float, s: Floats) -> Floats:
        load = -M.sum(axis=1) * ground(at)
        return np.concatenate([s[3:], np.linalg.solve(M, load - C @ s[3:] - K @ s[:3])])

    exact = scipy.integrate.solve_ivp(
        slope, (0.0, 2.0), np.zeros(6), t_eval=t, rtol=1e-9, atol=1e-12
    )
    peak = np.abs(exact.y[0]).max()
    np.testing.assert_allclose(x, exact.y[0], rtol=0, atol=2e-3 * peak)
    np.testing.assert_allclose(v, exact.y[3], rtol=0, atol=1e-2 * np.abs(exact.y[3]).max())
    np.testing.assert_allclose(force, 1.19e6 * x, rtol=1e-12)


def test_reference_with_a_yielding_specimen_is_the_same_by_both_integrators() -> None:
    bouc_wen = core.element(
        "hysteresis", k_n_per_m=1.19e6, post_yield_ratio=0.1, a=1.0, b=500.0, c=500.0, eta=1.0
    )
    t = np.arange(3 * 4096) / 4096.0
    ag = 6.0 * np.sin(2 * np.pi * 3.0 * t)
    (x_cr, _, f), (x_rk4, _, _) = (
        Structure(("1", "2", "3"), frame(name, taken_out=True)).reference([bouc_wen], ag)
        for name in ("cr", "rk4")
    )
    assert np.abs(f).max() < 0.8 * 1.19e6 * np.abs(x_cr).max()  # it yields
    np.testing.assert_allclose(x_rk4, x_cr, rtol=0, atol=1e-2 * np.abs(x_cr).max())


# --- whole tests ---------------------------------------------------------------------------------


def run(text: str, rig: str = RIG) -> tuple[experiment.Setup, Any]:
    setup = experiment.prepare(config.parse_test(text), config.parse_rig(rig))
    return setup, virtual_time.run(setup)


@pytest.mark.parametrize("integrator", ["cr", "rk4"])
def test_a_frame_on_a_late_rig_follows_its_reference(integrator: str) -> None:
    text = TEST.replace("interface", f'integrator = "{integrator}"\ninterface')
    setup, rec = run(text + '[controller]\ntype = "alpha-beta"\n')
    figures = summary.summarize(rec)
    assert figures.response_nrmse is not None
    # RK4 holds the force: half a sample of k_e tau, -k_e h / 2, acts on a frame of 5 %.
    assert figures.response_nrmse < (0.005 if integrator == "cr" else 0.05)
    assert figures.setup.period_s == pytest.approx(setup.derived.period_s)
    assert figures.setup.damping_ratio == pytest.approx(0.05)
    assert figures.setup.critical_delay_samples is not None


@pytest.mark.long
def test_a_recording_of_a_frame_replays_bit_for_bit(rthyb: Rthyb, tmp_path: Path) -> None:
    text = TEST.replace("[ground", "free_vibration_s = 1\n[ground").replace(
        "factor = 0.4", "factor = 0.4\nduration_s = 4"
    )
    (tmp_path / "t.toml").write_text(text)
    (tmp_path / "r.toml").write_text(RIG)
    answer = rthyb(
        "run", tmp_path / "t.toml", "--rig", tmp_path / "r.toml", "--out", tmp_path / "run"
    )
    assert answer.code == 0, answer.err
    recording = next(tmp_path.glob("**/recording.h5"))
    again = rthyb("replay", recording)
    assert "identical" in again.out


def test_check_shows_frequency_period_and_damping_of_every_mode(rthyb: Rthyb) -> None:
    answer = rthyb("check", EXAMPLE)
    assert answer.code == 0, answer.err
    assert "Mode 1 of 3" in answer.out
    assert "3.612 Hz (0.277 s), damping 5.00 %" in answer.out
    assert "38.09 Hz" in answer.out
