"""A recording and its model from files, and everything that makes them unusable.

Two kinds of files: the interchange format (CSV beside ``rthyb-baseline/1``), and the tool's own
recording beside a rig or test file. What can be handled is handled and said in the case's notes;
what would make an answer worthless is an `InputError`.
"""

from __future__ import annotations

import csv
import difflib
import tomllib
import warnings
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.diagnose.case import CHANNELS, FAMILIES, BoucWen, Case, Floats, Model
from rthyb_rt.diagnose.estimate import filled, white_noise
from rthyb_rt.diagnose.simulate import ActuatorModel, SimulationError, actuator
from rthyb_rt.errors import InputError, Problem

if TYPE_CHECKING:
    from rthyb_rt.recording import Recording

BASELINE = "rthyb-baseline/1"
LEAST_ROWS = 100
SPIKE = 10.0
"""Ranges of a channel by which a reading is beyond it that cannot be one."""
MERE_NOISE = 0.9
"""Part of a channel that is white noise from which it is taken for nothing else."""
UNLIKE = 0.02
"""Part of such a channel that follows the model, up to which it is no measurement of it."""
SHORT = 3
"""Rows of a command that are missing in one place, and are filled in."""
RIG_K_TOL, RIG_C_TOL = 0.02, 0.2
"""What a rig file's numbers are taken to be good for; it does not say."""


# ---- the model --------------------------------------------------------------------------------


