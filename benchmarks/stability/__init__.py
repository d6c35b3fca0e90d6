"""Numerically hard cases, shared by the tests and the benchmark.

Each case describes its extreme input, measures an error against a float64 reference, and states a bound for this error.
If the input must be rejected, the case checks that it is.
"""

from benchmarks.stability import format_cases as formats
from benchmarks.stability import gaussian_cases as gaussians
from benchmarks.stability import image_cases as images
from benchmarks.stability import job_cases as jobs
from benchmarks.stability import optimization_cases as optimization
from benchmarks.stability import precision_cases as precision
from benchmarks.stability import search as search
from benchmarks.stability import view_cases as views
from benchmarks.stability.case import Case, CaseResult, Group, Measurement, measure

__all__ = ["Case", "CaseResult", "Group", "Measurement", "all_cases", "measure"]


_GROUPS = (gaussians, views, images, optimization, precision, jobs, search, formats)


def all_cases() -> list[Case]:
    """Return all cases, group by group."""
    return [case for module in _GROUPS for case in module.cases()]
