"""The process of a `Companion`."""

from rthyb_rt.rig.virtual_rig.companion import be_companion

be_companion()
