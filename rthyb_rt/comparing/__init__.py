"""Comparison of recordings, simulations and tables of other laboratories."""
