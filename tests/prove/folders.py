"""Case folders in the interchange format."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from prove import bench
from prove.answers import Case


def table(names: list[str], columns: list[np.ndarray]) -> str:
    """CSV with seven significant figures, the time with twelve."""
    forms = ["%.12g" if n == "t" else "%.7g" for n in names]
    line = ",".join(forms)
    rows = zip(*(c.tolist() for c in columns), strict=True)
    body = "\n".join(line % row for row in rows)
    return ",".join(names) + "\n" + body.replace("nan", "NaN") + "\n"


def recorded(case: Case, run: bench.Run, full: bool) -> dict[str, np.ndarray]:
    """Columns as they are written: noise, rounding, gaps; without the outputs if not full."""
    lab, rng, n = case.lab, case.rng, run.t.size
    noise = lab.noise
    x_noise = run.x_noise if run.x_noise is not None else noise.x * rng.standard_normal(n)
    f_meas = run.f_meas
    if f_meas is None:
        f_meas = lab.sensors.rounded(run.f + noise.f * rng.standard_normal(n))
    inputs = {"ag": run.ag, "x_num": run.x_num, "x_cmd": run.x_cmd, "f_in": run.f_in}
    columns = {"t": run.t} | {name: value for name, value in inputs.items() if value is not None}
    if lab.believed_actuator is None:
        columns.pop("x_cmd", None)
    outputs = {"x_meas": run.x + x_noise, "f_meas": f_meas}
    outputs["a_meas"] = run.a_read + noise.a * rng.standard_normal(n)
    unknown: tuple[str, ...] = ()
    if lab.family == "forced":
        unknown += ("f_meas", "fy_meas")
    if lab.fs < 500:
        unknown += ("a_meas",)
    if not full:
        unknown += ("f_meas",)
        if lab.family in ("ground", "forced"):
            unknown += ("x_meas", "a_meas")
    columns |= outputs
    columns["fy_meas"] = run.fy + 0.5 * noise.f * rng.standard_normal(n)
    columns = {k: q for k, q in columns.items() if k not in (*unknown, *case.drop)}
    if full and case.nan_rows:
        bad = np.zeros(n, bool)
        for a, b in case.nan_rows:
            bad[a:b] = True
        columns = {k: q if k == "t" else np.where(bad, np.nan, q) for k, q in columns.items()}
    return columns


def baseline_text(case: Case) -> str:
    lab = case.lab
    s = lab.believed
    lines = [
        'schema = "rthyb-baseline/1"', f'family = "{lab.family}"', f"fs_hz = {lab.fs:.10g}", "",
        "[specimen]", f"k = {s.k:.6g}", f"c = {s.c:.6g}", f"moving_mass = {s.mass:.6g}",
        "k_tol = 0.01", "c_tol = 0.15",
    ]  # fmt: skip
    if s.bouc_wen:
        lines += ["", "[specimen.bouc_wen]", f"alpha = {s.bouc_wen['alpha']:.6g}"]
        lines += [f"xy = {s.bouc_wen['xy']:.6g}", "n = 2", "beta = 0.55", "gamma = 0.45"]
    if lab.believed_actuator:
        a = lab.believed_actuator
        lines += ["", "[actuator]", f"delay_s = {a.delay_s:.6g}", f"f_hz = {a.f_hz:.6g}"]
        lines += [f"zeta = {a.zeta:.6g}", f"gain = {a.gain}"]
    if lab.mass:
        lines += ["", "[numerical]", f"m = {lab.mass:.6g}", f"c = {lab.damping:.6g}"]
    if lab.family == "loop":
        lines += ["", "[controller]", "plc_w1 = 3", "plc_w2 = 2", "rfc = true"]
        lines += [f"adaptive = {'true' if lab.rate > 0 else 'false'}"]
    q = lab.noise
    lines += ["", "[noise]", f"x_std = {q.x * q.sheet:.4g}", f"f_std = {q.f * q.sheet:.4g}"]
    if lab.fs > 500:
        lines += [f"a_std = {q.a * q.sheet:.4g}"]
    return "\n".join(lines) + "\n"


def write(case: Case, folder: Path, name: str) -> None:
    """The folder of a case, as the open examples have it."""
    folder.mkdir(parents=True, exist_ok=True)
    columns = recorded(case, case.run, True)
    (folder / "recording.csv").write_text(table(list(columns), list(columns.values())))
    (folder / "baseline.toml").write_text(baseline_text(case))
    columns = recorded(case, case.held, False)
    (folder / "heldout_input.csv").write_text(table(list(columns), list(columns.values())))
    x_base, f_base = bench.believed_outputs(case.lab, case.held)
    truth = [case.held.t, case.held.x, case.held.f, x_base, f_base]
    (folder / "heldout_truth.csv").write_text(table(["t", "x", "f", "x_base", "f_base"], truth))
    for kind, run in case.follow_ups.items():
        follow = folder / f"next_{kind}"
        follow.mkdir(exist_ok=True)
        columns = recorded(case, run, True)
        (follow / "recording.csv").write_text(table(list(columns), list(columns.values())))
        (follow / "baseline.toml").write_text(baseline_text(case))
    answer = {"id": name, **case.answer}
    (folder / "answer.json").write_text(json.dumps(answer, indent=1) + "\n")
