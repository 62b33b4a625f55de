"""Making a rig fit for tests: small motions under all limits, and checks of what protects it.

`moving` carries out a prescribed motion through the tick and the link that a test has. With it
`jogging` moves the actuator a little, `polarity` tells sensors and commands of the wrong sign,
`limits` and `stops` provoke what shall end a test, `guide` leads through all of it in order, and
`certificate` keeps on file what passed, for which rig file, and when.
"""
