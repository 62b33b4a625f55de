"""Rigs: links, the virtual rig, commissioning, identification."""
