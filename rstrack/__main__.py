"""`python -m rstrack` is the command `rstrack`."""

import sys

from rstrack.cli.main import main

sys.exit(main())
