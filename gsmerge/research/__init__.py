"""Tools for research: synthetic scenes, training, charts, stress tests. Only the command line imports these tools."""
