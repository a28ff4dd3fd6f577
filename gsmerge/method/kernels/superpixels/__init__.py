"""Cut pictures into superpixels, and merge neighbouring superpixels."""
