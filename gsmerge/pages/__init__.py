"""Pages for a browser: a scene before and after, as stills and in 3D, in one HTML file that loads nothing."""
