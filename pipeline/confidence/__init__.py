"""The probability that a pose is right, and the evidence that it is computed from."""
