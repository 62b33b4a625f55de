"""The state of the service as metrics in Prometheus' text format."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

_HELP: dict[str, tuple[str, str]] = {
    "rthyb_up": ("gauge", "1 while the service responds"),
    "rthyb_state": ("gauge", "1 for the current state"),
    "rthyb_ticks_total": ("counter", "Ticks since the service started"),
    "rthyb_ticks_skipped_total": ("counter", "Ticks that were not executed"),
    "rthyb_wake_late_seconds": ("gauge", "Wake-up latency of the tick thread"),
    "rthyb_displacement_metres": ("gauge", "Measured displacement of the last tick, after tare"),
    "rthyb_force_newtons": ("gauge", "Measured force of the last tick, after tare"),
    "rthyb_command_metres": ("gauge", "Command of the last tick"),
    "rthyb_alpha_samples": ("gauge", "Delay estimate"),
    "rthyb_wire_frames_total": ("counter", "Frames by outcome"),
    "rthyb_commands_sent_total": ("counter", "Commands sent"),
    "rthyb_commands_lost_total": ("counter", "Commands that the link did not accept"),
    "rthyb_recorder_up": ("gauge", "1 while the recorder responds"),
    "rthyb_recorder_behind_rows": ("gauge", "Rows waiting in the ring to be recorded"),
    "rthyb_recorder_missing_rows": ("gauge", "Rows of the current test that were lost"),
    "rthyb_recorder_free_bytes": ("gauge", "Free space on the disk of the recordings"),
    "rthyb_connections": ("gauge", "Clients of the control socket"),
}


def text(status: Mapping[str, Any]) -> str:
    """Return a status of the service in Prometheus' text format, with a line feed at its end."""
    lines = []
    name = ""
    for sample, labels, value in _samples(status):
        if sample != name:
            name = sample
            kind, help_text = _HELP[name]
            lines += [f"# HELP {name} {help_text}", f"# TYPE {name} {kind}"]
        lines.append(f"{name}{_labels(labels)} {value!r}")
    return "\n".join(lines) + "\n"


def _labels(labels: Mapping[str, str]) -> str:
    escaped = {
        key: value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
        for key, value in labels.items()
    }
    inner = ",".join(f'{key}="{value}"' for key, value in escaped.items())
    return f"{{{inner}}}" if inner else ""


def _samples(status: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, str], float]]:
    yield "rthyb_up", {"version": status["version"], "rig": status["rig"]}, 1
    for state in status["states"]:
        yield "rthyb_state", {"state": state}, int(state == status["state"])
    ticks, recorder = status["ticks"], status["recorder"]
    yield "rthyb_ticks_total", {}, ticks["elapsed"]
    yield "rthyb_ticks_skipped_total", {}, ticks["skipped"]
    for percent in ("50", "99"):
        labels = {"quantile": f"0.{percent.rstrip('0')}"}
        yield "rthyb_wake_late_seconds", labels, status["wake"][f"p{percent}_ns"] / 1e9
    axes = status.get("axes") or {}
    # For one axis without a label; for several, each with its name.
    values = [({"axis": name}, one) for name, one in axes.items()] or [({}, status["newest"] or {})]
    for sample, key in (
        ("rthyb_displacement_metres", "x_meas_m"),
        ("rthyb_force_newtons", "f_meas_n"),
        ("rthyb_command_metres", "x_cmd_m"),
        ("rthyb_alpha_samples", "alpha"),
    ):
        for labels, one in values:
            if one.get(key) is not None:
                yield sample, labels, one[key]
    wires = [({"axis": name}, one["wire"]) for name, one in axes.items()] or [({}, status["wire"])]
    for labels, wire in wires:
        for kind, count in wire.items():
            yield "rthyb_wire_frames_total", {**labels, "kind": kind}, count
    yield "rthyb_commands_sent_total", {}, status["loop"]["sent"]
    yield "rthyb_commands_lost_total", {}, status["loop"]["not_sent"]
    yield "rthyb_recorder_up", {}, int(recorder["alive"])
    if recorder["alive"]:
        lost = sum(last - first + 1 for first, last in recorder["missing_rows"])
        yield "rthyb_recorder_behind_rows", {}, recorder["behind_rows"]
        yield "rthyb_recorder_missing_rows", {}, lost
        yield "rthyb_recorder_free_bytes", {}, recorder["free_bytes"]
    yield "rthyb_connections", {}, status["connections"]
