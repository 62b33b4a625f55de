"""A load cell whose steps are far above its noise: it is exact where it changes its reading."""

from __future__ import annotations

import diagnose_cases as cases
import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from diagnose_answers import diagnosed, holds
from scipy.optimize import minimize_scalar
from scipy.stats import norm

from rthyb_rt.diagnose import coarse, result

STEP_N, NOISE_N = 400.0, 15.0
T = np.arange(6000) / 1000.0


def readings(force: np.ndarray, seed: int, noise_n: float = NOISE_N) -> np.ndarray:
    noise = noise_n * np.random.default_rng(seed).standard_normal(force.size)
    return STEP_N * np.round((force + noise) / STEP_N)


def at_changes(force: np.ndarray, seed: int) -> coarse.Exact:
    rows = np.ones(force.size, dtype=np.bool_)
    return coarse.changes(readings(force, seed), rows, STEP_N, NOISE_N, force)


# ---- where it changes ---------------------------------------------------------------------------


@pytest.mark.parametrize("rate_n_per_row", [0.3, 3.0, 12.0, 40.0, 150.0])
def test_a_ramp_passes_half_way_between_two_readings(rate_n_per_row: float) -> None:
    force = 37.0 + rate_n_per_row * np.arange(T.size)
    exact = at_changes(force, 1)
    rows = np.flatnonzero(exact.rows)
    passed = (force[rows] + force[rows + 1]) / 2.0
    # Each level once, in the order in which the ramp passes it, however the noise changes there.
    assert np.all(np.diff(exact.force[rows]) == STEP_N)
    assert rows.size == pytest.approx(force[-1] / STEP_N, abs=1.5)
    errors = (passed - exact.force[rows]) * exact.weight[rows]
    assert abs(errors.mean()) < 4.0 / np.sqrt(rows.size)
    assert np.sqrt(np.mean(errors**2)) < 1.3


def test_what_turns_within_the_noise_of_a_level_is_near_it_or_not_told() -> None:
    for seed in range(20):
        turning = 0.5 * STEP_N + 5.0 - 1e-4 * (np.arange(T.size) - 3000.0) ** 2
        assert np.count_nonzero(np.diff(readings(turning, seed))) > 4
        exact = at_changes(turning, seed)
        told = exact.rows & (exact.force == 0.5 * STEP_N)
        assert told.sum() <= 4
        assert np.all(np.abs(turning[told] - 0.5 * STEP_N) < 4.0 * NOISE_N)


def test_rows_without_a_reading_hide_where_it_changes() -> None:
    force = 3.0 * np.arange(T.size)
    read, rows = readings(force, 4, 0.0), np.ones(T.size, dtype=np.bool_)
    rows[int(np.flatnonzero(np.diff(read))[3])] = False
    exact = coarse.changes(read, rows, STEP_N, NOISE_N, force)
    assert exact.rows.sum() == np.count_nonzero(np.diff(read)) - 1


@pytest.mark.parametrize(
    ("rows_a_cycle", "least", "most"), [(500.0, 1.9, 2.1), (517.31, 12.0, 24.5)]
)
def test_a_sine_with_whole_rows_in_a_cycle_is_read_at_no_more_than_one_place(
    rows_a_cycle: float, least: float, most: float
) -> None:
    """Twelve cycles tell no more of the place between two rows than one; up and down are two."""
    force = 1500.0 * np.sin(2.0 * np.pi * (np.arange(T.size) + 0.3) / rows_a_cycle)
    rows = np.ones(T.size, dtype=np.bool_)
    exact = coarse.changes(readings(force, 5, 0.0), rows, STEP_N, 1e-3, force)
    one = np.flatnonzero(exact.rows & (exact.force == 0.5 * STEP_N))
    rate = np.abs(force[one + 1] - force[one])
    assert least < np.sum((rate * exact.weight[one]) ** 2) / 12.0 < most


# ---- readings as intervals ----------------------------------------------------------------------


