"""Results of the runs, stored as they arrive, so that an interrupted campaign can resume."""

from __future__ import annotations

import fcntl
import json
import os
import re
from pathlib import Path
from typing import Final, Self

from rthyb_rt.campaign.plan import Plan, PlannedRun, Row
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.record.recording import replacing

ROWS: Final = "rows.jsonl"
PLAN: Final = "plan.json"
GIVEN: Final = "given"
"""Folder of the input files of a sweep; it exists before the campaign does."""
SCHEMA: Final = "rthyb-campaign-plan/1"
_UNFINISHED_PLAN: Final = re.compile(rf"\.{re.escape(PLAN)}\.\d+\.part")
"""What a process leaves that is killed while it writes the plan."""


class Book:
    """The rows of a campaign, one line of JSON each, in a separate folder.

    Only the process that conducts the campaign writes, so that no row is written twice, whatever
    happens to the computing processes. A line that was cut off by a power failure is dropped.

    Args:
        folder: folder of the campaign; created if it is missing.
        plan: the campaign.

    Raises:
        InputError: the folder contains another campaign, or other files.
        RthybError: it cannot be written, or another process is running the campaign.
    """

    def __init__(self, folder: Path, plan: Plan) -> None:
        self.folder, self.plan = folder, plan
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._claim()
            self._file = (folder / ROWS).open("a+", encoding="utf-8")
        except OSError as error:
            raise RthybError(
                f"the campaign cannot be kept here ({error.strerror or error}); choose another "
                "folder with --out",
                where=str(folder),
            ) from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.close()
            raise RthybError(
                "another process is running this campaign; wait for it, or choose another folder "
                "with --out",
                where=str(folder),
            ) from None
        self.rows = self._read()

    def _claim(self) -> None:
        path = self.folder / PLAN
        if path.is_file():
            try:
                found = json.loads(path.read_text(encoding="utf-8")).get("fingerprint")
            except (ValueError, AttributeError):
                found = None
            if found != self.plan.fingerprint:
                raise InputError(
                    "holds a campaign with other runs, other files or another version of the "
                    "core, whose rows cannot be mixed with new ones; choose another folder with "
                    "--out, or delete this one",
                    str(self.folder),
                )
            return
        if any(
            path.name != GIVEN and not _UNFINISHED_PLAN.fullmatch(path.name)
            for path in self.folder.iterdir()
        ):
            raise InputError(
                "is not empty and does not hold a campaign; choose another folder with --out",
                str(self.folder),
            )
        about = {
            "schema": SCHEMA,
            "name": self.plan.name,
            "runs": len(self.plan.cases),
            "fingerprint": self.plan.fingerprint,
        }
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")

    def _read(self) -> dict[int, Row]:
        self._file.seek(0)
        rows: dict[int, Row] = {}
        good = 0
        for line in self._file.read().splitlines(keepends=True):
            if not line.endswith("\n"):
                break
            try:
                row = json.loads(line)
                rows[int(row["case"])] = row
            except (ValueError, KeyError, TypeError):
                break
            good += len(line.encode())
        self._file.truncate(good)
        self._file.seek(0, os.SEEK_END)
        return rows

    @property
    def left(self) -> list[PlannedRun]:
        """The runs without a row."""
        return [case for case in self.plan.cases if case.number not in self.rows]

    def add(self, row: Row) -> None:
        """Store the row of a run; an existing row is not changed."""
        number = int(row["case"])
        if number in self.rows:
            return
        self._file.write(json.dumps(row, allow_nan=False) + "\n")
        self._file.flush()
        self.rows[number] = row

    def in_order(self) -> list[Row]:
        """Return all rows by number."""
        return [self.rows[number] for number in sorted(self.rows)]

    def close(self) -> None:
        """Write all rows to the disk."""
        if not self._file.closed:
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