def read_model(path: Path) -> Model:
    """Read ``rthyb-baseline/1``, a rig file, or a test file with the rig that it names.

    Raises:
        InputError: with every fault found.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", str(path)) from error
    except UnicodeDecodeError as error:
        raise InputError("is no text in UTF-8, so no TOML", str(path)) from error
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"is no TOML: {error}", str(path)) from error
    schema = data.get("schema")
    if schema == BASELINE:
        return _baseline(data, str(path))
    if isinstance(schema, str) and schema.startswith(("rthyb-rig/", "rthyb-test/")):
        return _from_rig(path, schema)
    raise InputError(
        f"schema {schema!r}; a model is {BASELINE!r}, a rig file or a test file", str(path)
    )


class _Numbers:
    """Takes numbers out of TOML tables and gathers what is wrong with them."""

    def __init__(self, data: dict[str, Any], where: str) -> None:
        self.data, self.where = data, where
        self.problems: list[Problem] = []

    def table(self, name: str) -> dict[str, Any]:
        value: Any = self.data
        for part in name.split("."):
            value = value.get(part, {}) if isinstance(value, dict) else {}
        return value if isinstance(value, dict) else {}

    def get(
        self, table: str, key: str, default: float | None = None, low: float = -np.inf,
        open_low: bool = False,
    ) -> float:  # fmt: skip
        place = f"{table}.{key}" if table else key
        value = (self.table(table) if table else self.data).get(key, default)
        if value is None:
            self.problems.append(Problem(f"{self.where}: {place}", "is missing; it is a number"))
            return float("nan")
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
            self.problems.append(
                Problem(f"{self.where}: {place}", f"found {value!r}; it is a number")
            )
            return float("nan")
        if value < low or (open_low and value == low):
            word = "above" if open_low else "at least"
            self.problems.append(
                Problem(f"{self.where}: {place}", f"found {value:g}; it must be {word} {low:g}")
            )
        return float(value)

    def optional(self, table: str, key: str, low: float = 0.0) -> float | None:
        if key not in self.table(table):
            return None
        return self.get(table, key, low=low, open_low=True)


def _baseline(data: dict[str, Any], where: str) -> Model:
    n = _Numbers(data, where)
    family = data.get("family")
    if family not in FAMILIES:
        n.problems.append(
            Problem(f"{where}: family", f"found {family!r}; it is one of {', '.join(FAMILIES)}")
        )
    if not n.table("specimen"):
        n.problems.append(Problem(f"{where}: specimen", "is missing; it has k, c and moving_mass"))
    bouc_wen = actuator_model = None
    if n.table("specimen.bouc_wen"):
        t = "specimen.bouc_wen"
        bouc_wen = BoucWen(
            n.get(t, "alpha"), n.get(t, "xy", low=0.0, open_low=True),
            n.get(t, "n", 2.0, low=0.1), n.get(t, "beta", 0.5), n.get(t, "gamma", 0.5),
        )  # fmt: skip
    if n.table("actuator"):
        hold = data.get("command_hold", "foh")
        if hold not in ("zoh", "foh"):
            n.problems.append(
                Problem(f"{where}: command_hold", f"found {hold!r}; it is 'zoh' or 'foh'")
            )
        actuator_model = ActuatorModel(
            n.get("actuator", "delay_s", 0.0), n.get("actuator", "f_hz", low=0.0, open_low=True),
            n.get("actuator", "zeta", low=0.0, open_low=True), n.get("actuator", "gain", 1.0),
            hold="zoh" if hold == "zoh" else "foh",
        )  # fmt: skip
        shift = n.get("", "command_shift_s", 0.0)
        actuator_model = replace(actuator_model, delay_s=actuator_model.delay_s + shift)
    fs = n.get("", "fs_hz", low=0.0, open_low=True)
    model = Model(
        family=family if family in FAMILIES else "drive",
        fs_hz=fs,
        k=n.get("specimen", "k", 0.0, low=0.0),
        c=n.get("specimen", "c", 0.0, low=0.0),
        moving_mass=n.get("specimen", "moving_mass", 0.0, low=0.0),
        k_tol=n.optional("specimen", "k_tol"),
        c_tol=n.optional("specimen", "c_tol"),
        bouc_wen=bouc_wen,
        actuator=actuator_model,
        mass=n.get("numerical", "m", 0.0, low=0.0),
        c_num=n.get("numerical", "c", 0.0),
        x_std=n.optional("noise", "x_std"),
        f_std=n.optional("noise", "f_std"),
        a_std=n.optional("noise", "a_std"),
        plc=_weights(n),
        rfc=n.table("controller").get("rfc") if n.table("controller") else None,
    )
    if n.problems:
        raise InputError(n.problems)
    return replace(model, unused=_unused(data))


KNOWN: dict[str, tuple[str, ...]] = {
    "": ("schema", "family", "fs_hz", "command_hold", "command_shift_s", "specimen", "actuator",
         "numerical", "controller", "noise", "name", "description"),
    "specimen": ("k", "c", "moving_mass", "k_tol", "c_tol", "bouc_wen"),
    "specimen.bouc_wen": ("alpha", "xy", "n", "beta", "gamma"),
    "actuator": ("delay_s", "f_hz", "zeta", "gain"),
    "numerical": ("m", "c"),
    "controller": ("plc_w1", "plc_w2", "rfc", "adaptive"),
    "noise": ("x_std", "f_std", "a_std"),
}  # fmt: skip
"""Keys of a baseline file by table."""


def _unused(data: dict[str, Any]) -> tuple[str, ...]:
    """Return the keys of a baseline file that mean nothing here: a slip of the pen, perhaps."""
    out = []
    for table, known in KNOWN.items():
        part: Any = data
        for name in table.split(".") if table else ():
            part = part.get(name, {}) if isinstance(part, dict) else {}
        for key in part if isinstance(part, dict) else ():
            if key not in known:
                near = difflib.get_close_matches(key, known, 1, 0.5)
                near = near or [k for k in known if key in k]
                hint = f" (is {near[0]} meant?)" if near else ""
                out.append((f"{table}.{key}" if table else str(key)) + hint)
    return tuple(out)


def _weights(n: _Numbers) -> tuple[float, float] | None:
    given = n.table("controller")
    if "plc_w1" not in given or "plc_w2" not in given:
        return None
    w1, w2 = n.get("controller", "plc_w1"), n.get("controller", "plc_w2")
    if abs(w1) <= 1.0 or abs(w2) >= abs(w1 + 1.0):
        n.problems.append(
            Problem(
                f"{n.where}: controller.plc_w1, plc_w2",
                f"found {w1:g}, {w2:g}; a stable compensator has |w1| > 1 and |w2| < |w1 + 1|",
            )
        )
    return w1, w2


def _from_rig(path: Path, schema: str) -> Model:
    from rthyb_rt import config

    test = None
    if schema.startswith("rthyb-test/"):
        test = config.load_test(path)
        rig = config.load_rig(config.find_rig(test.rig))
    else:
        rig = config.load_rig(path)
    return model_of_rig(rig, test)


def model_of_rig(rig: Any, test: Any = None) -> Model:
    """Return the model that a rig file (and, for the numerical part, a test file) stands for."""
    from rthyb_rt.experiment import specimen_elements, table_elements

    k = c = mass = 0.0
    bouc_wen = None
    extra: list[core.ElementConfig] = []
    for item in (*specimen_elements(rig), *table_elements(rig)):
        p = dict(zip(core.ELEMENT_PARAMS[item.kind], item.params, strict=True))
        if item.kind == "stiffness":
            k += p["k_n_per_m"]
        elif item.kind == "viscous":
            c += p["c_n_s_per_m"]
        elif item.kind == "inertia":
            mass += p["m_kg"]
        elif (
            item.kind == "hysteresis" and bouc_wen is None and p["a"] == 1.0 and p["b"] + p["c"] > 0
        ):
            xy = (p["b"] + p["c"]) ** (-1.0 / p["eta"])
            bouc_wen = BoucWen(
                p["post_yield_ratio"],
                xy,
                p["eta"],
                p["c"] * xy ** p["eta"],
                p["b"] * xy ** p["eta"],
            )
            extra_k = p["k_n_per_m"]
        else:
            extra.append(item)
    if bouc_wen is not None:
        if k:
            extra.append(core.element("stiffness", k_n_per_m=k))
        k = extra_k
    numerical_m = numerical_c = 0.0
    if test is not None:
        numerical_m = float(test.numerical.mass_kg or 0.0)
        numerical_c = float(test.numerical.damping_n_s_per_m or 0.0)
    sensors = rig.sensors
    return Model(
        family="loop",
        fs_hz=core.FS_HZ,
        k=k,
        c=c,
        moving_mass=mass,
        k_tol=RIG_K_TOL,
        c_tol=RIG_C_TOL,
        bouc_wen=bouc_wen,
        actuator=_rig_actuator(rig),
        mass=numerical_m,
        c_num=numerical_c,
        x_std=sensors.displacement.noise_std_m or None,
        f_std=sensors.force.noise_std_n or None,
        extra=tuple(extra),
        rig=rig,
        plc=(test.controller.w1, test.controller.w2) if test is not None else None,
        rfc=test.controller.rfc.enabled if test is not None else None,
    )


def _rig_actuator(rig: Any) -> ActuatorModel | None:
    """Return a rig's actuator as a second-order lag; None for one that is no such thing."""
    a, h = rig.actuator, core.PERIOD_S
    hold, shift = rig.rig.command_hold, rig.rig.command_shift_s
    fast = 4000.0
    if a.kind == "second-order":
        return ActuatorModel(
            a.delay_s + shift, a.natural_frequency_hz, a.damping_ratio, a.gain, hold=hold
        )
    if a.kind == "pure-delay":
        # Half a row earlier, so that the held command of that row is met in its middle.
        late = (a.delay_samples - 0.5) * h if hold == "zoh" else a.delay_samples * h
        return ActuatorModel(late + shift, fast, 1.0, 1.0, hold=hold)
    if a.kind == "first-order":
        f = float(np.sqrt(a.roll_off_hz * fast))
        return ActuatorModel(
            a.extra_delay_samples * h + shift, f, (a.roll_off_hz + fast) / (2.0 * f), 1.0, hold=hold
        )
    return None