@hypothesis.given(st.floats(-40.0, 8.0))
def test_the_repulsion_from_the_end_of_a_step_is_the_ratio_of_mills(u: float) -> None:
    exact = np.exp(norm.logpdf(u) - norm.logcdf(u))
    assert coarse._mills(u) == pytest.approx(exact, rel=2e-4, abs=1e-15)


def test_deviance_is_that_of_intervals() -> None:
    random = np.random.default_rng(6)
    force = 900.0 * np.sin(4.0 * T) + 300.0 * random.standard_normal()
    read, rows = readings(force, 7), random.random(T.size) > 0.1
    for off in (0.0, 30.0, -60.0, 150.0):
        ends = ((read + side * STEP_N / 2.0 - force - off)[rows] / NOISE_N for side in (1.0, -1.0))
        upper, lower = ends
        # The logarithm of a difference of integrals, on the side on which both are small.
        above = np.where(lower > 0.0, norm.logsf(lower), norm.logcdf(upper))
        below = np.where(lower > 0.0, norm.logsf(upper), norm.logcdf(lower))
        exact = -2.0 * np.sum(above + np.log1p(-np.exp(below - above)))
        found = coarse.deviance(force + off, read, rows, STEP_N, NOISE_N)
        assert found == pytest.approx(exact, rel=1e-3, abs=1e-3)


def test_its_steps_end_where_the_likelihood_of_the_intervals_is_largest() -> None:
    v = np.cos(5.0 * T) * np.sin(1.3 * T)
    force = 1500.0 * np.sin(3.1 * T) + 170.0 * np.sign(v)
    read, rows = readings(force, 8), np.ones(T.size, dtype=np.bool_)

    def by_model(friction_n: float) -> np.ndarray:
        return 1500.0 * np.sin(3.1 * T) + friction_n * np.sign(v)

    friction_n = 120.0
    for _ in range(12):
        exact = coarse.intervals(read, rows, STEP_N, NOISE_N, by_model(friction_n))
        column = exact.seen(np.sign(v))[exact.rows]
        aim = exact.seen(exact.force - by_model(0.0))[exact.rows]
        friction_n = float(column @ aim / (column @ column))
    best = minimize_scalar(
        lambda f: coarse.deviance(by_model(f), read, rows, STEP_N, NOISE_N),
        bounds=(100.0, 250.0), method="bounded",
    )  # fmt: skip
    assert friction_n == pytest.approx(best.x, abs=0.5)
    assert friction_n == pytest.approx(170.0, abs=5.0)


def test_a_force_that_stays_half_way_fits_the_changes_but_not_the_readings() -> None:
    step_n, force = 2000.0, 1500.0 * np.sin(3.1 * T)
    random, rows = np.random.default_rng(9), np.ones(T.size, dtype=np.bool_)
    read = step_n * np.round((force + NOISE_N * random.standard_normal(T.size)) / step_n)
    still = 0.5 * step_n * np.sign(force)
    exact = coarse.changes(read, rows, step_n, NOISE_N, force)
    assert np.all(still[exact.rows] == exact.force[exact.rows])
    right, wrong = (coarse.deviance(f, read, rows, step_n, NOISE_N) for f in (force, still))
    assert right < 0.1 * wrong


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
def test_a_force_beyond_all_bounds_is_improbable(value: float) -> None:
    read, rows = readings(1500.0 * np.sin(3.1 * T), 9), np.ones(T.size, dtype=np.bool_)
    force = np.full(T.size, value)
    with np.errstate(all="ignore"):
        assert coarse.deviance(force, read, rows, STEP_N, NOISE_N) > 1e6
        exact = coarse.intervals(read, rows, STEP_N, NOISE_N, force)
    assert np.isfinite(exact.seen(exact.force)).all()


# ---- answers ------------------------------------------------------------------------------------


def recorded(force_n: np.ndarray, u: np.ndarray, step_n: float) -> dict[str, np.ndarray]:
    x = cases.moved(u)[0]
    random = np.random.default_rng(10)
    noisy = force_n + cases.F_STD * random.standard_normal(u.size)
    return {
        "t": np.arange(u.size) / cases.FS,
        "x_cmd": u,
        "x_meas": x + cases.X_STD * random.standard_normal(u.size),
        "f_meas": step_n * np.round(noisy / step_n),
    }


