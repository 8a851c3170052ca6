"""`python -m sgns` is the same as `sgns`."""

import sys

from sgns.cli.commands import main

sys.exit(main())
