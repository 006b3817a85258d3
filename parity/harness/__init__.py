"""Holds the Rust program against the torch reference: the same numbers in, the same numbers and gradients out."""
