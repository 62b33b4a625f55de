"""Free decays beside a naive model, and second recordings that begin with a past."""

from __future__ import annotations

import numpy as np
import pytest

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import body
from rthyb_rt.diagnose import effects, engine
from rthyb_rt.diagnose.case import Case, Model
from rthyb_rt.diagnose.effects.base import Trial
from rthyb_rt.diagnose.predict import Augmented, nrmse, predict
from rthyb_rt.diagnose.select import Member

FS_HZ, MASS, K, C = 200.0, 8.0, 2000.0, 2.0
CUBIC = core.element("cubic", k3_n_per_m3=-2e5)
DRY = core.element("coulomb", fc_n=0.25, width_m_per_s=1e-4)
DRAG = core.element("quad_damping", c2_n_s2_per_m2=12.0)


@pytest.mark.long
@pytest.mark.parametrize(
    ("missing", "names"),
    [
        pytest.param((), [], id="nothing"),
        pytest.param((DRY,), ["coulomb"], id="coulomb"),
        pytest.param((CUBIC, DRY), ["coulomb", "cubic"], id="coulomb+cubic"),
        pytest.param((CUBIC, DRAG), ["cubic", "quad_damping"], id="cubic+quad_damping"),
    ],
)
def test_spring_and_damping_of_a_free_decay_are_named_beside_a_naive_model(
    missing: tuple[core.ElementConfig, ...], names: list[str]
) -> None:
    n = int(16.0 * FS_HZ)
    own = [core.element("stiffness", k_n_per_m=K), core.element("viscous", c_n_s_per_m=C)]
    x = body(MASS, [*own, *missing], np.zeros(n), FS_HZ, (0.05, 0.0), substeps=40).x
    noise = 2e-5
    channels = {"x_meas": x + noise * np.random.default_rng(1).standard_normal(n),
                "f_in": np.zeros(n)}  # fmt: skip
    model = Model("forced", FS_HZ, 0.9 * K, 1.2 * C, MASS, x_std=noise)
    d = engine.diagnose(Case("swing", model, np.arange(n) / FS_HZ, channels, np.ones(n, bool)))

    assert sorted(d.effects) == names
    assert d.verdict == ("explained" if names else "none")


def test_a_second_recording_begins_where_its_first_rows_of_force_say() -> None:
    """A friction slider that was pushed before is off by all of its friction until it slips."""
    t = np.arange(2000) / 100.0
    x = 4e-4 * np.sin(2.0 * np.pi * 0.5 * t) * np.linspace(0.3, 1.0, t.size)
    model = Model("drive", 100.0, 1e6)
    slider = Member(effects.catalogue()["hysteresis"], Trial((1e-3,), "bw1"))
    made = Augmented(model, model, (slider,), (np.array([1.0]),), None, (5e-3, 0.1, 1e4))
    past = np.concatenate((np.linspace(0.0, 3e-3, 500), np.linspace(3e-3, 0.0, 500)))
    loop = core.element("hysteresis", k_n_per_m=1e6, post_yield_ratio=0.0, a=1.0, b=500.0,
                        c=500.0, eta=1.0)  # fmt: skip
    truth = 1e6 * x + core.Element(loop).run(np.concatenate((past, x)))[past.size :]
    head = np.where(t < 2.0, truth, np.nan)
    every = np.ones(t.size, dtype=np.bool_)

    def error(f_meas: np.ndarray) -> float:
        case = Case("second", model, t, {"x_meas": x, "f_meas": f_meas}, every)
        return nrmse(predict(made, case).f, truth)

    assert error(head) < 0.05 < 0.5 < error(np.full(t.size, np.nan))
