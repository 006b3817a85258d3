"""Runs the program: python -m globalsplat."""

from ._program import main

main()
