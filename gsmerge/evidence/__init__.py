"""What photos and Gaussians say of each other: pairs compared alike, and judged in units of their own noise."""
