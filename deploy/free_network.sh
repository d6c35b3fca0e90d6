# shellcheck shell=bash
# For scripts that make hosts out of namespaces (two_hosts.sh, three_hosts.sh): a network that no concurrent run uses.

BRIDGE=
NET=

# Create a bridge on this machine in a free network of 10.77.81 to 10.77.99, with this machine as number 1. Sets BRIDGE,
# the prefix of host names, and NET. Creating the bridge reserves the network, so two runs never get the same. Leftovers
# of killed runs are skipped: `ip link delete sgsst-NN` frees their networks.
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

# Create a host's own network on the bridge. $1 name, $2 address.
add_host() {
  local host=$BRIDGE-$1
  ip netns delete "$host" 2> /dev/null || true # left over if the machine restarts and /run is on a disk
  ip netns add "$host"
  ip link add "$host" type veth peer name eth0 netns "$host"
  ip link set "$host" master "$BRIDGE" up
  ip -n "$host" link set lo up
  ip -n "$host" link set eth0 up
  ip -n "$host" address add "$2/24" dev eth0
  ip -n "$host" route add default via "$NET.1"
}

# Remove a host from the bridge. $1 name.
remove_host() {
  ip link delete "$BRIDGE-$1" 2> /dev/null || true
  ip netns delete "$BRIDGE-$1" 2> /dev/null || true
}

# Release the network with all hosts on it. Arguments: names of the hosts.
give_network_back() {
  local name
  [ -n "$BRIDGE" ] || return 0
  for name in "$@"; do remove_host "$name"; done
  ip link delete "$BRIDGE" 2> /dev/null || true
}
