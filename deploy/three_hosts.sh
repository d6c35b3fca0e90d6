#!/usr/bin/env bash
# Run the service on three hosts that share only PostgreSQL and an S3 store: no folder, no path. The hosts are sets of
# namespaces on this machine with a bridge between them: `api` (the API), `head` (Ray's head without work, and the
# dispatcher), and `node` (a Ray node for the computations, without installed network weights).
#
# A job is submitted with curl from outside, and its result is compared with that of `sgsst stylize`. With "kill" as
# second argument, the node is killed in the middle of the job with all its processes and its disk, and started again.
#
# Needs: Linux, root, iproute2, util-linux, curl, PostgreSQL's programs, and the environment that `make demo` creates in
# .venv (or another one in BIN) with [postgresql,s3] and moto[server]. Everything is cleaned up at the end.
#
# Usage: deploy/three_hosts.sh [FOLDER] [kill]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source deploy/free_network.sh
BIN=$(realpath "${BIN:-.venv/bin}")
OUT=$(realpath -m "${1:-three_hosts}")
HOW=${2:-quiet}
RAY_PORT=6479
PG_PORT=5498
S3_PORT=5599
PATIENCE=${PATIENCE:-900} # time limit of the job in seconds
WORK=$(mktemp -d /tmp/sgsst-three-XXXXXX)
PG_BIN=$(dirname "$(readlink -f "$(command -v initdb || ls /usr/lib/postgresql/*/bin/initdb)" | tail -n 1)")
CACHE=${SGSST_CACHE:-$HOME/.cache/sgsst}
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} PATH=$BIN:$PG_BIN:$PATH
export RAY_AUTH_MODE=token RAY_AUTH_TOKEN RAY_USAGE_STATS_ENABLED=0 OMP_NUM_THREADS=1
RAY_AUTH_TOKEN=$(od -An -N32 -tx1 /dev/urandom | tr -d ' \n')
export AWS_ACCESS_KEY_ID=key AWS_SECRET_ACCESS_KEY=secret AWS_DEFAULT_REGION=us-east-1
declare -A hosts=()
others=()

[ "$(id -u)" = 0 ] || { echo "This needs root, to make network namespaces." >&2; exit 1; }
for tool in ip unshare nsenter curl initdb setpriv moto_server; do
  command -v "$tool" > /dev/null || { echo "$tool is missing: see the head of this script." >&2; exit 1; }
done

clean_up() {
  for pid in "${hosts[@]}" "${others[@]}"; do kill -KILL "$pid" 2> /dev/null || true; done
  give_network_back api head node
  sleep 1
  rm -rf "$WORK"
}
trap clean_up EXIT
trap 'exit 130' INT TERM

# Start a host with its own network, processes, name, and disks for temporary files and for the service. $1 name, $2
# address.
start_host() {
  local name=$1 address=$2
  add_host "$name" "$address"
  mkdir -p "$WORK/ray" "$WORK/disk"
  ip netns exec "$BRIDGE-$name" unshare --uts --pid --mount --fork --mount-proc --kill-child bash -c \
    "hostname host-$name; mount -t tmpfs tmpfs $WORK/ray; mount -t tmpfs tmpfs $WORK/disk; exec sleep infinity" \
    > "$WORK/$name.log" 2>&1 &
  hosts[$name]=$!
  disown
  for _ in $(seq 50); do
    sleep 0.1
    on_host "$name" mountpoint -q "$WORK/disk" 2> /dev/null && return
  done
  echo "host $name did not start" >&2
  exit 1
}

stop_host() {
  kill -KILL "${hosts[$1]}"
  sleep 1
  remove_host "$1"
}

# Run a command on a host. $1 name, the rest: the command.
on_host() {
  local first
  first=$(pgrep -P "${hosts[$1]}" | head -n 1)
  shift
  nsenter -t "$first" -n -u -p -m --wd="$PWD" "$@"
}

# Run a service on a host in the background, with its output in NAME.log. $1 host, $2 name, the rest: the command.
run_on() {
  local host=$1 name=$2
  shift 2
  on_host "$host" "$@" >> "$WORK/$name.log" 2>&1 &
  others+=($!)
  disown
}

wait_for() {
  local what=$1 _
  shift
  for _ in $(seq 120); do
    "$@" > /dev/null 2>&1 && return
    sleep 1
  done
  echo "$what does not come" >&2
  tail -n 40 "$WORK"/*.log >&2
  exit 1
}

start_node() {
  start_host node "$NET.4"
  run_on node ray-node env SGSST_DATA="$WORK/disk/data" SGSST_CACHE="$WORK/disk/none" ray start --address "$NET.3:$RAY_PORT" \
    --node-ip-address "$NET.4" --num-cpus 2 "${common[@]}"
}

take_network
export AWS_ENDPOINT_URL=http://$NET.1:$S3_PORT

mkdir "$WORK/pg"
chmod 755 "$WORK"
chown postgres "$WORK/pg"
postgres=(setpriv --reuid postgres --regid postgres --clear-groups)
"${postgres[@]}" initdb -D "$WORK/pg/data" -U sgsst -A trust -E UTF8 --locale=C > /dev/null
echo "host all all $NET.0/24 trust" >> "$WORK/pg/data/pg_hba.conf"
"${postgres[@]}" postgres -D "$WORK/pg/data" -h "$NET.1" -p "$PG_PORT" -k "$WORK/pg" > "$WORK/postgres.log" 2>&1 &
others+=($!)
disown
moto_server -H "$NET.1" -p "$S3_PORT" > "$WORK/s3.log" 2>&1 &
others+=($!)
disown
wait_for "the store" curl -sf -o /dev/null -X PUT "$AWS_ENDPOINT_URL/files"

service=(env SGSST_DATA="$WORK/disk/data" SGSST_CACHE="$CACHE" SGSST_ARTIFACTS=s3://files/sgsst SGSST_MIN_FREE_BYTES=0
  SGSST_DATABASE="postgresql+psycopg://sgsst@$NET.1:$PG_PORT/postgres" SGSST_REQUIRE_KEYS=false SGSST_RETRY_SECONDS=2
  SGSST_CHECKPOINT_SECONDS=1 SGSST_PREVIEW_SECONDS=2)
common=(--num-gpus 0 --object-store-memory 134217728 --disable-usage-stats --block)
start_host api "$NET.2"
start_host head "$NET.3"
run_on head ray-head ray start --head --port "$RAY_PORT" --node-ip-address "$NET.3" --include-dashboard false \
  --temp-dir "$WORK/ray" --num-cpus 0 "${common[@]}"
run_on api api "${service[@]}" SGSST_HOST="$NET.2" python -m api.http.server
wait_for "Ray" on_host head ray health-check --address "$NET.3:$RAY_PORT"
start_node
run_on head dispatcher "${service[@]}" RAY_ADDRESS="$NET.3:$RAY_PORT" python -m service.scheduling.dispatcher
url=http://$NET.2:8000
wait_for "the service" sh -c "curl -s $url/readyz | grep -q '\"status\":\"ok\"'"
echo "Three hosts of $NET: API on host-api, dispatcher on host-head, a Ray node on host-node"

python - "$WORK/scene" <<'PYTHON'
import sys
from pathlib import Path

from api.cli.scene_tools import build_demo

build_demo(Path(sys.argv[1]))
PYTHON
scene=$WORK/scene
mkdir -p "$OUT"
field() { python -S -c "import json, sys; d = json.load(sys.stdin); print(d$1)"; }
job=$(curl -sf "$url/v1/jobs" -F "scene=@$scene/motorcycle.ply" -F "cameras=@$scene/cameras.json" \
  -F "style=@$scene/starry_night.jpg" -F 'parameters={"resolution": 96, "views": 2, "steps_coarse": 0, "steps_sos": 24,
  "backbone": "vgg16", "seed": 1}' | field "['id']")
echo "job $job is accepted"
killed=
until=$((SECONDS + PATIENCE))
while [ $SECONDS -lt $until ]; do
  sleep 1
  shown=$(curl -sf "$url/v1/jobs/$job")
  status=$(echo "$shown" | field "['status']")
  case "$status" in succeeded | failed) break ;; esac
  step=$(echo "$shown" | field "['progress']['step'] if d['progress'] and d['progress']['loss'] else 0")
  if [ "$HOW" = kill ] && [ -z "$killed" ] && [ "$step" -ge 8 ]; then
    stop_host node
    killed=yes
    echo "the node was killed with its disk at step $step"
    start_node
  fi
done
echo "status: $status, attempts: $(echo "$shown" | field "['attempt']")"
if [ "$status" != succeeded ]; then
  echo "$shown" >&2
  grep -v "info    request" "$WORK/api.log" | tail -n 20 >&2
  tail -n 60 "$WORK/dispatcher.log" >&2
  curl -s "$url/v1/jobs/$job/artifacts/log.txt" | tail -n 40 >&2
  exit 1
fi
if [ "$HOW" = kill ] && [ -z "$killed" ]; then
  echo "the job was done before the node could be killed" >&2
  exit 1
fi
for name in stylized.ply report.json plan.json log.txt; do
  curl -sf "$url/v1/jobs/$job/artifacts/$name" -o "$OUT/$name"
done
echo "computed on: $(field "['workers']['ranks'][0]['host']" < "$OUT/report.json")"
threads=$(field "['workers']['ranks'][0]['threads']" < "$OUT/report.json") # other numbers of threads round differently
OMP_NUM_THREADS=$threads sgsst stylize "$scene/motorcycle.ply" --cameras "$scene/cameras.json" --style "$scene/starry_night.jpg" \
  --out "$OUT/expected.ply" --resolution 96 --views 2 --steps-coarse 0 --steps-sos 24 --backbone vgg16 \
  --seed 1 > /dev/null
cmp "$OUT/stylized.ply" "$OUT/expected.ply" && echo "the result is that of sgsst stylize, byte for byte"
for name in api head node; do
  left=$(on_host "$name" sh -c "find $WORK/disk -type f -not -path '*/cache/*' -not -path '*/ranks/all' | wc -l")
  ranks=$(on_host "$name" sh -c "find $WORK/disk/data/ranks $WORK/disk/data/work -mindepth 2 2> /dev/null | wc -l")
  echo "left on host-$name: $left files beside the cache, $ranks of jobs"
done
python - <<'PYTHON'
from service.files.objects import ObjectStore

names = sorted(ObjectStore("s3://files/sgsst").below(""))
kinds = {}
for name in names:
    kind = name.split("/")[0].split("_")[0]
    kinds.setdefault(kind, []).append(name.rsplit("/", 1)[-1])
print("in the store:", {kind: len(found) for kind, found in kinds.items()}, "of the job:", sorted(kinds["job"]))
PYTHON
cp "$WORK"/*.log "$OUT"/
