"""Large scenes: blocks of views, each compacted on its own, and the seams between them."""
