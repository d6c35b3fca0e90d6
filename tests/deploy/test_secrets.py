"""Tests of `deploy/make_secrets.py` and `deploy/compose.yaml`: no service starts with a publicly known password."""

import configparser
import json
import os
import re
import stat
import sys
from pathlib import Path

import pytest
import yaml

from deploy import make_secrets as module
from deploy.make_secrets import make_secrets
from tests.deploy.containers import COMPOSE

SECRETS = ("database/password", "store/key", "store/secret", "grafana/password")
#: Volumes of secrets that each service of the compose file mounts; other services mount none.
MOUNTED = {
    "secrets": {"secret-database", "secret-store", "secret-grafana"},
    "setup": {"secret-database", "secret-store"},
    "api": {"secret-database", "secret-store"},
    "dispatcher": {"secret-database", "secret-store"},
    "database": {"secret-database"},
    "store": {"secret-store"},
    "grafana": {"secret-grafana"},
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    if sys.platform == "win32":
        pytest.skip("file modes are those of POSIX")
    monkeypatch.setattr(module, "SERVICE_USER", os.getuid())
    return tmp_path


def read(folder: Path) -> dict[str, str]:
    return {name: (folder / name).read_text() for name in SECRETS}


def test_passwords_are_generated_only_once(folder: Path) -> None:
    make_secrets(folder, {})
    first = read(folder)
    assert len(set(first.values())) == len(SECRETS)
    assert all(re.fullmatch(r"[0-9a-f]{64}", secret) for secret in first.values())
    make_secrets(folder, {"SGSST_DATABASE_PASSWORD": ""})
    assert read(folder) == first
    assert not list(folder.rglob("*.part"))


def test_given_password_takes_precedence(folder: Path) -> None:
    make_secrets(folder, {})
    before = read(folder)
    make_secrets(folder, {"SGSST_DATABASE_PASSWORD": r"a:b\c"})
    assert read(folder) == {**before, "database/password": r"a:b\c"}
    assert (folder / "database" / "pgpass").read_text() == "database:*:*:sgsst:a\\:b\\\\c\n"


def test_secret_files_have_the_expected_formats(folder: Path) -> None:
    make_secrets(folder, {})
    secrets = read(folder)
    for name in ("database/pgpass", "store/credentials"):
        assert stat.S_IMODE((folder / name).stat().st_mode) == 0o600, "libpq refuses one that others can read"
    credentials = configparser.RawConfigParser()
    credentials.read(folder / "store" / "credentials")
    assert credentials["default"]["aws_access_key_id"] == secrets["store/key"]
    assert credentials["default"]["aws_secret_access_key"] == secrets["store/secret"]
    (identity,) = json.loads((folder / "store" / "s3.json").read_text())["identities"]
    assert identity["credentials"] == [{"accessKey": secrets["store/key"], "secretKey": secrets["store/secret"]}]


def test_compose_file_contains_no_password() -> None:
    text = COMPOSE.read_text()
    assert re.findall(r"\$\{\w*(?:PASSWORD|SECRET|KEY)\w*:-[^}]+\}", text) == []
    for name, service in yaml.safe_load(text)["services"].items():
        for variable, value in (service.get("environment") or {}).items():
            if re.search("PASSWORD|SECRET|TOKEN|ACCESS_KEY", variable) and name != "secrets":
                assert variable.endswith("FILE"), f"{name}: {variable}"
                assert str(value).startswith("/secrets/"), f"{name}: {variable}"
            assert not re.search(r"://[^@/]*:[^@/]+@", str(value)), f"{name}: {variable} holds a password"


def test_every_service_mounts_its_own_secrets() -> None:
    services = yaml.safe_load(COMPOSE.read_text())["services"]
    for name, service in services.items():
        mounts = {mount.split(":")[0]: mount for mount in service.get("volumes", ())}
        mounted = {volume for volume in mounts if volume.startswith("secret-")}
        assert mounted == MOUNTED.get(name, set()), name
        if mounted and name != "secrets":
            assert all(mounts[volume].endswith(":ro") for volume in mounted), name
            # it exits and is restarted until the secrets exist
            assert service["restart"] == ("on-failure" if name == "setup" else "unless-stopped"), name
