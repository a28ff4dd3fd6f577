"""Commands of the entry points ``gsmerge.commands``: stress, chart, generate and train."""
