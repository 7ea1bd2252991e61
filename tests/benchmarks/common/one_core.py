"""Import this before anything that imports numpy: threads of the linear algebra would burn a second core on small matrices."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
