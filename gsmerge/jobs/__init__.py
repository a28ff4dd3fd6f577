"""What calls the road or serves beside it: convert, inspect, estimates, tensors, states, and batches of scenes."""
