"""`python -m api.cli` is `sgsst`."""

from api.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
