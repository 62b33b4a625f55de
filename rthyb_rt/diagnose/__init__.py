"""Diagnosis: when simulation and recording differ, say what physics the model leaves out."""
