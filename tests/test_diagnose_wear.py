"""Wear that the diagnosis found, and the elements of a rig file that it becomes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rthyb_rt import config, core
from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import effects
from rthyb_rt.diagnose.augment import rig_toml
from rthyb_rt.diagnose.case import Model, ModelBoucWen
from rthyb_rt.diagnose.effects.base import Context, Trial
from rthyb_rt.diagnose.predict import Augmented
from rthyb_rt.diagnose.problem import Member
from rthyb_rt.lab.experiment import specimen_elements

N, K = 4096, 4e5
T = np.arange(N) / core.FS_HZ
LOOP = ModelBoucWen(0.15, 3e-3, 2.0, 0.6, 0.4)
ELASTIC = Model("drive", core.FS_HZ, K, k_tol=0.02, c_tol=0.1)
YIELDING = replace(ELASTIC, bouc_wen=LOOP)
RANGES = (1e-2, 0.1, 3e3)
SIZE = {"loop": 0.05, "all": 0.05, "loop, work": 20.0, "loop, amplitude": 8e-3}
MODELS = pytest.mark.parametrize(
    ("model", "variant"),
    [(ELASTIC, v) for v in SIZE if v != "all"] + [(YIELDING, v) for v in SIZE],
    ids=lambda value: value if isinstance(value, str) else "loop" if value.bouc_wen else "spring",
)


def cycles(begin_m: float) -> ComputedMotion:
    """Return growing cycles about zero after a beginning at a displacement."""
    swing = 6e-3 * np.minimum(T / 3.0, 1.0) * np.sin(2.0 * np.pi * 1.5 * T)
    x = begin_m * np.exp(-T / 0.3) + swing
    v = np.gradient(x, T)
    return ComputedMotion(x, v, np.gradient(v, T))


def force(elements: list[core.ElementConfig], motion: ComputedMotion) -> np.ndarray:
    """Return the sum of the elements' forces along a motion."""
    return np.sum([core.CoreElement(e).run(motion.x, motion.v, motion.a) for e in elements], axis=0)


@MODELS
@pytest.mark.parametrize("begin_m", [0.0, -1e-3, 9e-3], ids="{:g} m".format)
def test_a_test_that_begins_displaced_wears_in_the_rig_file_as_in_the_diagnosis(
    model, variant, begin_m
):
    motion, loss = cycles(begin_m), np.array([0.4])
    ctx = Context(model, motion, T, np.zeros(N), {}, RANGES)
    effect, trial = effects.catalogue()["degradation"], Trial((SIZE[variant],), variant)
    fitted = ctx.spring + loss[0] * effect.columns(ctx, trial)[0]
    elements = effect.elements(ctx, trial, loss)
    error = force(elements, motion) - fitted
    # A spring in the form of a loop that yields at 1 km; the work within a row is a mean.
    assert np.max(np.abs(error)) < 1e-4 * np.max(np.abs(fitted))


@MODELS
def test_the_augmented_rig_has_the_force_of_the_law_that_was_fitted(model, variant):
    """Along with a stiffness that was found within its tolerance."""
    member = Member(effects.catalogue()["degradation"], Trial((SIZE[variant],), variant))
    found = replace(model, k=1.04 * model.k, c=500.0)
    augmented = Augmented(found, model, (member,), (np.array([0.35]),), None, RANGES)
    text, lost = rig_toml(augmented)
    assert lost == []
    motion = cycles(2e-3)
    wanted = augmented.force(motion, T, {})
    rig = force(specimen_elements(config.parse_rig(text)), motion)
    assert np.max(np.abs(rig - wanted)) < 1e-4 * np.max(np.abs(wanted))
    other = Augmented(found, model, (), (), None, RANGES).force(motion, T, {})
    assert np.max(np.abs(other - wanted)) > 0.05 * np.max(np.abs(wanted))


def test_two_laws_that_replace_one_spring_are_not_both_in_a_rig_file():
    names = (("pinching", Trial((2e-3,), "x")), ("degradation", Trial((0.3,), "loop")))
    members = tuple(Member(effects.catalogue()[name], trial) for name, trial in names)
    betas = (np.array([0.3]), np.array([0.2]))
    text, lost = rig_toml(Augmented(YIELDING, YIELDING, members, betas, None, RANGES))
    assert lost == ["degradation"]
    assert [e.element for e in config.parse_rig(text).specimen] == ["pinching"]
    assert "# degradation: a rig file cannot represent it" in text


@pytest.mark.parametrize("found", [0.7, 0.0, -0.2])
@MODELS
def test_more_loss_than_the_stiffness_found_is_said_to_be_in_no_rig_file(model, variant, found):
    """Cut to all of it, the rig would have none of the force that was fitted."""
    member = Member(effects.catalogue()["degradation"], Trial((SIZE[variant],), variant))
    soft = replace(ELASTIC, k=found * ELASTIC.k)
    augmented = Augmented(soft, model, (member,), (np.array([0.95]),), None, RANGES)
    text, lost = rig_toml(augmented)
    assert lost == ["degradation"]
    assert all(e.element != "degradation" for e in config.parse_rig(text).specimen)
