"""Join scenes of one place, each in its own frame, into one scene."""
