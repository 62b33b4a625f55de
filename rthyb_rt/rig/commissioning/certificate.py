"""Record of the checks of a rig, with their dates and the rig file to which they apply.

The file is stored beside the rig file, and a test in real time requires it. It remains valid until
a key of the rig file changes that could reverse a sign or move a limit.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from rthyb_rt import __version__, config
from rthyb_rt.config import AxesRig, RigFile
from rthyb_rt.config.limits import IN_SAMPLES
from rthyb_rt.config.lonesensors import OneOfSeveral
from rthyb_rt.config.rate import STANDARD_HZ
from rthyb_rt.config.rigfile import TOLERANCES
from rthyb_rt.core.sizes import STANDARD_RATE_HZ
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.lab import beside
from rthyb_rt.lab.realtime import RefusedError
from rthyb_rt.record.recording import replacing
from rthyb_rt.rig.commissioning import sensor_noise

SCHEMA: Final = "rthyb-commissioned/1"
STEPS: Final = ("link", "polarity", "limits", "watchdog", "trip")
"""In the order in which they are carried out."""
SUFFIX: Final = ".commissioned.json"

_MATTERS: Final = ("link", "calibration", "actuator", "sensors", "limits")
_READ_BY: Final = ("link", "calibration", "sensors")
"""Of an axis, what determines the readings of its drive."""
_FIRST_KEYS: Final[dict[str, tuple[str, ...]]] = {
    "link": ("interface", "bitrate", "data_bitrate", "dbc"),
    "limits": (
        *("command_position_m", "command_velocity_m_per_s", "command_acceleration_m_per_s2"),
        *("command_increment_m", "force_n", "tracking_error_m", "energy_error_j"),
        *("tracking_indicator_slope_m2_per_s", "sensor_stuck_samples", "sensor_jump_m"),
        *("path_velocity_m_per_s", "path_acceleration_m_per_s2", "ramp_in_s", "armed_timeout_s"),
        *("tare_s", "rest_spread_m"),
    ),
    "sensors": ("displacement", "force"),
}
"""Keys without a value that have been part of the hash since the first version."""
_MAX_BYTES: Final = 10**6


@dataclass(frozen=True)
class CheckedStep:
    """The result of one step.

    Attributes:
        name: one of `STEPS`.
        passed: True, False, or None if it could not be carried out.
        date: UTC, to the second.
        figures: results by name: numbers, strings, and lists of them.
        faults: what is wrong, each with its remedy; or why it could not be carried out.
    """

    name: str
    passed: bool | None
    date: str
    figures: dict[str, Any] = field(default_factory=dict)
    faults: tuple[str, ...] = ()


def now() -> str:
    """Return the current time, as the date of a step."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


@dataclass(frozen=True)
class Certificate:
    """The commissioning of one rig.

    Attributes:
        rig_name, rig_hash: of the rig file, see `rig_hash`.
        virtual: whether a virtual rig was at the other end.
        link: name of the link.
        sample_rate_hz: of the drive during commissioning; not valid at any other rate.
        version: of this program.
        steps: by name.
    """

    rig_name: str
    rig_hash: str
    virtual: bool
    link: str
    sample_rate_hz: int = STANDARD_RATE_HZ
    version: str = __version__
    steps: dict[str, CheckedStep] = field(default_factory=dict)

    def with_step(self, step: CheckedStep) -> Certificate:
        """Return a copy with this step added or replaced."""
        return replace(self, steps={**self.steps, step.name: step})

    def date_of(self, name: str) -> str:
        """Return when a step passed, or "" if it has not."""
        step = self.steps.get(name)
        return step.date if step is not None and step.passed else ""

    @property
    def lacking(self) -> list[str]:
        """What prevents a test, one sentence per step; empty if every step has passed."""
        return [f"{name} {self._why(name)}" for name in STEPS if not self.date_of(name)]

    def _why(self, name: str) -> str:
        step = self.steps.get(name)
        if step is None:
            return "was not done"
        return "FAILED" if step.passed is False else "could not be checked"

    @property
    def date(self) -> str:
        """Date of the last step, or "" if there is none."""
        return max((step.date for step in self.steps.values()), default="")

    def as_json(self) -> dict[str, Any]:
        """Return the certificate as a JSON document, as written to its file."""
        own = {k: v for k, v in self.__dict__.items() if k != "steps"}
        steps = {
            name: {**self.steps[name].__dict__, "faults": list(self.steps[name].faults)}
            for name in STEPS
            if name in self.steps
        }
        for step in steps.values():
            del step["name"]
        return {"schema": SCHEMA, "date": self.date, **own, "steps": steps}


