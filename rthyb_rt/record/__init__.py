"""What is kept of a test: the HDF5 recording, the telemetry ring, exports."""
