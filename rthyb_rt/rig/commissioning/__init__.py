"""Commissioning: small motions within all limits, and checks of everything that protects the rig.

`moving` carries out a prescribed motion through the same tick and link as a test. `jogging` uses it
to move the actuator a little, `polarity` to find sensors and commands with the wrong sign, and
`limits` and `stops` to provoke everything that should end a test. `guide` runs all checks in order,
and `certificate` records which of them passed, for which rig file, and when.
"""
