"""Is a test sound, and how far is it from trouble: its figures, remarks and tables."""