def rig_hash(rig: RigFile, axis: str = "") -> str:
    """Return a hash of everything that a commissioning depends on: hexadecimal, 64 digits.

    Covers link, calibration, actuator, sensors and limits, but not names, comments, specimen, k_e
    or identified values. A DBC file counts by its content, not by its path. For an axis of several
    its name counts as well, because the kinematics refer to it by name; and if there are sensors
    without an actuator, so do all of these, link, calibration and sensors of every axis, and the
    kinematics.
    """
    content = _content(rig)
    if axis:
        content["axis"] = axis
    if rig.one_of is not None and rig.one_of.sensors:
        content["sensors_of_axes"] = _of_sensors(rig, rig.one_of)
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _content(rig: RigFile) -> dict[str, Any]:
    """Return what matters of a rig of one axis, as plain values."""
    content = {key: value for key, value in rig.model_dump().items() if key in _MATTERS}
    for table, first in _FIRST_KEYS.items():
        given = content[table] or {}
        # A key of a later version must not change the hash of a file that does not set it.
        for key in [key for key in given if key not in first and given[key] in (None, [], ())]:
            del given[key]
    # Times that were counted in samples when the rig was commissioned keep their hash.
    given = content["limits"] or {}
    for key, old in IN_SAMPLES.items():
        limit = given.get(key)
        if limit is not None and (limit["value"] * STANDARD_HZ).is_integer():
            given[old] = {**given.pop(key), "value": int(limit["value"] * STANDARD_HZ)}
    # Rigs commissioned before other rates existed keep their hash.
    if rig.link is not None and rig.link.sample_rate_hz == STANDARD_RATE_HZ:
        del content["link"]["sample_rate_hz"]
    if rig.link is not None and rig.link.dbc is not None:
        content["link"]["dbc"] = _digest(Path(rig.link.dbc))
    for key in TOLERANCES:
        content["actuator"].pop(key, None)
    return content


def _of_sensors(rig: RigFile, common: OneOfSeveral) -> dict[str, Any]:
    """Return what sign and scale of the sensors without an actuator were checked against.

    It is the same for every axis, because each axis moves them: the sensors, the kinematics, and of
    every axis the drive that answers and what its own sensors read. Each check compared the sensors
    with the readings of all axes, so that one axis that reads otherwise undoes all of them.
    """
    axes = {common.name: rig, **common.others}
    of_axes = {
        name: {key: value for key, value in _content(axes[name]).items() if key in _READ_BY}
        for name in common.names
    }
    read = [
        {"sensor": one.sensor.model_dump(exclude_none=True), "axis": one.axis, "number": one.number}
        for one in common.sensors
    ]
    return {"read": read, "of_axes": of_axes, **common.meaning}


