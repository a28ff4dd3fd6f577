"""The method: what is made of arrays alone, without files, options of a command or decisions about a scene."""
