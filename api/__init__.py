"""User interfaces: HTTP API, command line, Python client and web page."""


def installed_version() -> str:
    """Return the version of the installed program."""
    from importlib.metadata import version

    return version("sgsst-service")
