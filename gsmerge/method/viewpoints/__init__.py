"""Viewpoints: cameras that are placed in, between and around the views of a scene, and what views show."""
