"""Analysis of signals and settings: measures, margins, summary."""