# ---- the recording ----------------------------------------------------------------------------


def read_case(recording: Path, model: Model, judged: bool = True) -> Case:
    """Read a recording beside its model.

    Args:
        recording: CSV file, HDF5 file or folder of a run.
        model: from `read_model`.
        judged: whether it must be fit for a diagnosis; False for an input to predict from.

    Raises:
        InputError: the file cannot be read, or no honest answer can come from it.
    """
    own = None
    if recording.is_dir() or recording.suffix in (".h5", ".hdf5"):
        from rthyb_rt.recording import open_run

        own = open_run(recording)
        t, channels, notes = _own(own)
    else:
        t, channels, notes = _table(recording)
    where = str(recording)
    if model.unused:
        notes.append(f"not used of the model: {', '.join(model.unused)}")
    t, channels, more = _uniform(t, channels, model.fs_hz, where)
    notes += more
    rows = np.ones(t.size, dtype=np.bool_)
    _filled_in(channels, notes)
    channels = _usable(channels, model, where, notes, judged)
    if judged:
        _spikes(channels, notes)
        _clipped(channels, where, notes)
        _fits_family(channels, model, where)
    folder = recording.resolve().parent.name
    case = Case(recording.stem, model, t, channels, rows, notes, own, folder)
    if judged:
        if t.size < LEAST_ROWS:
            raise InputError(f"has {t.size} rows; a diagnosis needs at least {LEAST_ROWS}", where)
        _units(case, where)
        _means_nothing(case, where)
    return case


