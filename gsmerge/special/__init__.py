"""Special runs: searches, budgets in bytes, clean-up, blocks, new views, and methods of others."""
