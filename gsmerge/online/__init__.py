"""Views in batches: the same stages, folded into a state of bounded size (paper section 4.5)."""