def _own(rec: Recording) -> tuple[Floats, dict[str, Floats], list[str]]:
    from rthyb_rt.recording import FLAGS

    mask = rec.running()
    s = rec.samples[mask]
    channels = {
        "ag": s["ag_mps2"], "x_num": s["x_num_m"], "x_cmd": s["x_cmd_m"],
        "x_meas": s["x_meas_m"].copy(), "f_meas": s["f_meas_n"].copy(),
    }  # fmt: skip
    made_up = (s["flags"] & (FLAGS["predicted"] | FLAGS["blind"])) != 0
    notes = []
    if made_up.any():
        channels["x_meas"][made_up] = channels["f_meas"][made_up] = np.nan
        notes.append(f"{int(made_up.sum())} rows were predicted during the test and are left out")
    t = rec.time_s()[mask]
    out = {k: np.ascontiguousarray(v, dtype=np.float64) for k, v in channels.items()}
    if not np.any(out["ag"]):
        del out["ag"]
    return np.ascontiguousarray(t, dtype=np.float64), out, notes


def _table(path: Path) -> tuple[Floats, dict[str, Floats], list[str]]:
    where = str(path)
    quick = _quickly(path)
    if quick is not None:
        head, body = quick
        _check_head(head, where)
        return _columns(head, {name: body[:, j].copy() for j, name in enumerate(head)})
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = list(csv.reader(file))
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", where) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            "is no CSV text in UTF-8; give a recording as CSV or HDF5", where
        ) from error
    if len(lines) < 2:
        raise InputError("has no rows below its header", where)
    head = [name.strip() for name in lines[0]]
    _check_head(head, where)
    # Lines keep the number that an editor shows; empty ones are no rows.
    numbered = [(i, line) for i, line in enumerate(lines[1:], 2) if line]
    problems = [
        Problem(f"{where}:{i}", f"has {len(line)} fields, the header {len(head)}")
        for i, line in numbered
        if len(line) != len(head)
    ]
    if problems:
        raise InputError(problems[:5])
    data: dict[str, Floats] = {}
    for j, name in enumerate(head):
        try:
            data[name] = np.array([float(line[j] or "nan") for _, line in numbered])
        except ValueError:
            if name != "t" and name not in CHANNELS:
                data[name] = np.full(len(numbered), np.nan)
                continue
            row, text = next((i, line[j]) for i, line in numbered if not _number(line[j]))
            raise InputError(f"column {name}: {text!r} is no number", f"{where}:{row}") from None
    return _columns(head, data)


def _check_head(head: list[str], where: str) -> None:
    """Refuse a header that names no time, or one name twice."""
    if "t" not in head:
        found = ", ".join(head[:8]) or "no header"
        hint = "; name the column of time, s, t"
        if len(head) == 1 and any(mark in head[0] for mark in ";\t"):
            hint = "; separate columns by commas, and write numbers with a point"
        elif all(_number(name) for name in head):
            hint = "; the first line is to name the columns: t and " + ", ".join(CHANNELS)
        raise InputError(f"has no time column 't'; found {found}{hint}", f"{where}:1")
    if len(set(head)) < len(head):
        twice = next(name for name in head if head.count(name) > 1)
        raise InputError(f"has two columns of one name: {twice!r}", f"{where}:1")


