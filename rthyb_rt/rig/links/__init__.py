"""What joins the controller to a rig: the opening and checking of links, which then are the core's.

Frames and their tables are in `rthyb_rt.core.wire` and `rthyb_rt.core.dbc`.
"""
