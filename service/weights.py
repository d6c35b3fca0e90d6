"""Verification of network weights by the service: when a process starts, and when a weight file has changed."""

from __future__ import annotations

import logging
from functools import lru_cache

from service import problems
from sgsst_core.features.weight_files import damaged_weights

_log = logging.getLogger(__name__)


def check_weights() -> None:
    """Verify the installed weights, and log each damaged file once, with instructions for the operator.

    Raises:
        DamagedWeightsError: If any weights are damaged.
    """
    if damages := damaged_weights():
        for damage in damages:
            _log_once(damage)
        raise problems.WEIGHTS_DAMAGED()


@lru_cache
def _log_once(damage: str) -> None:
    _log.error("weights damaged, no job is accepted or started: %s", damage)
