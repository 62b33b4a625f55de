"""The lab's service: one daemon that runs many tests at one rig, and a recorder beside it.

`engine` has the rig and its tests, `control` the socket that an operator drives it by, `daemon` the
process of both; `recorder` is the other process, which reads the telemetry ring and writes files.
"""
