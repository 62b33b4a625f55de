"""Test files and rig files: TOML files are read into validated, immutable models."""

from __future__ import annotations

from rthyb_rt.config.axesfile import AxesRig
from rthyb_rt.config.baselinefile import BaselineFile
from rthyb_rt.config.changes import IN_PYTHON
from rthyb_rt.config.defaults import derived_limits
from rthyb_rt.config.deriving import Derived, derive, omitted, resolve
from rthyb_rt.config.limits import Limit, Limits
from rthyb_rt.config.linkframes import frames_of_link
from rthyb_rt.config.loading import (
    builtin_test_path,
    check_values,
    find,
    find_rig,
    find_test,
    has_axes,
    json_schema,
    load_any_both,
    load_any_rig,
    load_both,
    load_rig,
    load_test,
    parse_any_rig,
    parse_baseline,
    parse_campaign,
    parse_map,
    parse_rig,
    parse_test,
    read_text,
    rig_of_test,
    schema_of,
    shipped,
    shipped_rig,
    shipped_test,
    split_overrides,
    test_as_model,
    with_some_stiffness,
)
from rthyb_rt.config.mapfile import MapFile
from rthyb_rt.config.rate import STANDARD, STANDARD_HZ, Rate
from rthyb_rt.config.rigfile import Calibration, Identified, LinkTable, RigFile, SpecimenElement
from rthyb_rt.config.testfile import TestFile
from rthyb_rt.config.writing import dump, dump_given, dump_values, inline, remove_omitted

__all__ = [
    "IN_PYTHON",
    "STANDARD",
    "STANDARD_HZ",
    "AxesRig",
    "BaselineFile",
    "Calibration",
    "Derived",
    "Identified",
    "Limit",
    "Limits",
    "LinkTable",
    "MapFile",
    "Rate",
    "RigFile",
    "SpecimenElement",
    "TestFile",
    "builtin_test_path",
    "check_values",
    "derive",
    "derived_limits",
    "dump",
    "dump_given",
    "dump_values",
    "find",
    "find_rig",
    "find_test",
    "frames_of_link",
    "has_axes",
    "inline",
    "json_schema",
    "load_any_both",
    "load_any_rig",
    "load_both",
    "load_rig",
    "load_test",
    "omitted",
    "parse_any_rig",
    "parse_baseline",
    "parse_campaign",
    "parse_map",
    "parse_rig",
    "parse_test",
    "read_text",
    "remove_omitted",
    "resolve",
    "rig_of_test",
    "schema_of",
    "shipped",
    "shipped_rig",
    "shipped_test",
    "split_overrides",
    "test_as_model",
    "with_some_stiffness",
]
