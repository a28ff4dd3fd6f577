"""Run a grid of settings as jobs of a batch, and make figures and a page of the measurements."""
