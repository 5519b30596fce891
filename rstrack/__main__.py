"""`python -m rstrack` is the command `rstrack`."""

import sys

from rstrack.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
