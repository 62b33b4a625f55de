"""Contacts that are not sharp, loops as slack as they are, springs beside a loop that yields."""

from __future__ import annotations

import diagnose_cases as cases
import numpy as np
import pytest
from scipy import stats

from rthyb_rt import config, core
from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import augment, effects, engine, estimate, found_model, reading
from rthyb_rt.diagnose.effects import springs
from rthyb_rt.diagnose.effects.base import Context, Trial
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem

K = cases.K
XY = 2.5e-3
SPRING = 1.004 * K  # that the recordings have, whose place the loop takes
LOOP = f"\n[specimen.bouc_wen]\nalpha = 0.2\nxy = {XY}\nn = 2\n"


def loop(x: np.ndarray, depth: float | None = None) -> np.ndarray:
    """The force of a Bouc-Wen spring of n = 2, of slack slope if so asked, by fine steps, (n,)."""
    z, out = 0.0, np.zeros(x.size)
    for i in range(1, x.size):
        steps = 40
        part = (x[i] - x[i - 1]) / steps
        for _ in range(steps):
            rate = 1.0 - abs(z / XY) ** 2 * (0.5 + 0.5 * np.sign(part * z))
            if depth is not None:
                rate *= 1.0 - depth * np.exp(-((z / (0.5 * XY)) ** 2))
            z += part * rate
        out[i] = K * (0.2 * x[i] + 0.8 * z)
    return out


def diagnosed_from(folder, columns, model: str | None = None):
    recording, toml = cases.write(folder, columns, model)
    return engine.diagnose(reading.read_case(recording, reading.read_model(toml)))


def diagnosed(folder, extra, model: str | None = None):
    return diagnosed_from(folder, cases.channels(lambda t, x, v, a: extra(x)), model)


@pytest.mark.parametrize("width_m", [1e-6, 3e-4, 2e-3])
def test_contact_that_spreads_is_the_mean_over_its_clearances(width_m):
    x = np.linspace(-8e-3, 8e-3, 301)
    places = 3e-3 + width_m * (2.0 * (np.arange(20_000) + 0.5) / 20_000 - 1.0)
    mean = np.mean(np.maximum(x[:, None] - places, 0.0), axis=1)
    np.testing.assert_allclose(springs.met(x - 3e-3, width_m), mean, atol=2e-8)


@pytest.mark.parametrize("scale_m", [1e-5, 3e-4])
def test_contact_of_rough_surfaces_is_the_mean_over_its_clearances(scale_m):
    x = np.linspace(-8e-3, 8e-3, 301)
    places = stats.logistic(3e-3, scale_m).ppf((np.arange(20_000) + 0.5) / 20_000)
    mean = np.mean(np.maximum(x[:, None] - places, 0.0), axis=1)
    np.testing.assert_allclose(springs.met(x - 3e-3, scale_m, "rough"), mean, atol=2e-8)


# Eight springs in the place of a parabola of curvature 1 / (2 width), a fourth of it apart; and at
# the last of eight on rough surfaces, whose share is 1/16 to 15/16, the tail that is left.
SPREADS, ROUGH = 1.0 / 256.0, np.log(16.0 / 15.0)


