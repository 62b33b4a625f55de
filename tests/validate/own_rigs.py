"""Effects hidden in the rigs that the project ships, recorded by its own hybrid tests.

A case is a shipped rig with one or more effects put into its specimen (or its table), a test of
Section 5 on it in virtual time, and the rig as shipped for a model. The command line is asked what
is missing; right is the set that was hidden, alone or among the sets said to fit alike, and a loop
that closes with it.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from prove import scoring

from rthyb_rt import config
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.record import recording

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / "hw" / "rigs" / "shaking-table-portal-frame.toml"
TEST = ROOT / "examples" / "section5-T0.5.toml"
CLOSED = 0.03
"""NRMSE of the closed loop's displacement from which the loop counts as closed."""

LAGS: dict[str, dict[str, Any]] = {
    "second-order": {"kind": "second-order", "natural_frequency_hz": 24.0, "damping_ratio": 0.75,
                     "delay_s": 0.006},
    "first-order": {"kind": "first-order", "roll_off_hz": 9.6},
    "pure-delay": {"kind": "pure-delay", "delay_samples": 17},
}  # fmt: skip
"""Actuators of the other rigs; each as late at 2 Hz as the shipped table, 17 samples."""


PAIRS = (("coulomb", "viscous"), ("coulomb", "stiffness"), ("cubic", "coulomb"),
         ("quad_damping", "stiffness"))  # fmt: skip
CANCELLING: dict[tuple[str, ...], tuple[tuple[str, ...], ...]] = {
    ("cubic", "stiffness"): (),
    # A softer spring and a stop are a spring with a play.
    ("stiffness", "stopper"): (("gap",), ("gap", "stiffness")),
}
"""Pairs of which one takes off what the other adds, and what else may be said of them."""


@dataclass(frozen=True)
class Hidden:
    """What was put into a rig.

    Attributes:
        names: the effects in the interchange format's names.
        specimen: elements put beside the specimen's own.
        actuator: numbers of the table, by key, that the model has otherwise.
        accepted: other sets that are the same thing in this test.
    """

    names: tuple[str, ...]
    specimen: tuple[dict[str, Any], ...] = ()
    actuator: dict[str, float] = field(default_factory=dict)
    accepted: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True)
class Case:
    """A rig, what is hidden in it, and the test that records it."""

    kind: str
    label: str
    rig: str
    hidden: Hidden
    pga_g: float
    seed: int


def element(kind: str, **params: float) -> dict[str, Any]:
    """Return one element of a rig file."""
    return {"element": kind, **params}


def laws(random: np.random.Generator, pga_g: float) -> dict[str, dict[str, Any]]:
    """Return one element of each law that a specimen can have, its size drawn.

    Sizes are shares of the test's force, at 0.04 g 4.9 kN, 7.4 mm and 93 mm/s: 2 to 8 per cent; of
    the stiffness, which a rig file is taken to know to 2 per cent, 10 to 20. A friction turns over
    1 mm/s: a steeper one the virtual rig itself would not follow in its substeps.
    """
    stiffer = float(random.uniform(0.1, 0.2)) * 666.4e3 * float(random.choice([-1, 1]))
    size = pga_g / 0.04
    share = float(random.uniform(0.02, 0.08)) * 4900.0 * size
    x, v = 7.4e-3 * size, 0.093 * size
    at = float(random.uniform(0.3, 0.6)) * x
    return {
        "stiffness": element("stiffness", k_n_per_m=stiffer),
        "viscous": element("viscous", c_n_s_per_m=share / v),
        "coulomb": element("coulomb", fc_n=0.5 * share, width_m_per_s=1e-3),
        "stribeck": element(
            "stribeck",
            fc_n=0.5 * share,
            fs_n=0.5 * share * float(random.uniform(1.4, 2.0)),
            vs_m_per_s=0.012,
            width_m_per_s=1e-3,
        ),
        "quad_damping": element("quad_damping", c2_n_s2_per_m2=share / v**2),
        "cubic": element("cubic", k3_n_per_m3=2.0 * share / x**3),
        "quadratic": element("quadratic", k2_n_per_m2=2.0 * share / x**2),
        "stopper": element("stopper", ks_n_per_m=2.0 * share / (x - at), xs_m=at),
        "maxwell": element("maxwell", km_n_per_m=share / x * 2.0, tau_s=0.08),
    }


def of_table(random: np.random.Generator) -> Hidden:
    """Return the story of the table that the model leaves out: its mass, its friction, all of it.

    Of mass, friction and viscous force the model has half a kilogram and nothing. At 2 Hz 45 kg are
    one per cent of the stiffness, within the tolerance of the model's: either name will do there.
    """
    mass, friction = float(random.uniform(30, 60)), float(random.uniform(60, 160))
    table = {"moving_mass_kg": mass, "friction_n": friction, "viscous_n_s_per_m": 600.0}
    names = ("coulomb", "inertia", "viscous")
    accepted = (("coulomb", "viscous"), ("coulomb", "stiffness", "viscous"),
                ("coulomb", "inertia", "time_skew"), ("coulomb", "time_skew"))  # fmt: skip
    return Hidden(names, actuator=table, accepted=accepted)


def plans(seed: int) -> Iterator[Case]:
    """Yield every case by rig: singles, pairs, cancelling pairs, nothing, and the table's story."""
    for number, rig in enumerate(("actuator-end", "specimen", *LAGS)):
        yield from plan(rig, np.random.default_rng([seed, number]))


