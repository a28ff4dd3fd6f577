"""Declarations of all options: default, meaning and possible values. Light to import, since ``--help`` reads them."""
