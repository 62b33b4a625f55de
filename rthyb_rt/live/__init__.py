"""The live view: a page in the browser that shows a test as it runs, or one of the past.

Loopback only, behind a random token; it reads the telemetry ring and talks to the service's control
socket as any other client does.
"""
