"""The pipelines: ways from a prepared scene to the fitted Gaussians of a result, and the plan that they take."""
