"""User interfaces: HTTP API, command line, Python client and web page."""


def installed_version() -> str:
    """Return the version of the installed program; "0" if it is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("sgsst-service")
    except PackageNotFoundError:
        return "0"
