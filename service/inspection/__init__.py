"""Checks of users' files in a separate process, so that a malicious file cannot crash the service."""

import sgsst_core  # noqa: F401 (its settings of OpenMP must be made before PyTorch is imported)
