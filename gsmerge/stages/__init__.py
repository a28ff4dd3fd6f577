"""The stages of a run, each in a file of its own. What several stages use is in the packages below this one."""
