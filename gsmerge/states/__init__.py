"""States: the Feature Gaussians of views in a ``.gsm`` file, which batches of views extend (paper section 4.5).

Nothing is imported here, so that compacting a state loads none of the stages before decoding.
"""
