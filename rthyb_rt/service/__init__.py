"""The service of a laboratory: a daemon that runs many tests on one rig, and a recorder.

`engine` controls the rig and its tests, `control` provides the socket for operators, `daemon` runs
both. `recorder` is a separate process that reads the telemetry ring and writes files.
"""
