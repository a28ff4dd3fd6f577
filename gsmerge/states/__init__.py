"""States: views that arrive batch by batch, and compact scenes of all of them at any time."""
