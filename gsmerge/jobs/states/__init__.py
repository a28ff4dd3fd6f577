"""States: collect views that arrive in batches, and make compact scenes of all views at any time."""
