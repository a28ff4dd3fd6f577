"""Declare all options, in modules that take little time to import, because ``--help`` reads them."""
