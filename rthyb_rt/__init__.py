"""Real-time hybrid testing controller.

Part of a structure is real, on an actuator; the rest is computed. 1024 times a second the
controller reads the specimen, solves the equation of motion, compensates the actuator's delay and
sends the next command. Importing the package itself loads nothing else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

__all__ = ["__version__"]

__version__: str

if not TYPE_CHECKING:  # else mypy would believe that the package has every attribute

    def __getattr__(name: str) -> str:
        """Look the version up when somebody asks, since reading metadata costs an import."""
        if name == "__version__":
            from importlib.metadata import version

            return version("rthyb-rt")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
