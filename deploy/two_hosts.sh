#!/usr/bin/env bash
# Run one job on two hosts that are one machine: two sets of namespaces with a bridge between them and one Ray node in
# each. The ranks of one `sgsst stylize --workers 2` communicate over the hosts' own addresses.
#
# Needs: Linux, root, iproute2 (`apt-get install -y iproute2`), util-linux, and the environment that `make demo` creates
# in .venv, or another one in BIN. Takes about two minutes. Everything is cleaned up at the end, even after errors.
#
# Usage: deploy/two_hosts.sh [OUT.ply]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source deploy/free_network.sh
BIN=$(realpath "${BIN:-.venv/bin}")
OUT=$(realpath -m "${1:-two_hosts/stylized.ply}")
PORT=6479
WORK=$(mktemp -d /tmp/sgsst-two-XXXXXX)
export RAY_AUTH_MODE=token RAY_AUTH_TOKEN RAY_USAGE_STATS_ENABLED=0
RAY_AUTH_TOKEN=$(od -An -N32 -tx1 /dev/urandom | tr -d ' \n')
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} PATH=$BIN:$PATH
declare -A hosts=()

[ "$(id -u)" = 0 ] || { echo "This needs root, to make network namespaces." >&2; exit 1; }
for tool in ip unshare nsenter; do
  command -v "$tool" > /dev/null || { echo "$tool is missing: apt-get install -y iproute2 util-linux" >&2; exit 1; }
done

clean_up() {
  # killing a host's first process kills all others
  for pid in "${hosts[@]}"; do kill -KILL "$pid" 2> /dev/null || true; done
  give_network_back a b
  rm -rf "$WORK"
}
trap clean_up EXIT
trap 'exit 130' INT TERM

# Start a host with its own network, processes, name and temporary folder. $1 name, $2 address, the rest: its Ray node.
start_host() {
  local name=$1 address=$2
  shift 2
  add_host "$name" "$address"
  mkdir -p "$WORK/ray"
  ip netns exec "$BRIDGE-$name" unshare --uts --pid --mount --fork --mount-proc --kill-child bash -c \
    "hostname host-$name; mount -t tmpfs tmpfs $WORK/ray; exec $(printf '%q ' "$@")" > "$WORK/$name.log" 2>&1 &
  hosts[$name]=$!
  disown # keeps the shell from reporting its end
}

# Run a command on a host beside its Ray node. $1 name, the rest: the command.
on_host() {
  local first
  first=$(pgrep -P "${hosts[$1]}" | head -n 1)
  shift
  nsenter -t "$first" -n -u -p -m --wd="$PWD" "$@"
}

take_network

echo "Building a scene"
python - "$WORK" <<'PYTHON'
import sys
from pathlib import Path

from api.cli.scene_tools import build_demo

build_demo(Path(sys.argv[1]) / "scene")
PYTHON

common=(--num-cpus 1 --num-gpus 0 --object-store-memory 536870912 --disable-usage-stats --block)
start_host a "$NET.2" ray start --head --port "$PORT" --node-ip-address "$NET.2" --include-dashboard false \
  --temp-dir "$WORK/ray" "${common[@]}"
for _ in $(seq 60); do
  sleep 1
  on_host a ray health-check --address "$NET.2:$PORT" > /dev/null 2>&1 && break
done
start_host b "$NET.3" ray start --address "$NET.2:$PORT" --node-ip-address "$NET.3" "${common[@]}"
for _ in $(seq 60); do
  sleep 1
  grep -q "Ray runtime started" "$WORK/b.log" && break
done
grep -q "Ray runtime started" "$WORK/b.log" || { cat "$WORK/a.log" "$WORK/b.log" >&2; exit 1; }

echo "Two hosts: $NET.2 and $NET.3"
before=$(cat "/sys/class/net/$BRIDGE-b/statistics/rx_bytes")
scene=$WORK/scene
on_host a env RAY_ADDRESS="$NET.2:$PORT" sgsst stylize "$scene/motorcycle.ply" --cameras "$scene/cameras.json" \
  --style "$scene/starry_night.jpg" --out "$OUT" --resolution 160 --views 3 --steps-coarse 0 --steps-sos 20 --backbone vgg16 \
  --workers 2
after=$(cat "/sys/class/net/$BRIDGE-b/statistics/rx_bytes")

python - "${OUT%.ply}.report.json" $((after - before)) <<'PYTHON'
import json
import sys

report = json.load(open(sys.argv[1]))
ranks, megabytes = report["workers"]["ranks"], int(sys.argv[2]) / 1e6
print("ranks:", ", ".join(f"{rank['host']} ({rank['device']}, {rank['threads']} threads)" for rank in ranks))
print(f"sent by host-b over the bridge: {megabytes:.1f} MB in {len(report['history'])} steps")
# Per step, a view of 160 x 120 pixels with its gradient, statistics and colors takes more than a megabyte.
sys.exit({rank["host"] for rank in ranks} != {"host-a", "host-b"} or megabytes < len(report["history"]))
PYTHON