@pytest.mark.parametrize(
    ("name", "trial", "beta", "off"),
    [
        ("stopper", Trial((4e-3, 8e-4), "spread"), 3e5, SPREADS),
        ("gap", Trial((1e-3, 4e-4), "spread"), 1.0, SPREADS),
        ("stopper", Trial((4e-3, 4e-4), "rough"), 3e5, ROUGH),
        ("gap", Trial((1e-3, 1e-4), "rough"), 1.0, ROUGH),
    ],
)
def test_contact_that_spreads_becomes_springs_of_a_rig_file(name, trial, beta, off, tmp_path):
    _, toml = cases.write(tmp_path, cases.channels())
    x, v, a = cases.moved(cases.command())
    t = np.arange(x.size) / cases.FS
    ctx = Context(reading.read_model(toml), ComputedMotion(x, v, a), t, K * x, {})
    effect = effects.catalogue()[name]
    fitted = beta * effect.columns(ctx, trial)[0]
    elements = effect.elements(ctx, trial, np.array([beta]))
    found = sum(core.CoreElement(one).run(x, v, a, 1.0 / cases.FS) for one in elements)
    slope = K if name == "gap" else beta
    np.testing.assert_allclose(found, fitted, atol=off * trial.theta[1] * slope)
    # Met at zero; at 1.05 mm by part of the even distribution, though by none of its eight springs.
    for width in (2e-3, 1.05e-3):
        wide = Trial((1e-3, width), trial.variant)
        assert effect.elements(ctx, wide, np.array([beta])) is None


@pytest.mark.long
def test_stop_on_surfaces_that_are_not_parallel_is_one_stop(tmp_path):
    """Beside it nothing: neither a cubic spring nor a loop stands in for its rounded corner."""
    d = diagnosed(
        tmp_path,
        lambda x: 4e5 * (springs.met(x - 4e-3, 1.2e-3) - springs.met(-x - 4e-3, 1.2e-3)),
    )
    assert (d.verdict, d.effects) == ("explained", ["stopper"])
    found = d.candidates[0]
    assert found.params["xs_m"] == pytest.approx(4e-3, rel=0.02)
    assert found.params["ks_N_m"] == pytest.approx(4e5, rel=0.02)
    assert "met over" in found.form


@pytest.mark.long
def test_no_spring_hardens_beside_a_stop_with_a_corner_of_a_form_of_its_own(tmp_path):
    """A hyperbola, which neither of the two corners is; without them, it would be "unknown"."""

    def corner(depth):
        return 0.5 * (depth + np.hypot(depth, 1e-4))

    d = diagnosed(tmp_path, lambda x: 1e7 * (corner(x - 4e-3) - corner(-x - 4e-3)))
    assert (d.verdict, d.effects) == ("explained", ["stopper"])
    assert d.candidates[0].params["xs_m"] == pytest.approx(4e-3, rel=0.002)


@pytest.mark.long
def test_sharp_stop_is_not_said_to_spread(tmp_path):
    d = diagnosed(
        tmp_path, lambda x: 4e5 * (np.maximum(x - 4e-3, 0.0) - np.maximum(-x - 4e-3, 0.0))
    )
    assert (d.verdict, d.effects) == ("explained", ["stopper"])
    assert d.candidates[0].form == "both sides"


@pytest.mark.parametrize("depth", [pytest.param(0.3, marks=pytest.mark.long), 0.7])
def test_slope_of_a_loop_is_as_slack_as_it_is(depth, tmp_path):
    """What it loses does not go with the depth: at 0.7 a shape of 0.3 would leave a third law."""
    d = diagnosed(tmp_path, lambda x: loop(x, depth) - SPRING * x, cases.baseline() + LOOP)
    assert (d.verdict, d.effects) == ("explained", ["pinching"])
    assert d.candidates[0].params["depth"] == pytest.approx(depth, rel=0.03)
    assert d.candidates[0].params["width_ratio"] == pytest.approx(0.5, rel=0.03)


@pytest.mark.long
def test_spring_beside_a_loop_does_not_yield_with_it(tmp_path):
    """P-delta: eight per cent of the elastic stiffness less, at every displacement."""
    d = diagnosed(tmp_path, lambda x: loop(x) - (SPRING + 0.08 * K) * x, cases.baseline() + LOOP)
    assert (d.verdict, d.effects) == ("explained", ["stiffness"])
    assert d.candidates[0].params["dk_ratio"] == pytest.approx(-0.08, rel=0.05)
    assert "beside" in d.candidates[0].form


