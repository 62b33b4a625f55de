"""What joins the controller to a rig: frames, and the table of a DBC file that describes others.

``wire`` is the thin face of the C functions on frames; ``dbc`` makes their table from a DBC file.
"""
