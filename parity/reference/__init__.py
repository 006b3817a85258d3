"""GlobalSplat in plain PyTorch: the system's mathematics, one module per part."""
