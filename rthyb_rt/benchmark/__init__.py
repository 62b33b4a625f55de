"""The benchmark problem of real-time hybrid simulation, run with this program's own parts.

Silva, Gomez, Maghareh, Dyke, Spencer, "Benchmark control problem for real-time hybrid simulation",
Mechanical Systems and Signal Processing 135 (2020) 106381. Controller, numerical part and virtual
rig are those of every test in virtual time.
"""
