"""``python -m difflpv.cli``: the ``difflpv`` program."""

import sys

from difflpv.cli import main

if __name__ == "__main__":
    sys.exit(main())
