"""What calls a run or serves beside it: convert, inspect, estimates, tensors, states, and batches of scenes."""
