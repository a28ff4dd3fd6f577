"""Stages of a run, one file for each; they share only the lower layers."""
