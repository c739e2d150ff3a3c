"""Lets every test import ``reference``, whatever pytest's import mode."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

collect_ignore = ["foreign"]  # the package that tests/cli/test_foreign.py imports as somebody else's
