"""Case folders in the public interchange format."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from validate import rig, signals
from validate.recipes import Case
from validate.rig import Run
from validate.signals import rms

INPUTS = ("ag", "f_in", "x_num", "x_cmd")


def table(columns: dict[str, np.ndarray]) -> str:
    """CSV: the time with twelve significant figures, the rest with eight."""
    line = ",".join("%.12g" if n == "t" else "%.8g" for n in columns)
    rows = zip(*(c.tolist() for c in columns.values()), strict=True)
    body = "\n".join(line % row for row in rows)
    return ",".join(columns) + "\n" + body.replace("nan", "NaN") + "\n"


def columns(case: Case, run: Run, full: bool) -> dict[str, np.ndarray]:
    """What is written of a test; without the outputs if not full."""
    family = case.bench.family
    hidden = set(case.drop)
    if family == "forced":
        hidden |= {"f_meas", "fy_meas"}
    if not full:
        hidden |= {"f_meas"}
        if family in ("ground", "forced"):
            hidden |= {"x_meas", "a_meas"}
    kept = {n: y for n, y in run.recorded.items() if n not in hidden}
    out = {"t": run.t - run.t[0]}
    out |= {n: kept[n] for n in INPUTS if n in kept}
    out |= {n: y for n, y in kept.items() if n not in INPUTS}
    if full:
        bad = np.zeros(run.t.size, bool)
        for a, b in case.nan_rows:
            bad[a:b] = True
        out = {n: y if n == "t" else np.where(bad, np.nan, y) for n, y in out.items()}
    return out


def baseline(case: Case) -> str:
    """The model that the laboratory states."""
    b = case.bench
    lines = [
        'schema = "rthyb-baseline/1"', f'family = "{b.family}"', f"fs_hz = {b.fs:.10g}", "",
        "[specimen]", f"k = {b.k:.7g}", f"c = {b.c:.7g}", f"moving_mass = {b.moving:.7g}",
        "k_tol = 0.01", "c_tol = 0.15",
    ]  # fmt: skip
    if b.core is not None:
        lines += ["", "[specimen.bouc_wen]", f"alpha = {b.core[1]:.7g}", f"xy = {b.core[2]:.7g}"]
        lines += ["n = 2", "beta = 0.55", "gamma = 0.45"]
    if b.believed is not None:
        a = b.believed
        lines += ["", "[actuator]", f"delay_s = {a.delay_s:.7g}", f"f_hz = {a.f_hz:.7g}"]
        lines += [f"zeta = {a.zeta:.7g}", f"gain = {a.gain:.7g}"]
    if b.mass:
        lines += ["", "[numerical]", f"m = {b.mass:.7g}", f"c = {b.damping:.7g}"]
    if b.family == "loop":
        rfc = "true" if b.rfc else "false"
        lines += [
            "",
            "[controller]",
            "plc_w1 = 3",
            "plc_w2 = 2",
            f"rfc = {rfc}",
            "adaptive = false",
        ]
    sheets = {"x": b.x_noise, "f": b.f_noise, "a": b.a_noise}
    lines += ["", "[noise]"]
    # A pure delay has no accelerometer, and no sheet of one.
    lines += [f"{n}_std = {s.std * s.sheet:.4g}" for n, s in sheets.items() if s.std > 0]
    return "\n".join(lines) + "\n"


def effect_answer(case: Case, i: int) -> dict[str, Any]:
    """One entry of `effects`."""
    e, y, run = case.effects[i], case.run.parts[i], case.run
    level = rms(y)
    whole = rms(run.x) if e.channel == "disp" else rms(run.f)
    noise = case.bench.x_noise.std if e.channel == "disp" else case.bench.f_noise.std
    out: dict[str, Any] = {"name": e.name, "form": e.form, "params": e.params, "channel": e.channel}
    out["scored"] = list(e.params) if e.scored is None else list(e.scored)
    out |= {"effect_rms": level, "share": level / whole, "snr": level / noise}
    out["windows"] = signals.windows(run.t - run.t[0], y)
    if level > 0:
        strong = np.abs(y) > 0.5 * np.max(np.abs(y))
        ends = {n: s[strong] for n, s in (("x", run.x), ("v", run.v))}
        out["where"] = {n: [float(s.min()), float(s.max())] for n, s in ends.items()}
    if e.onset_s > 0:
        out["onset_s"] = e.onset_s
    return out


def answer(case: Case, name: str) -> dict[str, Any]:
    """The truth beside a case."""
    b = case.bench
    x_base, f_base = rig.baseline_run(b, case.held, case.held_signal)
    errors = {
        "force": rms(f_base - case.held.f) / float(np.std(case.held.f)),
        "disp": rms(x_base - case.held.x) / float(np.std(case.held.x)),
    }
    noise = {
        n: {"std": s.std, "sheet": s.sheet, "colour": s.colour}
        for n, s in (("x", b.x_noise), ("f", b.f_noise), ("a", b.a_noise))
    }
    return {
        "id": name, "kind": case.kind, "tier": case.level, "family": b.family,
        "noise": b.f_noise.colour, "noises": noise, "excitation": case.excitation[0],
        "heldout": case.excitation[1], "inelastic": b.core is not None,
        "actuator": b.actuator.kind if b.actuator else None, "heldout_nrmse_base": errors,
        "effects": [effect_answer(case, i) for i in range(len(case.effects))],
        "form": "+".join(e.form for e in case.effects), "ambiguous": case.ambiguous,
        "next_experiment": case.next_experiment, "verdict": case.verdict, "groups": case.groups,
        "judged": case.judged,
    }  # fmt: skip


def write(case: Case, folder: Path) -> None:
    """The folder of a case: recording, baseline, held-out input and truth, answer."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "recording.csv").write_text(table(columns(case, case.run, True)))
    (folder / "baseline.toml").write_text(baseline(case))
    (folder / "heldout_input.csv").write_text(table(columns(case, case.held, False)))
    x_base, f_base = rig.baseline_run(case.bench, case.held, case.held_signal)
    held = case.held
    truth = {"t": held.t, "x": held.x, "f": held.f, "x_base": x_base, "f_base": f_base}
    (folder / "heldout_truth.csv").write_text(table(truth))
    said = json.dumps(answer(case, folder.name), indent=1)
    (folder / "answer.json").write_text(said + "\n")
