"""``rthyb import-opensees``: the matrices of an OpenSees model, for `[numerical.matrices]`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rthyb_rt.cli import terminal
from rthyb_rt.cli.inputs import JsonOption

SCHEMA = "rthyb-import-opensees/1"


def import_opensees(
    model: Annotated[
        Path,
        typer.Argument(
            metavar="MODEL.py", help="Python file that builds the model.", show_default=False
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Argument(metavar="FILE.npz", help="File to write. Default: beside MODEL.py."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write an OpenSees model's matrices to an .npz file.

    MODEL.py builds the model with openseespy and stops before the analysis. Nonlinear elements are
    written with their initial stiffness. The resulting file is read by the key `file` of
    [numerical.matrices].

    \b
    Examples:
      rthyb import-opensees frame.py
      rthyb import-opensees frame.py frame.npz
    """
    import numpy as np

    from rthyb_rt.config import openseesmodel
    from rthyb_rt.errors import InputError

    data = openseesmodel.read(model)
    path = out or model.with_suffix(".npz")
    if path.suffix != ".npz":
        raise InputError(f'found "{path.suffix}"; the file must end with .npz', str(path))
    try:
        np.savez(path, **data.arrays())  # type: ignore[arg-type]
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", str(path)) from error
    massless = data.size - int(np.count_nonzero(data.mass_kg.matrix().diagonal()))
    damped = data.damping_n_s_per_m is not None
    rows = [
        ("Degrees of freedom", str(data.size), f"{massless} without mass"),
        ("Labels", ", ".join(data.labels[:4]) + (", ..." if data.size > 4 else ""), "NODE.way"),
        ("Influence vectors", ", ".join(data.influence), "direction of [numerical.matrices]"),
        (
            "Damping",
            "from the model" if damped else "none",
            "" if damped else "set numerical.damping",
        ),
        ("File", str(path), ""),
    ]
    terminal.print_table(rows, terminal.people(as_json))
    if as_json:
        terminal.print_json(
            {
                "schema": SCHEMA,
                "ok": True,
                "file": str(path),
                "degrees_of_freedom": data.size,
                "massless": massless,
                "labels": list(data.labels),
                "directions": list(data.influence),
                "damping": damped,
            }
        )
