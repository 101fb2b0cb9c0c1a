"""`python -m csac_jax` is `csac-jax`."""

import sys

from csac_jax.cli import main

sys.exit(main())
