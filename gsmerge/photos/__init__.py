"""Decide which photo shows which view, and correct photos that differ from what the Gaussians show."""
