"""Checks of the Rust program against PyTorch: `reference` is the model in plain PyTorch, `harness` compares both."""
