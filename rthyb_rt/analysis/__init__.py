"""What signals and settings say: measures, margins, summary."""
