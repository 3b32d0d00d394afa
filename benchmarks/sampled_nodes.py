"""The nodes of `person_node` with a sampling profiler, see `benchmarks.sampling`."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from benchmarks.sampling import PROFILE_FILE, StackSampler, write_samples
from hmt_ros.nodes.person_node import main

if __name__ == '__main__':
    with StackSampler() as sampler:
        code = main()
    write_samples(sampler.samples(), Path(os.environ[PROFILE_FILE]))
    sys.exit(code)
