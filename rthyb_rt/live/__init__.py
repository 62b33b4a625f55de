"""The live view: a browser page that shows a running test, or a recorded one.

Loopback only, protected by a random token; it reads the telemetry ring and talks to the service's
control socket like any other client.
"""