def test_a_spring_beside_a_loop_is_no_tolerance_of_the_stated_one(tmp_path):
    """What it explains is not measured against a tolerance, but against what the others explain."""
    _, toml = cases.write(tmp_path, cases.channels(), cases.baseline() + LOOP)
    model = reading.read_model(toml)
    motion = ComputedMotion(*cases.moved(cases.command()))
    t = np.arange(motion.x.size) / cases.FS
    ctx = Context(model, motion, t, K * motion.x, {})
    law = effects.catalogue()["stiffness"]
    assert {trial.variant: law.restates(trial) for trial in law.trials(ctx)} == {
        "": True, "beside": False
    }  # fmt: skip


def sliders(x: np.ndarray, yields_m: np.ndarray, k_n_per_m: float) -> np.ndarray:
    """The force of parallel springs that slip at these displacements, (n,), N."""
    slip, force = np.zeros(yields_m.size), np.empty_like(x)
    for i, now in enumerate(x):
        slip = np.clip(slip, now - yields_m, now + yields_m)
        force[i] = k_n_per_m * float(np.mean(now - slip))
    return force


def test_a_peak_of_friction_that_is_no_gaussian_is_named_with_its_exponent(tmp_path):
    """Bo and Pavelescu measured 0.5 to 1; a Gaussian would need a dashpot beside it."""

    def law(t, x, v, a):
        return np.sign(v) * (250.0 + 350.0 * np.exp(-((np.abs(v) / 0.02) ** 0.7)))

    recording, toml = cases.write(tmp_path, cases.channels(law))
    d = engine.diagnose(reading.read_case(recording, reading.read_model(toml)))
    assert (d.verdict, d.effects) == ("explained", ["stribeck"])
    found = d.candidates[0]
    assert found.params["Fs_N"] == pytest.approx(600.0, rel=0.1)
    assert found.params["Fc_N"] == pytest.approx(250.0, rel=0.1)
    assert "|v/vs|^0.69" in found.form or "|v/vs|^0.7" in found.form


def test_a_stop_that_loses_energy_needs_neither_dashpot_nor_time_skew(tmp_path):
    def law(t, x, v, a):
        deep = np.maximum(np.abs(x) - 5e-3, 0.0)
        inwards = np.maximum(1.0 + 4.0 * v * np.sign(x), 0.0)
        return 5e5 * deep * inwards * np.sign(x)

    recording, toml = cases.write(tmp_path, cases.channels(law))
    d = engine.diagnose(reading.read_case(recording, reading.read_model(toml)))
    assert (d.verdict, d.effects) == ("explained", ["stopper"])
    found = d.candidates[0]
    assert found.params["ks_N_m"] == pytest.approx(5e5, rel=0.02)
    assert found.params["xs_m"] == pytest.approx(5e-3, rel=0.01)
    assert "velocity inwards" in found.form


def test_a_continuum_of_sliders_is_one_friction_with_bristles(tmp_path):
    """Exponential strengths, as fine as a contact has them: no second law for what is left."""
    shares = (np.arange(2000) + 0.5) / 2000
    d = diagnosed(tmp_path, lambda x: sliders(x, -0.6e-3 * np.log1p(-shares), 2.5e5))
    assert (d.verdict, d.effects) == ("explained", ["lugre"])
    assert d.candidates[0].params["Fc_N"] == pytest.approx(150.0, rel=0.05)


def test_yields_that_are_mostly_alike_are_one_law_without_an_offset_beside_it(tmp_path):
    u = 2.0 * (np.arange(2000) + 0.5) / 2000 - 1.0
    yields = 3e-3 * (1.0 + 0.6 * np.sign(u) * (1.0 - np.sqrt(1.0 - np.abs(u))))
    d = diagnosed(tmp_path, lambda x: 0.25 * (sliders(x, yields, K) - K * x))
    assert (d.verdict, d.effects) == ("explained", ["hysteresis"])
    found = d.candidates[0]
    assert found.params["alpha"] == pytest.approx(0.75, rel=0.03)
    assert found.params["xy_m"] == pytest.approx(3e-3, rel=0.05)
    assert "triangle" in found.form


