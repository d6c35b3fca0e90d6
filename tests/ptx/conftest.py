"""Tests in this folder run compiled kernels, so they need a process in which Triton's interpreter is not enabled."""

from __future__ import annotations

import os

collect_ignore = ["test_kernels.py"] if os.environ.get("TRITON_INTERPRET") != "0" else ["test_in_own_process.py"]
