"""Commands of the package: `python -m hmt_ros <command> --help`."""

import sys

from hmt_ros.app import main

if __name__ == '__main__':
    sys.exit(main())
