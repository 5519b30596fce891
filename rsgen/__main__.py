"""`python -m rsgen` is the command `rsgen`."""

import sys

from rsgen.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
