"""Compares the Rust program with the PyTorch reference: equal inputs must give equal outputs and gradients."""
