"""Write the tables of docs/file-formats.md from the program itself.

What a key is called, its unit, default and range stand in the models of `rthyb_rt.config`, the
fields of a recording in `rthyb_rt.record.recording`. Between a pair of markers in the page

    <!-- generated: NAME -->  ...  <!-- end -->

stands what this script prints for that name; ``python docs/tools/key_tables.py`` renews it.
"""

from __future__ import annotations

import re
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from pydantic.fields import FieldInfo

from rthyb_rt import core
from rthyb_rt.config import (
    axesfile,
    baselinefile,
    deriving,
    lawtables,
    limits,
    rigfile,
    rigsettings,
    testfile,
)
from rthyb_rt.config.fields import Count, Names, OneOf, Range, Sign, Table, Text
from rthyb_rt.config.numerical import Labels, Numbers, Place, Square
from rthyb_rt.config.own_tables import NamedParameters, Settings
from rthyb_rt.config.prescribed_history import Amplitudes, CycleCounts
from rthyb_rt.config.structures import Counts, Each, Terms
from rthyb_rt.core.laws import LAWS, parameters
from rthyb_rt.record import recording

PAGE = Path(__file__).resolve().parents[1] / "file-formats.md"
_PART = re.compile(r"(<!-- generated: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)

MEANINGS: dict[str, str] = {
    "GroundMotionTable.format": 'format of the file; "auto" detects it from the content',
    "GroundMotionTable.record": "name of a built-in record, or path of a file; a relative path is "
    "relative to the folder of the test file",
    "GroundMotionTable.units": "unit of the file's numbers, if the file does not state it",
    "GroundMotionTable.channel": "number, or part of the name, of one component of several",
    "GroundMotionTable.interpolation": "how the record is resampled to the test's rate",
    "Numerical.integrator": "integrator of the equation of motion",
    "LibraryFile.file": "the shared library; a relative path is relative to the folder of the test "
    "file",
    "FmuFile.file": "the FMU; a relative path is relative to the folder of the test file",
    "FmuFile.force": "input that gets the measured force; with several interfaces one for each",
    "FmuFile.displacement": "output that the actuator follows",
    "FmuFile.ground_acceleration": "input that gets the ground acceleration; absent: none",
    "Matrices.m_kg": "masses of the degrees of freedom",
    "Matrices.k_n_per_m": "stiffnesses between them",
    "Matrices.c_n_s_per_m": "damping coefficients between them",
    "Matrices.damping_ratios": "instead: ratio of each mode of the whole structure, lowest first, "
    "or one for all",
    "Matrices.influence": "displacements for a unit displacement of the ground; absent: 1 each",
    "Matrices.labels": "names of the degrees of freedom; absent: 1, 2, ...",
    "Matrices.interface": "the degree of freedom to which the specimen is attached",
    "Matrices.integrator": "integrator of the equation of motion",
    "Matrices.force_delay_samples": "1: the force is used one sample later",
    "MatrixFile.file": ".npz or .mat with all matrices; a relative path is relative to the "
    "folder of the test file",
    "MatrixFile.data": "contents of the files; written by the program into recordings, not for "
    "test files",
    "MatrixFile.direction": "which influence vector is used, if the file has several",
    "MatrixFiles.mass": "masses, .mtx or .csv",
    "MatrixFiles.stiffness": "stiffnesses",
    "MatrixFiles.damping": "damping coefficients",
    "MatrixFiles.labels": "names of the degrees of freedom, one per line",
    "MatrixFiles.influence": "displacements for a unit displacement of the ground, .mtx or .csv",
    "Damping.modes": "the numbers of the modes",
    "Nonlinear.storeys": "the storeys",
    "Storeys.p_delta": "true: include the P-delta effect of the weight above each storey",
    "Damping.form": "Rayleigh damping, of one or two modes, or modal damping of those named",
    "Nonlinear.dof": "between this degree of freedom of the matrices and the ground",
    "Nonlinear.between": "between these two degrees of freedom of the matrices",
    "Nonlinear.beside": "true: in addition to the storey's stiffness, not in its place",
    "Interface.dof": "the degree of freedom, or a combination",
    "Interface.number": "number of the interface of your own numerical part",
    "TakenOut.mass_kg": "the specimen's mass",
    "TakenOut.damping_n_s_per_m": "the specimen's damping",
    "TakenOut.stiffness_n_per_m": "the specimen's stiffness; absent: $k_e$",
    "DelayEstimator.enabled": "false: the control law learns nothing; alpha stays at alpha0",
    "RfcTable.enabled": "false: the measured force enters the equation of motion uncorrected",
    "RfcTable.tangent": 'formula; absent: "mean-of-ratios" for "paper", else "least-squares"',
    "RfcTable.divisor": "by what Eqn 3.3 divides its T0 + 1 terms: T0, or their number",
    "RfcTable.cutoff_hz": "cut-off of the low-pass on $x_c - x_m$, below half of the sample rate; "
    "0: none; absent: the rig's `identified.roll_off_hz`, except for `paper`; else 0",
    "RfcTable.force_lateness_s": "delay, relative to $x_m$, of the force used in the equation of "
    "motion; absent: computed from integrator and `force_delay_samples` if the rig has a "
    "`roll_off_hz` and the law is not `paper`; otherwise 0",
    "Controller.type": "which control law, see below and tuning",
    "Controller.plc_enabled": "false: no delay compensation (force compensation alone)",
    "Reference.table_forces": "true: the reference has the table's mass and friction as well",
    "RigInfo.load_cell": "what the load cell carries: table and specimen, or the specimen alone",
    "RigInfo.command_hold": "whether the drive holds each command or interpolates to it linearly",
    "Limit.enable": "false: the limit is ignored",
    "Limit.action": "what happens beyond it",
    "TestInfo.name": "name of the test; its run's folder begins with it",
    "TestInfo.duration_s": "length of the test; absent: duration of ground motion plus free "
    "vibration",
    "GroundMotionTable.pga_g": "peak to which the record is scaled",
    "GroundMotionTable.factor": "instead of `pga_g`: factor by which the record is multiplied",
    "GroundMotionTable.duration_s": "length taken; absent: to the end",
    "Numerical.mass_kg": "computed mass; the ground motion acts on it",
    "Numerical.period_s": "instead of the mass: period of the whole structure",
    "Numerical.damping_n_s_per_m": "computed damping",
    "Numerical.damping_ratio": "instead: the same as a fraction of critical",
    "Numerical.rho_inf": "spectral radius at infinite frequency; kr-alpha only",
    "RfcTable.window_periods": f"window T0 in periods; absent: {deriving.DEFAULT_WINDOW_PERIODS:g}",
    "RfcTable.window_s": "instead: window T0 in seconds",
    "RfcTable.window_samples": "instead: window T0 in samples",
    "Limits.command_position_m": "size of the compensated command",
    "Limits.command_velocity_m_per_s": "its velocity; a plain number only limits the command",
    "Limits.command_acceleration_m_per_s2": "acceleration to which the command is limited",
    "Limits.command_increment_m": "change of the command as sent from sample to sample",
    "Limits.force_n": "size of the measured force",
    "Limits.tracking_error_m": "size of measured displacement minus command",
    "Limits.tracking_indicator_slope_m2_per_s": "slope of the tracking indicator, mean of 0.25 s",
    "Limits.energy_error_j": "energy that the tracking error has fed in",
    "Limits.sensor_stuck_s": "time for which the displacement does not change while the command "
    "moves",
    "Limits.sensor_stuck_samples": "deprecated: the same in samples of 1/1024 s",
    "Limits.sensor_jump_m": "change of the measured displacement from sample to sample",
    "Limits.force_stuck_s": "time for which the force does not change while the command moves",
    "Limits.force_stuck_samples": "deprecated: the same in samples of 1/1024 s",
    "Limits.force_jump_n": "change of the measured force from sample to sample",
    "Limits.lost_pairs_share": "share of the last second's ticks without a usable pair",
    "Limits.lost_pairs_warning_share": "the same, for a warning",
    "Limits.skipped_ticks_share": "share of the last second's ticks that were skipped",
    "Limits.skipped_ticks_warning_share": "the same, for a warning",
    "Limits.path_velocity_m_per_s": "velocity on the way back of ramp-out and resume; absent: "
    f"{limits.DEFAULT_PATH_VELOCITY_M_PER_S:g}, at most half the command's limit",
    "Limits.path_acceleration_m_per_s2": "acceleration of ramps and resume; absent: "
    f"{limits.DEFAULT_PATH_ACCELERATION_M_PER_S2:g}, at most half the command's limit",
    "Limits.brake_acceleration_m_per_s2": "how hard HOLD and ramp-out brake; absent: "
    f"{limits.BRAKE_MARGIN:g} times the reference's peak acceleration, at least that of paths, at "
    "most half the command's limit",
    "Limits.ramp_in_s": f"duration of the ramp-in; absent: {limits.DEFAULT_RAMP_IN_S:g}",
    "Limits.armed_timeout_s": "time after which ARMED ends automatically; absent: "
    f"{limits.DEFAULT_ARMED_TIMEOUT_S:g}",
    "Limits.tare_s": f"averaging time of zeroing; absent: {limits.DEFAULT_TARE_S:g}",
    "Limits.rest_spread_m": "movement at rest that zeroing tolerates; absent: "
    f"{limits.REST_SPREAD_SIGMAS} times the noise at rest, at least "
    f"{limits.LEAST_REST_SPREAD_M:g}",
    "Limits.tare_share_most": "largest tare, as a share of the rig's own limit; absent: "
    f"{limits.DEFAULT_TARE_SHARE_MOST:g}",
    "BaselineFile.schema": "first line of the file",
    "BaselineFile.family": "what drives the specimen: an actuator, moving ground, a known force, "
    "or a closed hybrid test",
    "BaselineFile.command_hold": "the command is held between rows, or interpolated linearly",
    "BaselineController.plc_w1": "weighting W1 of the phase-lead compensator; with W2, needed to "
    "reconstruct what the compensator did",
    "BaselineController.rfc": "true: the measured force was compensated",
    "BaselineController.adaptive": "true: the delay was estimated during the test",
    "LinkTable.kind": "type of connection",
    "LinkTable.channel": "CAN interface (`can0`), path of the serial line (`/dev/ttyUSB0`) or of "
    "the socket, channel of python-can",
    "LinkTable.interface": "only for python-can, where it is required: name of its interface",
    "LinkTable.bitrate": "CAN: bit/s, 10000 to 1000000, absent: not checked; serial: baud, absent: "
    f"{rigfile.DEFAULT_BAUD}; socket: none",
    "LinkTable.fd": "true: the bus is CAN FD",
    "LinkTable.data_bitrate": "CAN FD: bit/s in the data phase of frames that switch bit rate: the "
    "feedback frames of a DBC file, or with `ids` all frames; absent: no frame does",
    "LinkTable.ids": "CAN: identifiers of the program's own frames",
    "IdentifiersTable.command": "of `ACT_CMD`, to the drive",
    "IdentifiersTable.displacement": "of `ACT_FB`, from the drive",
    "IdentifiersTable.force": "of `LC_FB`, from the drive",
    "LinkTable.dbc": "CAN: DBC file of the drive; a relative path is relative to the folder of the "
    "rig file; absent: `hw/rthyb.dbc`",
    "LinkTable.names": "names of signals that have other names in the DBC file",
    "LinkTable.clock": "what a tick waits for: this PC's clock, the feedback, or nothing",
    "LinkTable.sample_rate_hz": "rate at which the drive accepts commands and sends its readings",
    "LinkTable.lead_us": 'clock "link": how long before its tick the feedback arrives; absent: '
    "200, or 0.4 of the period if that is less",
    "LinkTable.require_realtime": "true: a test is refused without real-time priority and locked "
    "memory",
    "LinkTable.stop_decel_m_per_s2": "deceleration of the drive's own stop; used by the virtual "
    "drive",
    "LinkTable.virtual": "true: a virtual rig is at the other end; no commissioning is required",
    "DisplacementChannel.scale": "x = polarity · scale · wire + offset",
    "DisplacementChannel.polarity": "-1: the sensor's sign is reversed",
    "DisplacementChannel.offset_m": "displacement of the specimen for a 0 on the wire",
    "ForceChannel.scale": "f = polarity · scale · wire + offset",
    "ForceChannel.polarity": "-1: the load cell's sign is reversed",
    "ForceChannel.offset_n": "force on the specimen for a 0 on the wire",
    "Similitude.length": "displacement of the structure over that of the specimen",
    "Similitude.force": "force of the structure over that of the specimen",
    "RigInfo.name": "name of the rig",
    "RigInfo.assumed": 'keys whose values nobody stated, `"actuator.kp_per_s"`: they are those of '
    "another rig, and every command notes them; written by the program",
    "RigInfo.command_shift_s": "delay of the measured row behind the command row, in addition to "
    "the actuator's delay; negative: ahead of it",
    "BaselineFile.command_shift_s": "delay of the measured row behind the command row, in addition "
    "to the actuator's delay; negative: ahead of it",
    "FirstOrder.extra_delay_samples": "transport delay before the lag, samples",
    "ServoHydraulic.flow_limit_m_per_s": "largest velocity without load",
    "ServoValve.gain": "gain of the command in the drive's own loop",
    "ServoValve.valve_n_per_m_s3": "gain $a_1 b_0$ of the servo-valve",
    "ServoValve.valve_b1_per_s": "its denominator $s^2 + b_1 s + b_2$",
    "ServoValve.valve_b2_per_s2": "the same",
    "ServoValve.velocity_feedback_n_s_per_m2": "natural velocity feedback $a_2$",
    "ServoValve.leakage_per_s": "pole $a_3$ of the actuator",
    "ServoValve.command_range_m": "end of the drive's input; 0: none",
    "ServoValve.command_lsb_m": "step of the drive's input; 0: none",
    "ServoValve.loop_kp": "proportional gain of the drive's own displacement loop; if loop_kp and "
    "loop_ki_per_s are both 0, there is none",
    "ServoValve.loop_ki_per_s": "integral gain of that loop, by Tustin's rule at the test's rate",
    "ServoHydraulic.moving_mass_kg": "table, fixtures and piston",
    "StribeckElement.fs_n": "the static friction",
    "LugreElement.fs_n": "the static friction",
    "PowerDampingElement.at_m_per_s": "velocity at which the force is force_n; with 1, force_n is "
    "the coefficient C in N (s/m)^a",
    "DegradationElement.travel_m": "the travel over which it is lost; at least one of travel_m, "
    "work_j and amplitude_m is required; absent: not with travel",
    "DegradationElement.work_j": "the work of the loop over which it is lost; absent: not with "
    "work",
    "DegradationElement.amplitude_m": "the largest displacement over which it is lost; absent: "
    "not with amplitude",
    "RcColumnElement.pivot": "the pivot of unloading; 4 degrades strongly, 200 hardly at all",
    "TakedaElement.post_yield_ratio": "stiffness of first loading after yielding over that before; "
    "below 0 it softens",
    "TakedaElement.sharpness": "the sharpness of the corner of first loading at xy_m; 2 is round",
    "TakedaElement.unloading_exponent": "the power of xy over the largest displacement with which "
    "unloading softens; 0 does not soften",
    "TakedaElement.pinching": "where the corner of reloading lies between the direct line, 0, and "
    "the line of unloading, 1",
    "TakedaElement.pinching_level": "the force at that corner over the one that is aimed at",
    "TakedaElement.energy_j": "work after which 37 % of the strength is left",
    "TakedaElement.strength_down_over_up": "strength and stiffness downwards over those upwards",
    "TakedaElement.corner_on_line": "where that corner lies without pinching: on the direct line, "
    "1, or where the force became zero, 0",
    "PeakOrientedElement.exponent": "the power of reloading; 1 does not pinch",
    "PeakOrientedElement.backbone": "the power of first loading; 0 does not harden, 1 is straight",
    "RcColumnElement.ultimate_m": "displacement at which `strength_lost_at_ultimate` is reached",
    "RcColumnElement.energy_j": "work of the yielding part at which the two energy-dependent "
    "losses reach the values below",
    "RcColumnElement.strength_lost_at_ultimate": "share of strength lost at ultimate_m; the loss "
    "grows from yield",
    "RcColumnElement.strength_lost_with_energy": "share of strength lost at energy_j; the loss "
    "grows with the work",
    "RcColumnElement.stiffness_lost_with_energy": "share of unloading stiffness lost at "
    "energy_j, in the same way",
    "Identified.alpha": "delay in samples of 1/1024 s, as the compensator uses it; the next test's "
    "alpha0",
    "Identified.delay_s": "mean delay of the low-frequency sines of the identification",
    "ExtraSensor.gain": "its reading for 1 m, m/s, m/s^2 or N of that quantity; absent: that of a "
    "perfect sensor, if its unit is one of that quantity",
    "Identified.gain": "mean amplitude ratio of the low-frequency sines of the identification",
    "Identified.date": "date of the identification, string or TOML date",
    "Identified.frequency_hz": "frequencies of the sweep",
    "Identified.amplitude": "amplitude ratio at each",
    "Identified.delay_at_frequency_s": "delay at each",
    "Identified.force_in_phase_n_per_m": "force in phase with the displacement, divided by it, at "
    "each frequency",
    "Identified.force_in_quadrature_n_per_m": "the same for the force in quadrature",
    "Identified.command_amplitude_m": "amplitude of the command at each frequency; without it, "
    "`rthyb check` counts no damping of the specimen and the table",
    "MatrixLaw.inverse": "true: the inverse of the identified response is applied as well, and the "
    "matrices compensate what remains",
    "MatrixLaw.coupled": "false: diagonal matrices, each axis separately",
    "Axis.actuator": "as for a rig with one axis",
    "MatrixKinematics.interface": "names of the directions, the columns of the matrix",
    "MatrixKinematics.matrix": "displacement of each axis per unit displacement of the interface: "
    "rows are axes",
    "MatrixKinematics.rotations": "directions that are angles, in rad",
    "MatrixKinematics.forces": "force along each direction per unit force of each load cell: rows "
    "are directions; absent: the transposed matrix, for load cells in line with the axes",
    "MatrixKinematics.displacements": "displacement along each direction per unit displacement of "
    "each axis: rows are directions; absent: the (least-squares) inverse of the matrix",
    "LoneDisplacement.along": 'with kinematics of kind = "matrix", and required there: its reading '
    "for a unit of each direction; directions that are not listed do not move it",
    "LoneDisplacement.pin_m": 'with kinematics of kind = "pins", and required there: its pin on '
    "the coupler at rest, relative to the point that the interface moves",
    "LoneDisplacement.base_m": "with pins: the point from which it measures; absent: direction",
    "LoneDisplacement.direction": "with pins: direction from the base to the pin, for a base that "
    "is far away",
    "LoneDisplacement.pulls": "with pins: true: shortening is positive",
    "LoneDisplacement.extra": "name of the `[[axis.sensors.extra]]`, in m, that has its reading in "
    "real time; required there, with the range",
    "LoneForce.extra": "name of the `[[axis.sensors.extra]]`, in N, that has its reading in real "
    "time; required there, with the range",
    "LoneDisplacement.stuck_s": "time for which it may repeat its reading while the command moves",
    "LoneDisplacement.jump_m": "change of its reading in 1/1024 s",
    "LoneDisplacement.disagreement_m": "difference from what the other displacement sensors imply",
    "LoneForce.along": "share of the specimen's force in each direction that it carries",
    "LoneForce.stuck_s": "time for which it may repeat its reading while the command moves",
    "LoneForce.jump_n": "change of its reading in 1/1024 s",
    "LoneForce.disagreement_n": "difference from what the other load cells imply",
    "PinKinematics.interface": "coordinates of the coupler in its plane; the others stay 0",
    "PinKinematics.pins_m": "pin of each axis at rest, relative to the point that the "
    "interface moves",
    "PinKinematics.bases_m": "base of each axis",
    "PinKinematics.directions": "direction from the base to the pin, for a base that is far away",
    "PinKinematics.pulls": "axes whose positive direction is shortening",
    "PinKinematics.cell_forces": "force along each direction by which 1 N more than expected at "
    "each load cell without an actuator corrects what follows from the axes: rows are directions",
    "JointSpecimen.stiffness": "elastic force per unit displacement of the interface",
    "JointSpecimen.damping": "force per unit velocity; absent: none",
    "JointSpecimen.mass": "force per unit acceleration; absent: none",
    "JointSpecimen.attachment_stiffness_n_per_m": "required if there are more axes than "
    "directions, and only then: stiffness of each actuator's attachment to the specimen",
    "Plant.file": ".npz or .mat with a, b and c; a relative path is relative to the folder of the "
    "rig file",
    "Plant.a": "instead of the file: s' = a s + b u, time in s",
    "Plant.b": "u are the commands of the axes, in their order, m",
    "Plant.c": "x = c s are their displacements, m",
    "JointIdentified.real": "one matrix per frequency, reading over command; rows are readings",
    "JointIdentified.imaginary": "the same, its imaginary part",
    "JointIdentified.frequency_hz": "frequencies of the sweep",
    "JointIdentified.date": "date of the identification, string or TOML date",
    "TestFile.schema": "first line of the file",
    "RigFile.schema": "first line of the file",
    "SweepHistory.spacing": "whether the frequency rises by equal ratios or equal steps in equal "
    "times",
    "CyclesHistory.file": "instead: CSV file of amplitudes and cycles; a relative path is relative "
    "to the folder of the test file",
    "ExtraSensor.signal": "CAN with `link.dbc`: the signal in the DBC file, `Signal` or "
    "`FRAME.Signal`; absent: its name",
    "ExtraSensor.measures": "virtual rig: what it measures at the specimen",
    "TestFile.rig": "name of a shipped rig, or path of a rig file; a relative path is relative to "
    "the folder of the test file",
}
"""What a key is for, where its model does not say it in a range."""

ALLOWED: dict[str, str] = {
    "LoneDisplacement.along": "table of directions, each -1e6 to 1e6",
    "LoneDisplacement.pin_m": "`[x, y]`",
    "LoneDisplacement.base_m": "`[x, y]`",
    "LoneDisplacement.direction": "`[x, y]`",
    "LoneForce.along": "table of directions, each -1e6 to 1e6",
    "Nonlinear.between": "list of two labels",
}
"""What a key takes, where its model does not say it in a word."""

_TAGS = ("kind", "element")

FIELD_MEANINGS: dict[str, str] = {
    "tick": "n, counted from the first sample",
    "due_ns": "when the tick was due, from the start of the test",
    "wake_late_ns": "how long after that the tick woke; 0 in virtual time",
    "sent_late_ns": "how long after that the command was sent; 0 in virtual time",
    "flags": "properties of the sample, see below",
    "generation": "set of parameters in force",
    "state": "state of the test, see below",
    "echo": "low bits of the command number that the drive applied; 0 in virtual time",
    "count": "low bits of the drive's sample count; 0 in virtual time",
    "code": "status bits, see below",
    "cause": "cause latched after the tick, by its number in the attribute `causes`; 0: none",
    "missing": "consecutive samples without an accepted pair, including this one",
    "x_read_m": "displacement as received, accepted or not, calibrated, before the tare; NaN: the "
    "value received was not a number; 0: nothing was received",
    "f_read_n": "the same for the force",
    "ag_mps2": "ground acceleration at $t_n$",
    "x_num_m": "$x_c[n]$, command of the integration",
    "x_plc_m": "output of the control law for $t_n$",
    "x_cmd_m": "$x_p[n]$, the command as sent, after the limiter",
    "x_meas_m": "$x_m[n]$, measured displacement",
    "f_meas_n": "$f[n]$, measured force",
    "alpha": "delay that the control law reports after the update of tick n; NaN: it has none",
    "beta": "the same for its curvature term",
    "k_t_n_per_m": "tangent stiffness that the force compensation used",
    "energy_error_j": "running energy error",
    "tracking_indicator_m2": "running tracking indicator",
}


def tables() -> dict[str, str]:
    """Return every generated part of the page by its name."""
    parts: dict[str, str] = {}
    for prefix, file in (
        ("test", testfile.TestFile),
        ("rig", rigfile.RigFile),
        ("baseline", baselinefile.BaselineFile),
    ):
        for key, models in _sections(file):
            if key.startswith("controller.axis"):
                continue  # the keys of [controller]
            parts[f"{prefix}.{key}"] = _choices(models) if len(models) > 1 else _table(models[0])
    parts |= {f"axes.{key}": text for key, text in _of_axes().items()}
    # The same keys as those of the displacement sensor.
    command = parts["rig.calibration.command"].replace(
        "wire + offset |", "wire + offset, for the command |"
    )
    parts["rig.calibration.command"] = command.replace("the sensor's sign", "the command's sign")
    del parts["rig.limits"]  # the test file's
    del parts["test.numerical.nonlinear.law"]  # the rig file's specimen
    parts = {name.replace(" MatrixFile", ".from-a-file"): text for name, text in parts.items()}
    parts["test.controller.laws"] = _laws(parts)
    parts["test.limits.KEY"] = _table(limits.Limit)
    parts["samples"] = _samples()
    return parts


def _of_axes() -> dict[str, str]:
    """Return what a rig of several axes has beside the tables of one."""
    own = ("axis", "kinematics", "sensor", "specimen", "specimen.element", "plant", "identified")
    found = {key: models for key, models in _sections(axesfile.AxesRig) if key in own}
    return {
        key: _choices(models) if len(models) > 1 else _table(models[0])
        for key, models in found.items()
    }


def renewed(page: str, parts: dict[str, str]) -> str:
    """Return the text of a page with its generated parts as they should be."""
    return _PART.sub(lambda m: f"{m[1]}\n{parts[m[2]]}\n\n{m[3]}", page)


def names(page: str) -> list[str]:
    """Return the names of the generated parts of a page."""
    return [match[2] for match in _PART.finditer(page)]


def _laws(parts: dict[str, str]) -> str:
    """Return what laws there are, with the tables that are one law's own taken out of parts."""
    lines = ["| law | what it does |", "|---|---|"]
    lines += [f"| `{law.name}` | {law.meaning} |" for law in LAWS.values()]
    shared = ("", "delay_estimator")
    for table in sorted({t for t in lawtables.TABLES.values() if t not in shared}):
        lines += ["", f"#### `[controller.{table}]`", "", parts.pop(f"test.controller.{table}")]
    return "\n".join(lines)


def _of_laws(model: type[Table], key: str) -> str:
    """Return which laws read a key, where not all do that share its table, and where it is from."""
    table = lawtables.TABLES.get(model)
    users = [] if table is None else parameters().get(f"{table}.{key}".lstrip("."), [])
    if not users:
        return ""
    rig_key, standard = users[0][1].rig_key, users[0][1].default
    sharing = {law.name for name, all_of in parameters().items() for law, _ in all_of
               if name.rpartition(".")[0] == table}  # fmt: skip
    names = [law.name for law, _ in users]
    more = f" ({', '.join(f'`{name}`' for name in names)})" if set(names) != sharing else ""
    if rig_key == lawtables.RESPONSE:
        more += f"; absent: fitted to the response in the rig's `{rig_key}`"
    elif rig_key == rigsettings.ROLL_OFF:
        more += (
            f"; absent: derived from the rig's `{rig_key}`, if it has one, except with `paper`; "
        )
        more += f"otherwise {_number(standard)}"
    elif rig_key is not None:
        more += f"; absent: the rig's `{rig_key}`"
        more += "" if standard is None else f", else {_number(standard)}"
    return more


# ---- models -------------------------------------------------------------------------------------


def _sections(file: type[Table]) -> Iterator[tuple[str, list[type[Table]]]]:
    """Walk through a file's tables that hold plain values: ("controller.rfc", [RfcTable])."""
    yield "top", [file]
    yield from _inner(file, "")


def _inner(model: type[Table], prefix: str) -> Iterator[tuple[str, list[type[Table]]]]:
    for name, info in model.model_fields.items():
        found = [p for p in _parts(info.annotation) if _is_table(p) and not _is_limit(p)]
        tagged = [one for one in found if any(tag in one.model_fields for tag in _TAGS)]
        if len(found) > 1 and not tagged:
            # Forms of one table, told apart by their keys.
            yield prefix + name, found[:1]
            yield from ((f"{prefix}{name} {one.__name__}", [one]) for one in found[1:])
        elif found and (len(found) > 1 or _plain(found[0])):
            yield prefix + name, found
        for inner in found:
            yield from _inner(inner, f"{prefix}{name}.")


def _plain(model: type[Table]) -> list[str]:
    """Return the keys of a table that hold plain values or limits."""
    fields = model.model_fields.items()
    return [n for n, i in fields if not any(map(_is_section, _parts(i.annotation)))]


def _is_section(part: Any) -> bool:
    return _is_table(part) and not _is_limit(part)


def _is_limit(part: Any) -> bool:
    return _is_table(part) and issubclass(part, limits.Limit)


def _tag(model: type[Table]) -> str:
    for key in _TAGS:
        if key in model.model_fields:
            return str(typing.get_args(model.model_fields[key].annotation)[0])
    raise LookupError(f"{model.__name__} has no tag")


def _is_table(part: Any) -> bool:
    return isinstance(part, type) and issubclass(part, Table)


def _parts(annotation: Any) -> Iterator[Any]:
    """Walk through Annotated, unions and lists: types, and the ranges that annotate them."""
    if typing.get_origin(annotation) is Literal:
        yield annotation
        return
    if typing.get_origin(annotation) is typing.Annotated:
        first, *rest = typing.get_args(annotation)
        yield from _parts(first)
        yield from rest
        return
    inner = typing.get_args(annotation)
    if not inner:
        yield annotation
    for part in inner:
        yield from _parts(part)


def _table(model: type[Table]) -> str:
    """Return the keys of one table, those with plain values."""
    return "\n".join(
        ["| key | unit | default | allowed | meaning |", "|---|---|---|---|---|"]
        + [f"| {cells}" for cells in _rows(model)]
    )


def _choices(models: list[type[Table]]) -> str:
    """Return the keys of tables that stand for one another, told apart by ``kind`` or such."""
    lines = ["|  | key | unit | default | allowed | meaning |", "|---|---|---|---|---|---|"]
    for model in models:
        for index, cells in enumerate(_rows(model)):
            name = f"`{_tag(model)}`" if index == 0 else ""
            lines.append(f"| {name} | {cells}")
    return "\n".join(lines)


def _rows(model: type[Table]) -> Iterator[str]:
    for name in _plain(model):
        info = model.model_fields[name]
        if name in _TAGS and len(typing.get_args(info.annotation)) == 1:
            continue
        parts = [*_parts(info.annotation), *info.metadata]
        limits = [part for part in parts if _is_limit(part)]
        if limits:
            value = limits[0].model_fields["value"]
            parts = [*_parts(value.annotation), *value.metadata]
        yield _row(model, info.alias or name, info, parts)


def _row(model: type[Table], key: str, info: FieldInfo, parts: list[Any]) -> str:
    unit, allowed, meaning = "", "", ""
    for part in parts:
        if isinstance(part, Range):
            unit = part.unit
            allowed = (
                f"{'above ' if part.open_low else ''}{_number(part.low)} to "
                f"{'below ' if part.open_high else ''}{_number(part.high)}"
            )
            meaning = part.what
        elif isinstance(part, Count):
            allowed, meaning = f"whole, {part.low} to {part.high}", part.what
        elif isinstance(part, (Square, Numbers)):
            unit, meaning = part.each.unit, part.what
            each = f"{_number(part.each.low)} to {_number(part.each.high)}"
            rows = "rows or diagonal" if isinstance(part, Square) else "list"
            allowed = f"{rows}, each {each}"
        elif isinstance(part, (Labels, Place, Amplitudes, CycleCounts)):
            allowed, meaning = part.form, part.what
        elif isinstance(part, Each):
            unit, meaning = part.one.unit, part.one.what
            allowed = f"{_number(part.one.low)} to {_number(part.one.high)}, or a list"
        elif isinstance(part, Counts):
            allowed = f"list, whole, {part.one.low} to {part.one.high}"
            meaning = part.one.what
        elif isinstance(part, Terms):
            allowed, meaning = "list, label, or labels with weights", part.what
        elif isinstance(part, axesfile.MatrixOf):
            form = "symmetric" if part.symmetric else "square" if part.square else "equal"
            allowed = f"{form} rows, each -{_number(part.size)} to {_number(part.size)}"
        elif isinstance(part, axesfile.Point):
            unit = part.one.unit
            allowed = "table of axes, each `[x, y]`"
        elif isinstance(part, axesfile.Different):
            allowed = "list, different names"
        elif isinstance(part, Names):
            allowed, meaning = "list of different strings", part.what
        elif isinstance(part, (NamedParameters, Settings)):
            allowed, meaning = part.form, part.what
        elif isinstance(part, Sign):
            allowed, meaning = "1, -1", part.what
        elif isinstance(part, Text):
            allowed, meaning = _form(part), part.what
        elif typing.get_origin(part) is Literal:
            allowed = ", ".join(f'`"{word}"`' for word in typing.get_args(part))
        elif part is bool:
            allowed = "`true`, `false`"
    meaning = MEANINGS.get(_owner(model, key), meaning)
    allowed = ALLOWED.get(_owner(model, key), allowed)
    if model is limits.Limit and key == "value":
        allowed, meaning = "as its key", "the limit"
    if not meaning:
        raise LookupError(f"{model.__name__}.{key}: say in MEANINGS what it is for")
    meaning += _of_laws(model, key)
    origin = typing.get_origin(info.annotation)
    if origin is list and not allowed.startswith(("rows", "list")) and " rows" not in allowed:
        allowed = f"list, each {allowed}"
    elif origin is dict and not allowed.startswith("table"):
        words = [word for part in parts if isinstance(part, OneOf) for word in part.words]
        allowed = "table of " + ", ".join(f"`{word}`" for word in words)
    return f"`{key}` | {unit} | {_default(info)} | {allowed} | {meaning} |"


def _owner(model: type[Table], key: str) -> str:
    """Return the name under which MEANINGS may hold a key."""
    return f"{model.__name__}.{key}"


def _form(text: Text) -> str:
    return "up to 64 of `a-z 0-9 . _ -`" if "[a-z0-9]" in text.pattern else "string"


def _default(info: FieldInfo) -> str:
    if info.is_required():
        return "required"
    value = info.get_default(call_default_factory=True)
    if value is None:
        return "absent"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    return f"`{value}`" if isinstance(value, (list, dict)) else f"`{_number(value)}`"


def _number(value: float) -> str:
    text = f"{value:.10g}"
    return re.sub(
        r"e([+-])0?",
        lambda m: "e" + m[1].strip("+"),
        f"{value:g}" if "e" in text or abs(value) >= 1e6 else text,
    )


# ---- the recording ------------------------------------------------------------------------------


def _samples() -> str:
    rows = ["| field | type | unit | meaning |", "|---|---|---|---|"]
    for name in core.RECORD_DTYPE.names or ():
        kind = core.RECORD_DTYPE[name].str.lstrip("<|")
        unit = recording.UNITS[name]
        rows.append(f"| `{name}` | {kind} | {unit} | {FIELD_MEANINGS[name]} |")
    return "\n".join(rows)


if __name__ == "__main__":
    PAGE.write_text(renewed(PAGE.read_text(encoding="utf-8"), tables()), encoding="utf-8")
