"""Generation of the passwords of the services in compose.yaml, and their storage in volumes.

Each password is generated once, at the first start. A password in the environment takes precedence, at later starts
too. The script runs as root in a separate container before all others (`secrets` in compose.yaml). Each service mounts
only the passwords that it needs.
"""

import json
import os
import secrets
import sys
from pathlib import Path

#: User ID of the service's processes. They must own the password file, because libpq only accepts one that nobody else
#: can read.
SERVICE_USER = 10001
HOST, USER = "database", "sgsst"


def make_secrets(folder: Path, given: dict[str, str]) -> None:
    """Write all password files to a folder.

    Args:
        given: Environment variables. If a password's variable is empty or missing, the password is generated.
    """
    password = _secret(folder / "database" / "password", given.get("SGSST_DATABASE_PASSWORD"))
    escaped = password.replace("\\", "\\\\").replace(":", "\\:")
    _write(folder / "database" / "pgpass", f"{HOST}:*:*:{USER}:{escaped}\n", private=True)

    key = _secret(folder / "store" / "key", given.get("SGSST_STORE_KEY"))
    secret = _secret(folder / "store" / "secret", given.get("SGSST_STORE_SECRET"))
    _write(
        folder / "store" / "credentials",
        f"[default]\naws_access_key_id = {key}\naws_secret_access_key = {secret}\n",
        private=True,
    )
    identity = {"name": USER, "credentials": [{"accessKey": key, "secretKey": secret}], "actions": ["Admin"]}
    _write(folder / "store" / "s3.json", json.dumps({"identities": [identity]}))

    _secret(folder / "grafana" / "password", given.get("SGSST_GRAFANA_PASSWORD"))


def _secret(path: Path, given: str | None) -> str:
    """Return the given secret, or else the one in the file, or else a new one, and store it in the file."""
    secret = given or (path.read_text() if path.exists() else secrets.token_hex(32))
    _write(path, secret)
    return secret


def _write(path: Path, text: str, *, private: bool = False) -> None:
    """Write a file atomically. If `private`, only the service's user can read it.

    Other services run as users of their own images, so the user ID cannot protect their files. They are protected by
    mounting each volume only in the services that need it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{secrets.token_hex(8)}.part")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w") as file:
        file.write(text)
        if private:
            os.fchown(descriptor, SERVICE_USER, SERVICE_USER)
        else:
            os.fchmod(descriptor, 0o444)
    temporary.replace(path)


if __name__ == "__main__":
    make_secrets(Path(sys.argv[1]), dict(os.environ))
