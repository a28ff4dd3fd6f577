"""Cut pictures into superpixels, and merge superpixels."""
