"""Pages for a browser: a scene before and after, in stills and in 3D, in one HTML file that loads no other file."""
