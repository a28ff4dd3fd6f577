"""Values of arguments and messages: arrays or tensors, checks, words."""
