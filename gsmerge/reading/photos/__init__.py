"""Decide which photo shows which view of a scene, and which of its pixels count."""
