"""Python runs this as it starts in a folder of PYTHONPATH; see `jitter.py`."""

import jitter

jitter.install()
