"""``python -m gsmerge``."""

import sys

from gsmerge.cli import main

sys.exit(main())
