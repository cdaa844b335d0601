"""Pure functions on arrays and tensors. Each convention is defined in one module."""
