"""Which row of a file belongs to which pixel of which view."""
