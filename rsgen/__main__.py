"""`python -m rsgen` is the command `rsgen`."""

import sys

from rsgen.cli.main import main

sys.exit(main())
