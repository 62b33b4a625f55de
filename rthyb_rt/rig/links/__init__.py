"""Links to a rig: opening and checking them; the core then exchanges the frames.

Frames and their tables are in `rthyb_rt.core.wire` and `rthyb_rt.core.dbc`.
"""
