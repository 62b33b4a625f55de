"""Effects hidden in the rigs that the project ships, recorded by its own hybrid tests.

    python tests/validate/own_rigs.py [--only hydraulic] [--seed 1] [--jobs 2]

A case is a shipped rig with one or more effects put into its specimen (or its table), a test of
Section 5 on it in virtual time, and the rig as shipped for a model. The command line is asked what
is missing; right is the set that was hidden, alone or among the sets said to fit alike, and a loop
that closes with it.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rthyb_rt import config, experiment, recording, virtual_time

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


@dataclass
class Row:
    """What was said of a case."""

    case: Case
    verdict: str
    said: list[list[str]]
    right: bool
    closed: float
    heldout: float
    seconds: float
    error: str = ""


def judge(case: Case, folder: Path) -> Row:
    """Record a case, ask the command line about it, and score what it says."""
    model = write(case, folder)
    write(case, folder, 1.5 * case.pga_g, "heldout")
    tool = Path(sys.executable).with_name("rthyb")
    call = [str(tool), "diagnose", str(folder / "run"), "--model", str(model),
            "--heldout", str(folder / "heldout"), "--json"]  # fmt: skip
    began = time.monotonic()
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    seconds = time.monotonic() - began
    try:
        answer = json.loads(done.stdout)
    except json.JSONDecodeError:
        return Row(case, "refused", [], False, np.nan, np.nan, seconds, done.stderr[-300:])
    said = answer["ambiguous_with"] or [answer["effects"]]
    said = [sorted(s) for s in said]
    wanted = [sorted(case.hidden.names), *map(sorted, case.hidden.accepted)]
    right = any(w in said for w in wanted) and answer["verdict"] not in ("unknown",)
    loop = answer.get("closed_loop") or {}
    closed = float((loop.get("nrmse_after") or {}).get("x_meas", np.nan))
    heldout = float(answer["fit"].get("heldout_nrmse_after", np.nan))
    return Row(case, answer["verdict"], said, right, closed, heldout, seconds)


def told(row: Row) -> str:
    """Return a line of the table."""
    mark, sets = "ok  " if row.right else "MISS", "|".join("+".join(s) for s in row.said)
    return (
        f"{mark} {row.case.rig:13} {row.case.label:32} {row.verdict:9} {sets:50} "
        f"loop {row.closed:.3f} held {row.heldout:.3f} {row.seconds:.1f} s {row.error}"
    )


def main() -> int:
    """Run the cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="part of a rig's, kind's or effect's name")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--keep", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        root = args.keep or Path(temporary)
        cases = [c for c in plans(args.seed) if args.only in f"{c.rig} {c.label}"]

        def one(numbered: tuple[int, Case]) -> Row:
            number, case = numbered
            row = judge(case, root / f"{number:03d}")
            print(f"{number:03d} {told(row)}", flush=True)
            return row

        with ThreadPoolExecutor(args.jobs) as pool:
            rows = list(pool.map(one, enumerate(cases)))
    for rig in dict.fromkeys(r.case.rig for r in rows):
        own = [r for r in rows if r.case.rig == rig]
        right = sum(r.right for r in own)
        closed = sum(r.closed < CLOSED for r in own)
        print(f"{rig:13} named {right} of {len(own)}, loop closed {closed} of {len(own)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
