"""``rthyb identify``: delay, gain, stiffness and noise of a rig."""

from __future__ import annotations

import contextlib
import datetime
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated

import typer

from rthyb_rt.cli import interrupts, quantities, terminal
from rthyb_rt.cli.connecting import Within, connected, connected_axes, load_axes_rig, load_rig
from rthyb_rt.cli.folders import publish, staged
from rthyb_rt.cli.inputs import JsonOption, RigSetOption
from rthyb_rt.cli.quantities import Allowed

if TYPE_CHECKING:
    from rthyb_rt.config import AxesRig, Rate, RigFile
    from rthyb_rt.rig.identification import IdentificationResult, SweepPlan
    from rthyb_rt.rig.identify_axes import AxesResult

SCHEMA = "rthyb-identify/1"


def identify(
    rig: Annotated[
        str,
        typer.Argument(
            metavar="RIG",
            help="Rig file or name of a shipped rig; it does not need an elastic stiffness.",
            show_default=False,
        ),
    ],
    amplitude: Annotated[
        str,
        typer.Option(
            metavar="LENGTH",
            help="Amplitude of the slow sine waves, 0.01 mm to 1 m; fast ones are smaller.",
        ),
    ] = "2 mm",
    max_frequency: Annotated[
        str,
        typer.Option(
            metavar="FREQUENCY", help="Frequency of the last sine wave, 0.05 Hz to 100 Hz."
        ),
    ] = "10 Hz",
    max_velocity: Annotated[
        str,
        typer.Option(
            metavar="VELOCITY",
            help="Largest velocity of a sine wave, 0.1 mm/s to 10 m/s; the amplitude of faster "
            "ones is reduced, and a note says so.",
        ),
    ] = "50 mm/s",
    settings: RigSetOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Rig file to write, instead of runs/identify-RIG-UTC/rig.toml. An existing "
            "file is replaced.",
            show_default=False,
        ),
    ] = None,
    realtime: Annotated[
        bool,
        typer.Option(
            "--realtime",
            help="Use the rig at the other end of the rig file's [link], under all its limits; "
            "without a [link], a virtual rig in a separate process.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure delay, gain, stiffness and noise of a rig.

    The rig first rests, then follows slow to fast sine waves without compensation. This gives the
    delay estimate with which a test starts, the elastic stiffness that bounds the tangent
    stiffness, and the noise at rest, which the estimator must not mistake for motion.

    A rig of several axes is swept axis by axis while the others hold still: it gets the matrix of
    their frequency responses, which a compensation by matrices needs, and a stiffness matrix.

    With --realtime the actuator moves. The rig must have passed every check of `rthyb commission`;
    otherwise the exit code is 5 and the message says what is missing. Ctrl-C brings the actuator
    to rest; a second Ctrl-C trips.

    \b
    Examples:
      rthyb identify shaking-table-portal-frame
      rthyb identify my-rig.toml --amplitude "1 mm" --out my-rig-identified.toml
      rthyb identify my-rig.toml --realtime --amplitude "0.5 mm" --out my-rig-identified.toml
    """
    from rthyb_rt.config import STANDARD
    from rthyb_rt.rig.identification import SweepPlan, identified_rig, identify_live
    from rthyb_rt.rig.identification import identify as sweep_rig

    sweep = SweepPlan.up_to(
        quantities.read(max_frequency, "--max-frequency", FREQUENCY),
        quantities.read(amplitude, "--amplitude", AMPLITUDE),
        quantities.read(max_velocity, "--max-velocity", VELOCITY),
    )
    several = load_axes_rig(rig, settings)
    if several is not None:
        _identify_axes(*several, sweep, out, realtime=realtime, as_json=as_json)
        return
    given, given_path = load_rig(rig, settings)
    if realtime:
        from rthyb_rt.rig.commissioning import certificate

        # A sweep moves farther and faster than a jog, so the signs must have been checked.
        certificate.demand(given, given_path)
    started = datetime.datetime.now(datetime.UTC)
    with contextlib.ExitStack() as stack:
        within = Within(given, "", None, given_path)
        connection = stack.enter_context(connected(within)) if realtime else None
        rate = given.rate if realtime else STANDARD
        progress = stack.enter_context(
            terminal.progress("Identifying", sweep.ticks_at(rate), rate.hz)
        )
        if connection is None:
            result = sweep_rig(given, sweep, progress)
        else:
            result = identify_live(connection, sweep, progress)
    filled = identified_rig(given, result)
    path, paths = _kept(filled, result, started, out)
    if realtime:
        certificate.carry(given, given_path, path)
    file = terminal.people(as_json)
    _print_result(given, result, file)
    _note_rate(rate, file)
    print(f"\nRig file  {path}", file=file)
    for name, kept in paths.items():
        print(f"{name.capitalize():10}{kept}", file=file)
    print(f"Next      rthyb run TEST.toml --rig {path}", file=file)
    if as_json:
        written = {"rig": str(path)} | {name: str(kept) for name, kept in paths.items()}
        terminal.print_json(
            {"schema": SCHEMA, "rig_name": given.rig.name, **result.as_json(), "paths": written}
        )


def _kept(
    filled: RigFile, result: IdentificationResult, started: datetime.datetime, out: Path | None
) -> tuple[Path, dict[str, Path]]:
    """Write the rig file, the recording of the sweep and its Bode plot; return the paths.

    Without ``out`` they are in a new folder, otherwise sweep and plot are beside the rig file.
    """
    from rthyb_rt import config

    if out is not None:
        path = _written(config.dump(filled), filled.rig.name, started, out)
        beside = path.with_suffix("")
        return path, _sweep_kept(filled, result, beside.parent, f"{beside.name}-")
    target = Path("runs") / f"identify-{filled.rig.name}-{started:%Y%m%dT%H%M%SZ}"
    with staged(target) as stage:
        (stage / "rig.toml").write_text(config.dump(filled), encoding="utf-8")
        paths = _sweep_kept(filled, result, stage, "")
        folder = publish(stage, target, numbered=True)
    return folder / "rig.toml", {name: folder / path.name for name, path in paths.items()}


def _sweep_kept(
    filled: RigFile, result: IdentificationResult, folder: Path, before: str
) -> dict[str, Path]:
    from rthyb_rt.record import recording

    assert result.recording is not None
    paths = {"sweep": folder / f"{before}{recording.FILE_NAME}"}
    recording.write(paths["sweep"], result.recording)
    try:
        from rthyb_rt.config import Rate
        from rthyb_rt.report.bode import bode
        from rthyb_rt.report.publication import save
    except ImportError:
        return paths  # without matplotlib
    paths["bode"] = folder / f"{before}bode.svg"
    plate = bode(filled, result.tones, Rate(result.sample_rate_hz))
    save(plate.figure, paths["bode"], "svg")
    return paths


def _written(text: str, name: str, started: datetime.datetime, out: Path | None) -> Path:
    """Write a rig file to the given path or to a new folder; return its path."""
    from rthyb_rt.record.recording import replacing

    if out is None:
        target = Path("runs") / f"identify-{name}-{started:%Y%m%dT%H%M%SZ}"
        with staged(target) as stage:
            (stage / "rig.toml").write_text(text, encoding="utf-8")
            return publish(stage, target, numbered=True) / "rig.toml"
    with replacing(out) as temporary:
        temporary.write_text(text, encoding="utf-8")
    interrupts.wrote(out)
    return out


def _identify_axes(
    rig: AxesRig,
    rig_path: Path,
    sweep: SweepPlan,
    out: Path | None,
    *,
    realtime: bool,
    as_json: bool,
) -> None:
    from rthyb_rt import config
    from rthyb_rt.config import STANDARD
    from rthyb_rt.rig import identify_axes
    from rthyb_rt.rig.commissioning import certificate
    from rthyb_rt.rig.identify_axes_live import identify_axes_live

    if realtime:
        # As for one axis: the signs must have been checked.
        certificate.demand(rig, rig_path)
    started = datetime.datetime.now(datetime.UTC)
    with contextlib.ExitStack() as stack:
        connection = stack.enter_context(connected_axes(rig)) if realtime else None
        rate = rig.rate if realtime else STANDARD
        ticks = sweep.ticks_at(rate) * len(rig.axis)
        progress = stack.enter_context(terminal.progress("Identifying", ticks, rate.hz))
        if connection is None:
            result = identify_axes.identify_rig(rig, sweep, progress)
        else:
            result = identify_axes_live(connection, sweep, progress)
    filled = identify_axes.identified_rig(rig, result)
    path = _written(config.dump(filled), rig.rig.name, started, out)
    if realtime:
        certificate.carry(rig, rig_path, path)
    file = terminal.people(as_json)
    _print_axes(rig, result, file)
    _note_rate(rate, file)
    print(f"\nRig file  {path}\nNext      rthyb run TEST.toml --rig {path}", file=file)
    if as_json:
        about = {"schema": SCHEMA, "rig_name": rig.rig.name}
        terminal.print_json({**about, **result.as_json(filled), "paths": {"rig": str(path)}})


def _print_axes(rig: AxesRig, result: AxesResult, file: IO[str]) -> None:
    from rthyb_rt.core import FS_HZ
    from rthyb_rt.numbers import number, quantity

    kind = f"{len(rig.axis)} axes: {', '.join(rig.names)}"
    print(f"{rig.rig.name}: {rig.rig.description or kind}\n", file=file)
    grid = terminal.ruled_table()
    grid.add_column("frequency, Hz", justify="right")
    pairs = [(row, column) for column in rig.names for row in rig.names]
    for row, column in pairs:
        grid.add_column(f"{row} by {column}", justify="right")
    for f_hz, matrix in zip(
        result.response.frequency_hz.tolist(), abs(result.response.response), strict=True
    ):
        grid.add_row(f"{f_hz:g}", *(f"{value:.4f}" for value in matrix.T.reshape(-1)))
    terminal.show(grid, file)
    print("", file=file)
    rows = []
    for name, own in zip(rig.names, result.axes, strict=True):
        delay = f"{number(own.delay_s * 1e3, 4)} ms ({number(own.delay_s * FS_HZ, 4)} samples)"
        rows += [
            (f"α of {name}", quantity(own.alpha, "samples", digits=4), "initial delay estimate"),
            (f"Delay of {name}", delay, f"gain {number(own.gain, 4)}, mean of the slow sines"),
            (f"Noise of {name}", f"{quantity(own.rest_noise_m, 'µm', 1e6)}, "
             f"{quantity(own.rest_noise_n, 'N')}", "standard deviation at rest"),
        ]  # fmt: skip
    for name, values in zip(rig.directions, result.stiffness.tolist(), strict=True):
        stiffness = ", ".join(number(value, 4) for value in values)
        rows.append(
            (f"Stiffness of {name}", stiffness, f"by {', '.join(rig.directions)}; SI units")
        )
    unlike = f"{100 * result.asymmetry:.2g} %"
    rows.append(("Asymmetry", unlike, "of the measured stiffness; the mean is written"))
    terminal.print_table(rows, file)
    for name, own in zip(rig.names, result.axes, strict=True):
        for note in own.notes:
            print(f"Note: axis {name}: {note}", file=file)


FREQUENCY = Allowed("Hz", "Hz", 0.05, 100.0, "a frequency from 0.05 Hz to 100 Hz", "5 Hz")
# The lower bound refuses 0.002, a length in metres given without its unit.
AMPLITUDE = Allowed("m", "mm", 1e-5, 1.0, "a length from 0.01 mm to 1 m", "1 mm")

VELOCITY = Allowed("m/s", "mm/s", 1e-4, 10.0, "a velocity from 0.1 mm/s to 10 m/s", "50 mm/s")


def _note_rate(rate: Rate, file: IO[str]) -> None:
    """State the length of a sample if the sweep had another rate."""
    if rate.pace != 1.0:
        print(
            f"Note: the sweep ran at {rate.hz:g} Hz, but samples are of 1/1024 s here, as in "
            "every rig file, and the frequency response in the rig file is for commands held "
            "for 1/1024 s",
            file=file,
        )


def _link_rows(result: IdentificationResult) -> list[tuple[str, str, str]]:
    if result.link_delay_samples is None:
        return []
    share = f"{result.link_delay_samples:.2f} samples"
    rows = [("of which the link", share, "by the echo in the drive's frames")]
    if result.left_out:
        rows.append(("Left out", f"{result.left_out} samples", "without a new reading"))
    return rows


def _print_result(rig: RigFile, result: IdentificationResult, file: IO[str]) -> None:

    from rthyb_rt.core import FS_HZ
    from rthyb_rt.numbers import number, quantity

    print(f"{rig.rig.name}: {rig.rig.description or rig.actuator.kind}\n", file=file)
    grid = terminal.ruled_table()
    for head in ("frequency, Hz", "amplitude, mm", "gain", "delay, ms", "delay, samples"):
        grid.add_column(head, justify="right")
    for tone in result.tones:
        grid.add_row(
            f"{tone.frequency_hz:g}", number(tone.amplitude_m * 1e3), f"{tone.gain:.4f}",
            f"{tone.delay_s * 1e3:.2f}", f"{tone.delay_s * FS_HZ:.2f}",
        )  # fmt: skip
    terminal.show(grid, file)
    print("", file=file)
    mass = "too small to tell"
    if result.moving_mass_kg is not None:
        mass = quantity(result.moving_mass_kg, "kg")
    resonance = f"none up to {result.tones[-1].frequency_hz:g} Hz"
    if result.resonance_hz is not None:
        resonance = quantity(result.resonance_hz, "Hz")
    delay = f"{number(result.delay_s * 1e3, 4)} ms ({number(result.delay_s * FS_HZ, 4)} samples)"
    slow = "mean of the slow sines"
    terminal.print_table(
        [
            ("α", quantity(result.alpha, "samples", digits=4), "initial delay estimate of a test"),
            ("α with β", quantity(result.alpha_with_beta, "samples", digits=4), "whole sweep"),
            ("β", quantity(result.beta, "samples²", digits=4), "curvature term, whole sweep"),
            ("Delay", delay, slow),
            *_link_rows(result),
            ("Gain", number(result.gain, 4), slow),
            ("Elastic stiffness k_e", quantity(result.k_e_n_per_m, "kN/m", 1e-3, 4),
             "bound of the tangent stiffness"),
            ("First resonance", resonance, "of actuator and specimen; laws roll off below it"),
            ("Moving mass", mass, "on the load cell, in addition to the specimen"),
            ("Noise at rest", f"{quantity(result.rest_noise_m, 'µm', 1e6)}, "
             f"{quantity(result.rest_noise_n, 'N')}", "standard deviation"),
            ("Offset at rest", f"{quantity(result.offset_m, 'µm', 1e6)}, "
             f"{quantity(result.offset_n, 'N')}", "mean; zeroing removes it before every test"),
        ],
        file,
    )  # fmt: skip
    for note in result.notes:
        print(f"Note: {note}", file=file)
