"""A set of effects cannot fit worse than a part of it."""

from __future__ import annotations

from types import SimpleNamespace

import diagnose_cases as cases
import numpy as np

from rthyb_rt import core
from rthyb_rt.diagnose import effects, engine, force, proposals, reading
from rthyb_rt.diagnose.dictionary import Dictionary
from rthyb_rt.diagnose.effects.base import Trial
from rthyb_rt.diagnose.fitter import LEADING, SetFitter
from rthyb_rt.diagnose.problem import Member, price
from rthyb_rt.diagnose.refinement import solve


def yielding(x: np.ndarray, xy: float) -> np.ndarray:
    """Return the elastoplastic part of a displacement, (n,), m."""
    out, held = np.zeros(x.size), 0.0
    for i, dx in enumerate(np.diff(x, prepend=0.0)):
        held = float(np.clip(held + dx, -xy, xy))
        out[i] = held
    return out


def test_every_set_fits_at_least_as_well_as_the_best_sets_within_it(tmp_path, monkeypatch):
    """Yielding behind a late load cell: with a mass as well, the search once ended in another
    minimum, worse than yielding alone."""
    columns = cases.channels()
    x, v, a = cases.moved(columns["x_cmd"])
    spring = 0.9 * x + 0.1 * yielding(x, 1.3e-3)
    force_n = cases.K * spring + cases.C * v + cases.M * a
    late = np.interp(columns["t"] - 4e-3, columns["t"], force_n)
    columns["f_meas"] = late + cases.F_STD * np.random.default_rng(2).standard_normal(x.size)
    recording, toml = cases.write(tmp_path, columns)
    decided, decide = [], force._decide

    def watched(problem, fitter, *more):
        decided.append(fitter)
        return decide(problem, fitter, *more)

    monkeypatch.setattr(force, "_decide", watched)
    d = engine.diagnose(reading.read_case(recording, reading.read_model(toml)))
    assert d.effects == ["hysteresis", "time_skew"]
    compared = 0
    for fitter in decided:
        fits = list(fitter.by_names.values())
        for part in sorted(fits, key=fitter.score)[:LEADING]:
            beside = [f for f in fits if set(part.names) < set(f.names)]
            more = [f for f in beside if len(f.members) == len(part.members) + 1]
            compared += len(more)
            for f in more:
                # By misfit and price: a form with more parameters may be worse beside the effect.
                (added,) = (m for m in f.members if m.name not in part.names)
                count = added.effect.settings(fitter.problem.ctx, added.trial)[1]
                own = price(fitter.problem, added.effect, count)
                assert fitter.score(f) < fitter.score(part) + own + 0.5, (part.names, f.names)
    assert compared


def test_a_law_that_stood_for_a_missing_one_is_replaced_once_the_others_are_there(
    tmp_path, monkeypatch
):
    """A mass, relaxation and hum. Before the hum was found, a second mode at its frequency fitted
    better than the mass; without either, relaxation has a sign that no law permits."""

    def extra(t, x, v, a):
        relaxing = core.element("maxwell", km_n_per_m=3e4, tau_s=0.2)
        relaxed = core.CoreElement(relaxing).run(x, v, a, t[1] - t[0])
        return 600.0 * a + relaxed + 50.0 * np.sin(2.0 * np.pi * 16.7 * t)

    recording, toml = cases.write(tmp_path, cases.channels(extra))
    decided, decide = [], force._decide

    def watched(problem, *more):
        decided.append(problem)
        return decide(problem, *more)

    monkeypatch.setattr(force, "_decide", watched)
    d = engine.diagnose(reading.read_case(recording, reading.read_model(toml)))
    assert d.effects == ["hum", "inertia", "maxwell"]
    problem, known = decided[-1], effects.catalogue()
    shapes = {"second_mode": (16.0, 0.1), "maxwell": (0.2,), "hum": (16.7,)}
    members = [Member(known[n], Trial(theta)) for n, theta in shapes.items()]
    assert solve(problem, members[1:], problem.blocks(members[1:])) is None
    fitter = SetFitter(problem)
    fitter.fit(members)
    proposals._replaced(Dictionary(problem), fitter)
    assert min(fitter.by_names.values(), key=fitter.score).names == ("hum", "inertia", "maxwell")


def test_a_joint_law_and_single_laws_with_its_names_are_two_sets(monkeypatch):
    """The single ones fit better and are refused for their form: the joint law must not go too."""
    monkeypatch.setattr(SetFitter, "score", lambda self, fit: fit.chi2)
    fitter = SetFitter.__new__(SetFitter)
    fitter.by_names = {}

    def kept(chi2: float, *complete: bool):
        members = [SimpleNamespace(effect=SimpleNamespace(complete=c)) for c in complete]
        fit = SimpleNamespace(names=("hysteresis", "pinching"), members=members, chi2=chi2)
        fitter.keep(fit)
        return fit

    joint, single = kept(12.0, True), kept(10.0, False, False)
    kept(11.0, False, False)
    kept(13.0, True)
    assert fitter.ranked == [single, joint]
