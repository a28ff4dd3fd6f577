"""Every option once: default, meaning and possible values; light, since ``--help`` reads it."""
