"""States: the Feature Gaussians of views in a ``.gsm`` file, which batches of views extend (paper section 4.5)."""