def lossy_stop(fs_hz: float, loss_s_per_m: float) -> dict[str, np.ndarray]:
    """Six growing cycles at a twentieth of a hertz against a stop at 4 mm that loses energy."""
    rng = np.random.default_rng(2)
    t = np.arange(int(120 * fs_hz)) / fs_hz
    x = 8e-3 * np.minimum(0.4 + t / 120.0, 1.0) * np.sin(2.0 * np.pi * 0.05 * t)
    v = np.gradient(x, t)
    deep = np.sign(x) * np.maximum(np.abs(x) - 4e-3, 0.0)
    force = K * x + 3.0 * K * deep * np.maximum(1.0 + loss_s_per_m * v * np.sign(x), 0.0)
    noise = rng.standard_normal((2, t.size))
    return {"t": t, "x_meas": x + 1e-7 * noise[0], "f_meas": force + 5.0 * noise[1]}


def slow_model(fs_hz: float, c: float) -> str:
    lines = [
        'schema = "rthyb-baseline/1"', 'family = "drive"', f"fs_hz = {fs_hz}",
        "[specimen]", f"k = {K}", f"c = {c}", "moving_mass = 0", "k_tol = 0.01",
        "[noise]", "x_std = 1e-7", "f_std = 5",
    ]  # fmt: skip
    return "\n".join(lines)


@pytest.mark.long
def test_a_stop_that_loses_energy_at_millimetres_per_second_is_found_and_runs(tmp_path):
    """The slower the contact, the larger the loss for the same rebound: here 1200 s/m."""
    columns = lossy_stop(32.0, 1200.0)
    d = diagnosed_from(tmp_path, columns, slow_model(32.0, 1.0))
    assert (d.verdict, d.effects) == ("explained", ["stopper"])
    mended = tmp_path / "augmented.toml"
    mended.write_text(augment.rig_toml(found_model.augmented(d))[0], encoding="utf-8")
    (stop,) = (e for e in config.load_rig(mended).specimen if e.element == "stopper")
    assert stop.loss_s_per_m == pytest.approx(1200.0, rel=0.05)


def test_where_time_is_nominal_no_stop_has_a_loss_for_each_metre_per_second(tmp_path):
    """A table of a quasi-static test: rows are numbered, and their spacing is no duration."""
    columns = lossy_stop(5.0, 300.0)
    d = diagnosed_from(tmp_path, columns, slow_model(5.0, 0.0))
    assert all("velocity" not in one.form for one in d.candidates)


@pytest.mark.parametrize(("more", "possible"), [(0.0, True), (0.5, True), (0.97, False)])
def test_a_gap_in_a_spring_that_acts_within_it_nevertheless_is_no_gap(more, possible, tmp_path):
    """A stiffness too small by as much as the gap takes away: then the rest is a stop's."""
    recording, toml = cases.write(tmp_path, cases.channels())
    x, v, a = cases.moved(cases.command())
    t = np.arange(x.size) / cases.FS
    case = reading.read_case(recording, reading.read_model(toml))
    ctx = Context(case.model, ComputedMotion(x, v, a), t, K * x, {})
    found = estimate.Estimate(ctx.motion, ctx.force, case.rows, lambda y: y, 1.0, True)
    problem = ResidualProblem(case, ctx, found, effects.catalogue().values())
    known = effects.catalogue()
    members = (
        Member(known["gap"], Trial((1e-3,), "deadband")), Member(known["stiffness"], Trial()),
    )  # fmt: skip
    betas = (np.array([1.0]), np.array([more]))
    fit = Fit(members, betas, 0.0, 3, np.zeros(len(problem.nuisances)))
    assert problem.sensible(fit) == possible