def elastic(u: np.ndarray) -> np.ndarray:
    x, v, a = cases.moved(u)
    return np.asarray(cases.K * x + cases.C * v + cases.M * a)


@pytest.mark.parametrize("step_n", [300.0, 900.0])
def test_friction_of_a_fraction_of_a_step_is_found(tmp_path, step_n: float) -> None:
    u = cases.command(seconds=16.0)
    v = cases.moved(u)[1]
    d = diagnosed(tmp_path, recorded(elastic(u) + 160.0 * np.sign(v), u, step_n), cases.baseline())
    assert d.effects == ["coulomb", "quantisation"]
    assert holds(d, "coulomb", "Fc_N", 160.0)


@pytest.mark.parametrize("step_n", [300.0, 900.0, 2300.0])
def test_coarse_readings_of_a_right_model_lack_nothing_else(tmp_path, step_n: float) -> None:
    """Of the largest steps only three readings are left, which are no saturation."""
    u = cases.command(seconds=16.0)
    d = diagnosed(tmp_path, recorded(elastic(u), u, step_n), cases.baseline())
    assert d.effects == ["quantisation"]


@pytest.mark.parametrize("noise_n", [0.1, 1.0, 15.0])
def test_a_quiet_load_cell_is_read_at_every_change(noise_n: float) -> None:
    """Within its noise of an end of a step there would be hardly a row."""
    force = 1500.0 * np.sin(3.1 * T)
    read, rows = readings(force, 11, noise_n), np.ones(T.size, dtype=np.bool_)
    changed = coarse.changes(read, rows, STEP_N, noise_n, force).rows.sum()
    assert coarse.intervals(read, rows, STEP_N, noise_n, force).rows.sum() > 0.8 * changed


@pytest.mark.parametrize("noise_n", [15.0, 60.0])
def test_variance_of_a_row_of_intervals_is_the_stated_share(noise_n: float) -> None:
    force = 1500.0 * np.sin(0.31 * np.linspace(0.0, 60.0, 40_000))
    rows = np.ones(force.size, dtype=np.bool_)
    exact = coarse.intervals(readings(force, 12, noise_n), rows, STEP_N, noise_n, force)
    rest = exact.seen(exact.force - force)[exact.rows]
    assert np.mean(rest**2) == pytest.approx(coarse.SHARE, rel=0.1)


def test_energy_and_curves_are_those_of_all_readings(tmp_path) -> None:
    """Not of the rows in which the search evaluated them."""
    u = cases.command(seconds=16.0)
    x, v, _ = cases.moved(u)
    friction = 160.0 * np.sign(v)
    columns = recorded(elastic(u) + friction, u, 900.0)
    d = diagnosed(tmp_path, columns, cases.baseline())
    work = next(c for c in result.to_json(d)["candidates"] if c["name"] == "coulomb")["energy_J"]
    assert work == pytest.approx(friction @ np.diff(x, prepend=x[0]), rel=0.1)
    assert np.array_equal(d.context.force, columns["f_meas"])


def test_rows_before_a_yielding_spring_forgets_its_history_stay_out(tmp_path) -> None:
    u = cases.command("sine", 16.0)
    before = 5 * int(cases.FS)
    columns = {n: c[before:] for n, c in recorded(elastic(u), u, 600.0).items()}
    columns["t"] = columns["t"] - columns["t"][0]
    loop = "[specimen.bouc_wen]\nalpha = 0.9999\nxy = 4e-3\nn = 2.0\nbeta = 0.5\ngamma = 0.5\n"
    model = cases.baseline().replace("[actuator]", f"{loop}[actuator]")
    found = diagnosed(tmp_path, columns, model).estimate
    assert found.read is not None
    assert not found.read[: found.begins].any()
    assert not found.rows[: found.begins].any()
