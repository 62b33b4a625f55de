"""Concealed cases for the diagnosis, and how its answers are scored.

Written from the interchange format alone. Nothing here comes from the package under test: no force
law, no integrator, no parameter convention. The tool is called on the command line only.
"""