def _columns(
    head: list[str], data: dict[str, Floats]
) -> tuple[Floats, dict[str, Floats], list[str]]:
    strange = [name for name in head if name != "t" and name not in CHANNELS]
    known = ", ".join(CHANNELS)
    notes = [f"columns not used: {', '.join(strange)} (known: {known})"] if strange else []
    # An infinite reading is as little a number as none.
    channels = {k: np.where(np.isfinite(v), v, np.nan) for k, v in data.items() if k in CHANNELS}
    return data["t"], channels, notes


def _quickly(path: Path) -> tuple[list[str], Floats] | None:
    """Return header and rows of a table of nothing but numbers; None for any other.

    Ten minutes of four channels take a second so, and not ten, and a tenth of the memory.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            head = [name.strip() for name in file.readline().split(",")]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of a file without rows; that is said elsewhere
                body = np.loadtxt(file, delimiter=",", ndmin=2, comments=None)
    except (OSError, ValueError):
        return None
    return (head, body) if body.shape[1] == len(head) and body.shape[0] > 1 else None


def _number(text: str) -> bool:
    try:
        float(text or "nan")
    except ValueError:
        return False
    return True


def _uniform(
    t: Floats, channels: dict[str, Floats], fs_hz: float, where: str
) -> tuple[Floats, dict[str, Floats], list[str]]:
    """Return the recording on a uniform time base; rows missing in a gap become NaN."""
    bad = np.flatnonzero(~np.isfinite(t))
    if bad.size:
        raise InputError("the time is no number", f"{where}:{bad[0] + 2}")
    if t.size < 2:
        raise InputError("has a single row", where)
    steps = np.diff(t)
    back = np.flatnonzero(steps <= 0)
    if back.size:
        i = int(back[0])
        raise InputError(
            f"time does not increase: {t[i]:g} s is followed by {t[i + 1]:g} s; sort the rows, or "
            "cut the recording where the clock was set",
            f"{where}:{i + 3}",
        )
    dt = float(np.median(steps))
    if abs(dt * fs_hz - 1.0) > 0.02:
        raise InputError(
            f"rows are {dt:.6g} s apart ({1 / dt:.6g} Hz), the model says fs_hz = {fs_hz:g}; "
            "correct the one that is wrong",
            where,
        )
    notes: list[str] = []
    # Gaps alone are counted: a printed time is rounded, a clock a little off.
    jumps = np.where(steps > 1.5 * dt, np.round(steps / dt).astype(np.int64), 1)
    index = np.concatenate(([0], np.cumsum(jumps)))
    dt = float(t[-1] - t[0]) / float(index[-1])
    jitter = float(np.max(np.abs((t - t[0]) / dt - index)))
    if jitter > 0.5:
        notes.append(f"rows jitter by up to {jitter:.2f} of their distance; taken as uniform")
    if jitter > 5.0:
        raise InputError(
            f"rows are spaced unevenly, by up to {jitter:.0f} of their distance; resample the "
            "recording to one rate",
            where,
        )
    missing = int(index[-1] + 1 - t.size)
    if missing == 0:
        return t, channels, notes
    if missing > t.size:
        raise InputError(
            f"more rows are missing ({missing}) than there are ({t.size}); diagnose the parts "
            "between the gaps",
            where,
        )
    whole = t[0] + dt * np.arange(index[-1] + 1)
    out = {}
    for name, values in channels.items():
        full = np.full(whole.size, np.nan)
        full[index] = values
        out[name] = full
    gaps = int((jumps > 1).sum())
    notes.append(f"{gaps} gap{'s' if gaps > 1 else ''} in time, {missing} rows; not judged")
    return whole, out, notes


NEEDED: dict[str, tuple[tuple[str, ...], ...]] = {
    "drive": (("f_meas", "x_meas"), ("f_meas", "x_cmd"), ("x_cmd", "x_meas")),
    "loop": (("f_meas", "x_meas"), ("f_meas", "x_cmd"), ("x_cmd", "x_meas")),
    "ground": (("ag", "x_meas"), ("f_meas", "x_meas")),
    "forced": (("f_in", "x_meas"),),
}


def _usable(
    channels: dict[str, Floats], model: Model, where: str, notes: list[str], judged: bool
) -> dict[str, Floats]:
    """Drop channels without information; refuse when a needed one has none."""
    out = dict(channels)
    reasons: dict[str, str] = {}
    for name, values in channels.items():
        good = values[np.isfinite(values)]
        if good.size == 0:
            reasons[name] = "holds no number"
        elif good.size > 2 and np.all(good == good[0]):
            reasons[name] = f"is constant ({good[0]:g} {CHANNELS[name]})"
        elif judged and good.size < 0.5 * values.size:
            reasons[name] = (
                f"holds numbers in {100 * good.size / values.size:.0f} % of its rows only"
            )
        if name in reasons:
            del out[name]
            notes.append(f"{name} {reasons[name]} and is not used")
        elif good.size < values.size and judged:
            notes.append(f"{name}: rows without a number: {values.size - good.size}; not judged")
    choices = NEEDED[model.family]
    if judged and not any(set(choice) <= set(out) for choice in choices):
        asked = " or ".join(" and ".join(choice) for choice in choices)
        why = "; ".join(f"{name} {reason}" for name, reason in reasons.items())
        raise InputError(
            f"family {model.family!r} needs {asked}; found {', '.join(out) or 'none of them'}"
            + (f" ({why})" if why else ""),
            where,
        )
    return out


def _fits_family(channels: dict[str, Floats], model: Model, where: str) -> None:
    """Refuse a model that cannot be the model of such a recording."""
    family = model.family
    if family in ("ground", "forced") and "x_cmd" in channels and "ag" not in channels:
        raise InputError(
            f"has x_cmd and no ag: a recording of a driven specimen; the model says {family!r}",
            where,
        )
    if (family == "ground" and model.mass <= 0) or (
        family == "forced" and model.mass + model.moving_mass <= 0
    ):
        table = "numerical.m" if family == "ground" else "specimen.moving_mass"
        raise InputError(f"family {family!r} needs a mass: {table} is missing or 0", where)
    if family == "drive" and "f_in" in channels and "f_meas" not in channels:
        raise InputError("has f_in, the channel of family 'forced'; the model says 'drive'", where)
    only_command = "x_meas" not in channels or "f_meas" not in channels
    if family in ("drive", "loop") and only_command and model.actuator is None:
        raise InputError(
            "x_meas and f_meas are not both there, and the model has no [actuator] to make up for "
            "it; add one, or record both",
            where,
        )
    if model.k == 0 and model.c == 0 and model.moving_mass == 0 and "f_meas" in channels:
        raise InputError("the model's force is zero: give k, c or moving_mass", where)


def _spikes(channels: dict[str, Floats], notes: list[str]) -> None:
    """Leave out single readings that lie many times beyond everything else: a faulty sample.

    No more than a few rows in a thousand are of that kind; more are a signal.
    """
    for name, values in channels.items():
        good = np.isfinite(values)
        low, high = np.quantile(values[good], (0.002, 0.998))
        span = float(high - low)
        off = good & ((values < low - SPIKE * span) | (values > high + SPIKE * span))
        # A real peak has flanks: a faulty sample stands alone.
        alone = off & ~np.r_[False, off[:-1]] & ~np.r_[off[1:], False]
        if span > 0.0 and off.any() and np.array_equal(alone, off):
            clean = values.copy()
            clean[off] = np.nan
            channels[name] = clean
            first = int(np.flatnonzero(off)[0])
            notes.append(
                f"{name} has {int(off.sum())} stray reading{'s' if off.sum() > 1 else ''} "
                f"({values[first]:.3g} {CHANNELS[name]} in row {first + 1}); not judged there"
            )


def _clipped(channels: dict[str, Floats], where: str, notes: list[str]) -> None:
    """Leave out rows at which a sensor stood at the end of its range."""
    for name in ("x_meas", "f_meas", "a_meas", "ag", "f_in"):
        values = channels.get(name)
        if values is None:
            continue
        rows = _at_the_stops(values)
        share = float(rows.mean())
        if share == 0.0:
            continue
        if share > 0.2:
            raise InputError(
                f"{name} stands at the end of its range in {100 * share:.0f} % of the rows: the "
                "sensor is clipped; choose a larger range and repeat the test",
                where,
            )
        clean = values.copy()
        clean[rows] = np.nan
        channels[name] = clean
        notes.append(
            f"{name} is clipped in {int(rows.sum())} rows ({100 * share:.1f} %); not judged there"
        )


def _at_the_stops(values: Floats) -> NDArray[np.bool_]:
    good = np.isfinite(values)
    out = np.zeros(values.size, dtype=np.bool_)
    spread = float(np.nanstd(values))
    for end in (np.nanmax(values), np.nanmin(values)):
        # What is left at rest, or one level of a coarse converter, is no stop.
        if abs(end - np.nanmedian(values)) < 0.5 * spread:
            continue
        at = good & (values == end)
        longest = _longest_run(at)
        inside = good & (values < np.nanmax(values)) & (values > np.nanmin(values))
        repeats = np.concatenate(([False], (np.diff(values) == 0))) & inside
        if longest >= 6 and longest > 4 * (_longest_run(repeats) + 1):
            out |= at
    return out


def _longest_run(mask: NDArray[np.bool_]) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.astype(np.int8), [0]))))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


def _means_nothing(case: Case, where: str) -> None:
    """Refuse a load cell that shows nothing but noise while the specimen moves.

    Laws enough are fitted to nothing: without a reading there is no answer.
    """
    f, x = case.channels.get("f_meas"), case.channels.get("x_meas")
    if f is None or x is None or not case.model.k:
        return
    spread = float(np.nanstd(f))
    if spread == 0.0 or not white_noise(f) > MERE_NOISE * spread:
        return
    good = np.isfinite(f) & np.isfinite(x)
    expected = case.model.spring(filled(x))[good]
    if np.std(expected) == 0.0 or np.std(expected) < spread:
        return
    if abs(float(np.corrcoef(f[good], expected)[0, 1])) < UNLIKE**0.5:
        raise InputError(
            f"f_meas shows nothing but noise ({spread:.3g} N) where the model has forces of "
            f"{float(np.std(expected)):.3g} N: is the load cell connected, is it the right "
            "channel?",
            where,
        )


def _filled_in(channels: dict[str, Floats], notes: list[str]) -> None:
    """Put in rows of an input that are missing one to three at a time.

    What was sent or known is smooth over a few milliseconds; a cubic through its neighbours is
    nearer than what an actuator makes of the difference. Measured channels keep their gaps.
    """
    for name in ("x_cmd", "x_num", "ag", "f_in"):
        values = channels.get(name)
        if values is None or np.isfinite(values).all() or np.isfinite(values).sum() < 8:
            continue
        lost = ~np.isfinite(values)
        edges = np.flatnonzero(np.diff(np.concatenate(([0], lost.astype(np.int8), [0]))))
        short = np.zeros(values.size, dtype=np.bool_)
        for a, b in zip(edges[::2], edges[1::2], strict=True):
            if b - a <= SHORT and a > 0 and b < values.size:
                short[a:b] = True
        if not short.any():
            continue
        clean = values.copy()
        at = np.flatnonzero(~lost)
        clean[short] = _cubic(at, values[at], np.flatnonzero(short))
        channels[name] = clean
        notes.append(f"{name}: {int(short.sum())} single missing rows were filled in")


def _cubic(at: NDArray[np.int64], y: Floats, wanted: NDArray[np.int64]) -> Floats:
    """Return values between rows by the cubic through the two neighbours to either side."""
    right = np.clip(np.searchsorted(at, wanted), 2, at.size - 2)
    index = right[:, None] + np.array([-2, -1, 0, 1])
    x, f = at[index].astype(np.float64), y[index]
    out = np.zeros(wanted.size)
    for i in range(4):
        term = f[:, i].copy()
        for j in range(4):
            if i != j:
                term *= (wanted - x[:, j]) / (x[:, i] - x[:, j])
        out += term
    return out


FACTORS: tuple[tuple[float, str], ...] = (
    (1000.0, "1000 (milli or kilo)"),
    (9.81, "9.81 (g or kgf)"),
    (9810.0, "9810 (kN and kgf)"),
)


def _units(case: Case, where: str) -> None:
    """Refuse channels whose size is off by a factor that units are made of."""
    for name, ratio in _ratios(case):
        for factor, words in FACTORS:
            for f in (factor, 1.0 / factor):
                if abs(ratio / f - 1.0) < 0.12:
                    size = "large" if ratio > 1 else "small"
                    raise InputError(
                        f"{name} is {words} times too {size} for the model (ratio {ratio:.4g}): a "
                        f"wrong unit is suspected; channels are in SI, {name} in "
                        f"{CHANNELS[name]}: convert the column, or correct the model",
                        where,
                    )
        if abs(ratio + 1.0) < 0.12 and name in AGAINST and _opposed(case, name):
            raise InputError(
                f"{name} runs against {AGAINST[name]} (ratio {ratio:.4g}): a wrong sign is "
                "suspected; a command, the displacement and the force that resists it count in "
                "one direction",
                where,
            )


AGAINST = {"x_meas": "x_cmd", "f_meas": "the model's force"}


def _opposed(case: Case, name: str) -> bool:
    """Return whether a channel is nothing but the other with its sign turned.

    A force alone may be against the displacement above resonance, where mass outweighs the spring.
    """
    if name == "x_meas":
        return True
    c, m = case.channels, case.model
    x, f = filled(c["x_meas"]), filled(c["f_meas"])
    if np.corrcoef(f, m.spring(x))[0, 1] > -0.95:
        return False
    speed, k = float(np.std(np.diff(x))) * m.fs_hz, max(abs(m.k), 1e-300)
    omega = speed / (float(np.std(x)) or 1.0)
    return (m.moving_mass + m.mass) * omega**2 < 0.3 * k


def _ratios(case: Case) -> Iterable[tuple[str, float]]:
    """Give channels with their size as a multiple of what the model expects."""
    c, m = case.channels, case.model
    x_meas = c.get("x_meas")
    if x_meas is not None and "x_cmd" in c:
        u = filled(c["x_cmd"])
        if m.actuator is not None:
            try:
                u = actuator(m.actuator, u, m.fs_hz).x
            except SimulationError as error:
                raise InputError(f"{error}", where="actuator") from error
        yield "x_meas", _slope(filled(x_meas), u)
    f_meas = c.get("f_meas")
    if x_meas is not None and f_meas is not None and m.k:
        x = filled(x_meas)
        yield "f_meas", _slope(filled(f_meas), m.spring(x))
    if m.family == "forced" and x_meas is not None and m.k and "f_in" in c:
        yield "f_in", 1.0 / _simulated_ratio(m, filled(c["f_in"]), 0.0, filled(x_meas))
    if m.family == "ground" and f_meas is not None and "ag" in c and "a_meas" in c and m.mass:
        yield "a_meas", _slope(filled(c["a_meas"]), -filled(f_meas) / m.mass)
    if m.family == "ground" and x_meas is not None and "ag" in c and m.mass and m.k:
        yield "ag", 1.0 / _simulated_ratio(m, -m.mass * filled(c["ag"]), m.mass, filled(x_meas))


def _simulated_ratio(model: Model, push: Floats, mass: float, x_meas: Floats) -> float:
    """Return measured over simulated displacement; 1 where they differ in more than size.

    Near resonance size alone says nothing of units: damping decides it.
    """
    from rthyb_rt.diagnose.predict import Augmented

    bare = Augmented(model, model, (), (), None, None)
    t = np.arange(push.size) / model.fs_hz
    try:
        x = bare.moved_by(push, mass, t, {}).x
    except (SimulationError, core.CoreError):
        return 1.0
    if np.std(x) == 0 or np.std(x_meas) == 0 or np.corrcoef(x, x_meas)[0, 1] < 0.95:
        return 1.0
    return max(_slope(x_meas, x), 1e-12)


def _slope(found: Floats, expected: Floats) -> float:
    expected = expected - expected.mean()
    power = float(expected @ expected)
    return float((found - found.mean()) @ expected) / power if power > 0 else 1.0
