"""Views that arrive one batch after the other: the same stages, folded into a state of bounded size (paper 4.5)."""