def _digest(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", str(path)) from error


# ---- files --------------------------------------------------------------------------------------


def place(rig_path: Path, axis: str = "") -> Path:
    """Return the path of a rig file's certificate: beside the rig file, unless that is shipped with
    the program or its folder is not writable. Each of several axes has its own certificate.
    """
    name = _file_name(rig_path, axis)
    if _shipped(rig_path) or not os.access(rig_path.parent, os.W_OK):
        return state_folder() / name
    return rig_path.with_name(name)


def _file_name(rig_path: Path, axis: str) -> str:
    return rig_path.stem + (f".{axis}" if axis else "") + SUFFIX


def state_folder() -> Path:
    """Return the folder for certificates that cannot be stored beside their rig file."""
    home = os.environ.get("XDG_STATE_HOME")
    return (Path(home) if home else Path.home() / ".local" / "state") / "rthyb"


def _shipped(rig_path: Path) -> bool:
    try:
        return config.shipped_rig(rig_path.stem).resolve() == rig_path.resolve()
    except InputError:
        return False


def write(path: Path, certificate: Certificate) -> None:
    """Write a certificate, replacing an older one.

    Raises:
        RthybError: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RthybError(
            f"cannot be made ({error.strerror or error}); check its permissions, or set "
            "XDG_STATE_HOME",
            where=str(path.parent),
        ) from error
    text = json.dumps(certificate.as_json(), indent=2, ensure_ascii=False, allow_nan=False)
    with replacing(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
        # A service reads it as a different user, whatever the umask of root.
        temporary.chmod(0o644)


def read(path: Path) -> Certificate:
    """Read a certificate.

    Raises:
        InputError: the file does not exist or is not a valid certificate.
    """
    try:
        with path.open("rb") as file:
            document = json.loads(file.read(_MAX_BYTES))
        if document["schema"] != SCHEMA:
            raise ValueError(f"schema {document['schema']!r}, but this version reads {SCHEMA!r}")
        return Certificate(
            rig_name=str(document["rig_name"]),
            rig_hash=str(document["rig_hash"]),
            virtual=document["virtual"] is True,
            link=str(document["link"]),
            # Files from before other rates existed do not contain a rate.
            sample_rate_hz=int(document.get("sample_rate_hz", STANDARD_RATE_HZ)),
            version=str(document["version"]),
            steps={name: _step(name, step) for name, step in document["steps"].items()},
        )
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", str(path)) from error
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise InputError(
            f"is not a commissioning file ({error}); run `rthyb commission` again", str(path)
        ) from error


def _step(name: str, data: dict[str, Any]) -> CheckedStep:
    if name not in STEPS or data["passed"] not in (True, False, None):
        raise ValueError(f"step {name!r}")
    date = datetime.datetime.fromisoformat(data["date"]).isoformat(timespec="seconds")
    return CheckedStep(
        name, data["passed"], date, dict(data["figures"]), tuple(map(str, data["faults"]))
    )


def find(
    rig: RigFile, rig_path: Path, axis: str = ""
) -> tuple[Certificate | None, Certificate | None]:
    """Return the certificate that is valid for a rig as it is now, or else its previous one.

    The search begins with the rig file's name and continues with the other certificates in the
    folder, so that a rig file that was identified or renamed needs no new commissioning. If several
    are valid, the latest result of each step counts: an older pass does not outweigh a failure.
    """
    wanted = rig_hash(rig, axis)
    held: Certificate | None = None
    older: Certificate | None = None
    for path, found in _near(rig_path, axis):
        if found.rig_hash == wanted:
            held = found if held is None else _newest(held, found)
        elif path.name == _file_name(rig_path, axis):
            # Its own place, or beside the rig file if that folder is read-only, as for a service.
            older = older or found
    return held, None if held else older


def _newest(first: Certificate, other: Certificate) -> Certificate:
    for name, step in other.steps.items():
        if name not in first.steps or step.date > first.steps[name].date:
            first = first.with_step(step)
    return first


def _near(rig_path: Path, axis: str) -> Iterator[tuple[Path, Certificate]]:
    own = place(rig_path, axis)
    # Unreadable certificates of other rigs are ignored; its own must be readable.
    if own.exists():
        yield own, read(own)
    for path in _others(own, rig_path.parent):
        try:
            yield path, read(path)
        except InputError:
            continue


def _others(own: Path, folder: Path) -> Iterable[Path]:
    return (path for path in sorted(folder.glob(f"*{SUFFIX}")) if path != own)


def each(rig: RigFile | AxesRig) -> list[tuple[RigFile, str]]:
    """Return everything that is commissioned separately, each as a rig of one axis with its name.

    A rig of several axes yields each axis; a rig of one axis yields itself, with the name "".
    """
    if isinstance(rig, AxesRig):
        return [(rig.of_axis(name), name) for name in rig.names]
    return [(rig, "")]


def carry(rig: RigFile | AxesRig, rig_path: Path, new_path: Path) -> None:
    """Copy a valid certificate to another file of the same rig that has none yet."""
    for own, axis in each(rig):
        holds, _ = find(own, rig_path, axis)
        if holds is not None and find(own, new_path, axis)[0] is None:
            write(place(new_path, axis), holds)


# ---- what a test requires -----------------------------------------------------------------------


@dataclass(frozen=True)
class Standing:
    """Whether a rig file, in its present state, may be used for a test in real time.

    Attributes:
        demanded: whether commissioning is required; False with a virtual rig at the other end.
        holds: the certificate that is valid for exactly this content, or None.
        path: where the certificate of this file is stored.
        why_not: what prevents a test, with the remedy; "" if nothing does or if commissioning is
            not required.
    """

    demanded: bool
    holds: Certificate | None
    path: Path
    why_not: str

    def as_json(self) -> dict[str, Any]:
        """Return it as plain values, with result and date of every step of `STEPS`."""
        made = {} if self.holds is None else self.holds.steps
        steps = {
            name: {"passed": made[name].passed, "date": made[name].date} if name in made else None
            for name in STEPS
        }
        return {
            "demanded": self.demanded,
            "commissioned": self.holds is not None and not self.holds.lacking,
            "certificate": str(self.path),
            "why_not": self.why_not,
            "steps": steps,
        }


def standing(rig: RigFile, rig_path: Path, axis: str = "") -> Standing:
    """Return whether a rig, or one axis of several, is commissioned for the present rig file.

    Raises:
        InputError: its certificate cannot be read.
    """
    demanded = _is_real(rig)
    holds, older = find(rig, rig_path, axis)
    lacks = demanded and (holds is None or bool(holds.lacking))
    why_not = _why_not(rig, rig_path, holds, older, axis) if lacks else ""
    return Standing(demanded, holds, place(rig_path, axis), why_not)


def demand(rig: RigFile | AxesRig, rig_path: Path) -> dict[str, Any]:
    """Return what a recording's ``meta`` states about the commissioning of its rig.

    Each of several axes must have passed; the details of each are stored under ``axes``. With a
    virtual rig at the other end (no ``[link]``, or ``link.virtual``) nothing is required.

    Raises:
        RefusedError: a check of `STEPS` has not passed for this rig file; the message names it.
    """
    stands = {axis: standing(own, rig_path, axis) for own, axis in each(rig)}
    why_not = [
        f"axis {axis}: {found.why_not}" if axis else found.why_not
        for axis, found in stands.items()
        if found.why_not
    ]
    if any(found.demanded for found in stands.values()):
        why_not += inconclusive(rig, rig_path) + _unwatched(rig, stands)
    if why_not:
        raise RefusedError("; ".join(why_not), where=str(rig_path))
    known = {axis: _known(own, axis, stands[axis]) for own, axis in each(rig)}
    if "" in known:
        return {"commissioning": known[""]}
    demanded = any(one["demanded"] for one in known.values())
    # The oldest date counts; none if any axis has none.
    dates = {name: min(one[name] for one in known.values()) for name in STEPS}
    common = {"demanded": demanded, "virtual": not demanded, **dates}
    return {"commissioning": {**common, "axes": known}}


def inconclusive(rig: RigFile | AxesRig, rig_path: Path) -> list[str]:
    """Return the sensors without an actuator that every polarity check leaves undetermined.

    Each axis may move a sensor so little, compared with what the axes read, that a wrong sign or a
    factor of 2 would pass; but not all axes may. Nothing is said before every axis has passed. If
    there are real drives, only their checks count: a virtual rig beside them, which needs none,
    moves nothing that a sensor could see.

    Returns:
        A sentence for each sensor, with the remedy.

    Raises:
        InputError: a certificate cannot be read.
    """
    if not isinstance(rig, AxesRig) or not rig.lone_sensors:
        return []
    axes = each(rig)
    count = [(own, axis) for own, axis in axes if _is_real(own)] or axes
    held = [find(own, rig_path, axis)[0] for own, axis in count]
    passed = [one.steps["polarity"] for one in held if one is not None and one.date_of("polarity")]
    if len(passed) < len(count):
        return []
    shown = {name for step in passed for name in _conclusive(step)}
    return [
        f"sensor {one.name}: no axis moved it enough, compared with what the axes read, to show a "
        "wrong sign, a factor of 2 of its scale, or that it reads too late: repeat the polarity "
        f"check with a larger distance (`rthyb commission {rig_path} --steps polarity --distance "
        "...`), or record it as an extra channel alone, without [[sensor]]"
        for one in rig.lone_sensors
        if one.name not in shown
    ]


def _unwatched(rig: RigFile | AxesRig, stands: dict[str, Standing]) -> list[str]:
    """Return the sensors without an actuator of which a frozen or jumping reading is not seen."""
    if not isinstance(rig, AxesRig):
        return []
    view = rig.of_axis(rig.names[0])
    found = []
    for one in view.one_of.sensors if view.one_of is not None else ():
        noise = [_rest_noise(own.holds, one.sensor.name) for own in stands.values()]
        known = max((value for value in noise if value is not None), default=None)
        why = sensor_noise.unwatched(one.sensor, beside.step_of(view, one), known)
        found += [f"sensor {one.sensor.name}: {why}"] if why else []
    return found


def _rest_noise(holds: Certificate | None, sensor: str) -> float | None:
    """Return the noise of a sensor that the link check of an axis has measured, if it has any."""
    step = None if holds is None else holds.steps.get("link")
    seen = None if step is None else step.figures.get("sensors")
    own = seen.get(sensor) if isinstance(seen, dict) else None
    noise = own.get("noise") if isinstance(own, dict) else None
    return noise if isinstance(noise, float) else None


def _conclusive(step: CheckedStep) -> list[str]:
    """Return the sensors of which a polarity check would have shown a wrong sign or scale."""
    seen = step.figures.get("sensors")
    found = seen.items() if isinstance(seen, dict) else ()
    return [name for name, one in found if isinstance(one, dict) and one.get("conclusive") is True]


def _joint(rig: RigFile) -> str:
    """Return what else the certificate of an axis with common sensors depends on, in words."""
    common = rig.one_of
    if common is None or not common.sensors:
        return ""
    return ", [[sensor]], [kinematics], link, calibration or sensors of another axis"


def _known(rig: RigFile, axis: str, found: Standing) -> dict[str, Any]:
    holds = found.holds
    dates = {name: holds.date_of(name) if holds is not None else "" for name in STEPS}
    return {
        "demanded": found.demanded,
        "virtual": not found.demanded,
        "rig_hash": rig_hash(rig, axis),
        **dates,
    }


def _is_real(rig: RigFile) -> bool:
    """Return whether a real drive is at the other end."""
    return rig.link is not None and not rig.link.virtual


def _why_not(
    rig: RigFile,
    rig_path: Path,
    holds: Certificate | None,
    older: Certificate | None,
    axis: str,
) -> str:
    of_axis = f" --axis {axis}" if axis else ""
    command = f"rthyb commission {rig_path}{of_axis}"
    remedy = f"run `{command}`"
    if holds is not None:
        names = ",".join(name for name in STEPS if not holds.date_of(name))
        reasons = ", ".join(holds.lacking)
        return (
            f"not every commissioning check of this rig has passed: {reasons}; run `{command} "
            f"--steps {names}`"
        )
    if older is not None and older.sample_rate_hz != rig.rate.whole_hz:
        return (
            f"the rig was commissioned on {older.date[:10]} at {older.sample_rate_hz} Hz, but is "
            f"now to run at {rig.rate.whole_hz} Hz (link.sample_rate_hz); {remedy}"
        )
    if older is not None:
        return (
            f"link, calibration, actuator, sensors{_joint(rig)} or limits have changed since the "
            f"rig was commissioned on {older.date[:10]}; {remedy}"
        )
    return (
        "this rig has not been commissioned: it has not been verified that its actuator moves in "
        f"the right direction; {remedy}, or set link.virtual = true if a virtual rig is at the "
        "other end"
    )
