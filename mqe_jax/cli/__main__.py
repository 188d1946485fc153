"""`python -m mqe_jax.cli`."""

import sys

from mqe_jax.cli.main import main

sys.exit(main())
