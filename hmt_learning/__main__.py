"""Commands of the package: `python -m hmt_learning <command> --help`."""

import sys

from hmt_learning.app import main

if __name__ == '__main__':
    sys.exit(main())
