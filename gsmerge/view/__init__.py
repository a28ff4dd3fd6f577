"""Pages for a browser: a scene before and after, as stills and in 3D. One HTML file each, which loads nothing."""
