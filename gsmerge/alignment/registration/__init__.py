"""Scenes of one place, each in a frame of its own, put into one."""
