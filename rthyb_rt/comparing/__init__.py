"""Recordings, simulations and tables of other labs beside one another."""
