"""pytest plugin that executes Triton kernels in the PTX interpreter, for whole test files.

TRITON_INTERPRET=0 pytest -p tests.ptx.plugin --ptx-target sm_90 FILES
"""

from __future__ import annotations

from collections.abc import Generator, Iterator

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option for the target of the compiler."""
    parser.addoption("--ptx-target", default="sm_80", help="target for which kernels are compiled")


@pytest.fixture(scope="session", autouse=True)
def ptx(request: pytest.FixtureRequest) -> Iterator[None]:
    """Execute kernels in the PTX interpreter during the session."""
    from tests.ptx.driver import compiled_kernels

    with compiled_kernels(int(request.config.getoption("--ptx-target").removeprefix("sm_"))):
        yield


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Generator[None, object, object]:
    """Skip tests of kernels whose instructions for tensor cores cannot be executed."""
    from tests.ptx.machine import UnsupportedError

    try:
        return (yield)
    except UnsupportedError as error:
        if "wgmma" not in str(error) and "tcgen05" not in str(error):
            raise
        pytest.skip(f"cannot be executed, only compiled: {error}")
