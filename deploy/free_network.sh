# shellcheck shell=bash
# For scripts that make hosts out of namespaces (two_hosts.sh, three_hosts.sh): a network that no other run of theirs has.

BRIDGE=
NET=

# A bridge of this machine in a free one of the networks 10.77.81 to 10.77.99, with this machine at number 1. Sets BRIDGE,
# with which names of hosts begin, and NET. Making the bridge is what takes the network, so two runs never get the same.
# What a killed run has left is passed over: `ip link delete sgsst-NN` frees its network.
take_network() {
  local number problem=
  for number in $(seq 81 99); do
    if problem=$(ip link add "sgsst-$number" type bridge 2>&1); then
      BRIDGE=sgsst-$number
      NET=10.77.$number
      ip link set "$BRIDGE" up
      ip address add "$NET.1/24" dev "$BRIDGE"
      return
    fi
  done
  echo "No network of 10.77.81 to 10.77.99 could be taken: $problem" >&2
  return 1
}

# A host's own network on the bridge. $1 name, $2 address.
add_host() {
  local host=$BRIDGE-$1
  ip netns delete "$host" 2> /dev/null || true # its file outlives a machine whose /run is on a disk
  ip netns add "$host"
  ip link add "$host" type veth peer name eth0 netns "$host"
  ip link set "$host" master "$BRIDGE" up
  ip -n "$host" link set lo up
  ip -n "$host" link set eth0 up
  ip -n "$host" address add "$2/24" dev eth0
  ip -n "$host" route add default via "$NET.1"
}

# Take a host off the bridge. $1 name.
remove_host() {
  ip link delete "$BRIDGE-$1" 2> /dev/null || true
  ip netns delete "$BRIDGE-$1" 2> /dev/null || true
}

# Give the network back, with all hosts on it. The arguments: their names.
give_network_back() {
  local name
  [ -n "$BRIDGE" ] || return 0
  for name in "$@"; do remove_host "$name"; done
  ip link delete "$BRIDGE" 2> /dev/null || true
}
