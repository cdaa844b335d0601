"""Pure functions on arrays and tensors. One module owns each convention."""
