"""The paper's networks as bounded corrections of the analytic stages, and their checkpoints."""
