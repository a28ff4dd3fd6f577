"""The stages of a run, one file an arrow; none imports another but through what they share below."""