def plan(rig: str, random: np.random.Generator) -> Iterator[Case]:
    """Yield every case of one rig."""

    def case(kind: str, hidden: Hidden, pga_g: float) -> Case:
        label = f"{kind}:{'+'.join(hidden.names) or 'nothing'}"
        return Case(kind, label, rig, hidden, pga_g, int(random.integers(1, 2**31)))

    def drawn() -> tuple[dict[str, dict[str, Any]], float]:
        pga_g = float(random.choice([0.03, 0.04, 0.06]))
        return laws(random, pga_g), pga_g

    for name in laws(random, 0.04):
        items, pga_g = drawn()
        yield case("single", Hidden((name,), (items[name],)), pga_g)
    for names in PAIRS:
        items, pga_g = drawn()
        hidden = Hidden(tuple(sorted(names)), tuple(items[n] for n in names))
        yield case("pair", hidden, pga_g)
    for names, accepted in CANCELLING.items():
        items, pga_g = drawn()
        items["stiffness"]["k_n_per_m"] = -abs(items["stiffness"]["k_n_per_m"])
        hidden = Hidden(names, tuple(items[n] for n in names), accepted=accepted)
        yield case("cancelling", hidden, pga_g)
    yield case("nothing", Hidden(()), 0.04)
    # A cell behind the specimen does not see the table's own parts.
    for _ in range(3 if rig == "actuator-end" else 0):
        yield case("story", of_table(random), 0.04)


def rig_files(case: Case) -> tuple[Any, Any]:
    """Return the rig that recorded and the model of it."""
    model = config.load_rig(TABLE)
    data = model.model_dump(mode="json", by_alias=True, exclude_unset=True)
    if case.rig in LAGS:
        data["actuator"] = LAGS[case.rig]
        data["rig"]["load_cell"] = "specimen"
    else:
        data["rig"]["load_cell"] = case.rig
    true = json.loads(json.dumps(data))
    true["rig"]["seed"] = case.seed
    true["specimen"] = [*true["specimen"], *case.hidden.specimen]
    known = json.loads(json.dumps(data))
    if case.hidden.actuator:
        true["actuator"] |= case.hidden.actuator
        known["actuator"] |= {"moving_mass_kg": 0.5, "friction_n": 0.0, "viscous_n_s_per_m": 0.0}
    kind = type(model)
    return kind.model_validate(true), kind.model_validate(known)


def write(case: Case, folder: Path, pga_g: float | None = None, name: str = "run") -> Path:
    """Record a case; return the model's file beside the folder of the run."""
    true, known = rig_files(case)
    test = config.load_test(
        TEST, {"ground_motion.pga_g": str(pga_g or case.pga_g), "test.duration_s": "30"}
    )
    done = virtual_time.run(experiment.prepare(test, true))
    run = folder / name
    run.mkdir(parents=True, exist_ok=True)
    recording.write(run / recording.FILE_NAME, done)
    model = folder / "model.toml"
    model.write_text(config.dump(known), encoding="utf-8")
    return model


def make(case: Case, folder: Path) -> Path:
    """Write model, recording, a stronger test held out, and what is hidden, where not yet there."""
    if not (folder / "answer.json").exists():  # it is written last
        write(case, folder)
        write(case, folder, 1.5 * case.pga_g, "heldout")
        wanted = [sorted(case.hidden.names), *map(sorted, case.hidden.accepted)]
        truth = {"rig": case.rig, "kind": case.kind, "label": case.label, "wanted": wanted}
        (folder / "answer.json").write_text(json.dumps(truth) + "\n")
    return folder


def chosen(seed: int, count: int, kinds: Collection[str] = ()) -> list[Case]:
    """Return at most so many cases of each kind and rig; which ones, the seed says."""
    groups: dict[tuple[str, str], list[Case]] = defaultdict(list)
    for case in plans(seed):
        if not kinds or case.kind in kinds:
            groups[case.rig, case.kind].append(case)
    random = np.random.default_rng(seed)
    picked: list[Case] = []
    for group in groups.values():
        which = random.permutation(len(group))[:count]
        picked += [group[i] for i in sorted(which)]
    return picked


def tool(program: str) -> scoring.Tool:
    """Return the command line as it is asked about the recording of a run."""

    def run(folder: Path) -> tuple[scoring.Answer, scoring.Prediction]:
        files = [str(folder / "run"), "--model", str(folder / "model.toml")]
        call = [program, "diagnose", *files, "--heldout", str(folder / "heldout"), "--json"]
        return scoring.said_by(call, 300.0), None

    return run


@dataclass
class Row:
    """What was said of a case.

    Attributes:
        right: that set was named and no other.
        among: it was named, alone or among sets said to fit alike.
        closed: NRMSE of the displacement of the loop, simulated with the effects found.
    """

    rig: str
    kind: str
    label: str
    verdict: str
    said: list[list[str]]
    right: bool
    among: bool
    closed: float


def score(folder: Path, answer: scoring.Answer) -> Row:
    """Compare an answer with what was hidden."""
    truth = json.loads((folder / "answer.json").read_text())
    verdict = str(answer.get("verdict", "failed"))
    said = answer.get("ambiguous_with") or [answer.get("effects") or []]
    said = [sorted(s) for s in said]
    told = "explained" if truth["wanted"][0] else "none"
    right = verdict == told and said[0] in truth["wanted"]
    among = right or (verdict == "ambiguous" and any(w in said for w in truth["wanted"]))
    after = (answer.get("closed_loop") or {}).get("nrmse_after") or {}
    closed = float(after.get("x_meas", np.nan))
    return Row(truth["rig"], truth["kind"], truth["label"], verdict, said, right, among, closed)
