"""One qfolio agent on a single core, in a process that bench/run.py asks for rounds."""

import os
import sys

os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # before jax counts the cores

from race import serve  # noqa: E402
from run import agents  # noqa: E402

serve(agents(1), sys.stdout)
