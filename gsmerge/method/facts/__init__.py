"""Facts about a scene that plans, stages and results depend on."""
