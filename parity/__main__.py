"""Runs the comparison: `python -m parity` is `python parity/run.py`."""

import sys

from .run import main

sys.exit(main())
