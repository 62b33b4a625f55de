"""Test files and rig files: TOML in, checked and frozen models out."""

from __future__ import annotations

from rthyb_rt.config.deriving import Derived, derive, resolve
from rthyb_rt.config.loading import (
    builtin_test_path,
    find_rig,
    json_schema,
    load_rig,
    load_test,
    parse_rig,
    parse_test,
    read_text,
    shipped_rig,
    split_overrides,
)
from rthyb_rt.config.rigfile import Identified, RigFile, SpecimenElement
from rthyb_rt.config.testfile import TestFile
from rthyb_rt.config.writing import dump

__all__ = [
    "Derived",
    "Identified",
    "RigFile",
    "SpecimenElement",
    "TestFile",
    "builtin_test_path",
    "derive",
    "dump",
    "find_rig",
    "json_schema",
    "load_rig",
    "load_test",
    "parse_rig",
    "parse_test",
    "read_text",
    "resolve",
    "shipped_rig",
    "split_overrides",
]
