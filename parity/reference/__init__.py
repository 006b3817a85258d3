"""GlobalSplat in plain torch: the mathematics of the system, one module per part, held against the goldens."""
