"""Storage of tests: the HDF5 recording, the telemetry ring, exports."""
