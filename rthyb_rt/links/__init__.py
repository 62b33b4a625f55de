"""What joins the controller to a rig: frames, their table, and the opening of what carries them.

``wire`` is the thin face of the C functions on frames; ``dbc`` makes their table from a DBC file;
``opening`` opens and checks a link, whose descriptor is then the core's.
"""
