"""The check of a test and its margins: figures, remarks and tables."""
